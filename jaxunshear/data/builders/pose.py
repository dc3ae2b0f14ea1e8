"""Build `tactip_pose`: taps at poses of their own, with drift."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config.data import PoseData
from jaxunshear.data import examples
from jaxunshear.data.builders.stored import (
    SimulatedSet,
    make_image_feature,
    make_pins_feature,
    make_standard_configs,
    make_vector_feature,
)
from jaxunshear.data.sampling import ContactSamples


class TactipPose(SimulatedSet, skip_registration=True):  # type: ignore[call-arg]
    BUILDER_CONFIGS = make_standard_configs(PoseData.set_name)
    DEFAULT_BUILDER_CONFIG_NAME = "demo"

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        features = {
            "image": make_image_feature(settings.preprocess.size),
            "pins": make_pins_feature(pins),
            "pose": make_vector_feature(6 if settings.ranges.tilt_deg else 4),
            "edge": make_vector_feature(2),
            "stimulus": tfds.features.ClassLabel(names=list(settings.names)),
            "pose_id": np.int32,
            "residual_mm": np.float32,
            "age": np.float32,
        }
        return self._set_info(features, ("image", "pose"))

    def _generate_examples(
        self, samples: ContactSamples, paths: list[Path], split: str
    ) -> Iterator[tuple[str, dict]]:
        yield from examples.iterate_pose_examples(
            self.builder_config.settings, samples, paths, split
        )
