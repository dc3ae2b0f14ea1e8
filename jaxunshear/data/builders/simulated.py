"""Build `tactip_paired`, sheared images each with a tap, and `tactip_pose`, taps with drift."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.data import examples
from jaxunshear.data.builders.stored import (
    SimulatedSet,
    make_image_feature,
    make_pins_feature,
    make_standard_configs,
    make_vector_feature,
)
from jaxunshear.data.sampling import ContactSamples


class TactipPaired(SimulatedSet, skip_registration=True):  # type: ignore[call-arg]
    BUILDER_CONFIGS = make_standard_configs(PairedData.set_name)
    DEFAULT_BUILDER_CONFIG_NAME = "demo"

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        image, ranges = make_image_feature(settings.preprocess.size), settings.ranges
        features = {
            "canonical": image,
            "sheared": image,
            "canonical_pins": make_pins_feature(pins),
            "sheared_pins": make_pins_feature(pins),
            "pose": make_vector_feature(6 if ranges.tilt_deg else 4),
            "edge": make_vector_feature(2),
            "move": make_vector_feature(3 if ranges.twist_deg else 2),
            "friction": np.float32,
            "stimulus": tfds.features.ClassLabel(names=list(settings.names)),
            "pose_id": np.int32,
            "slide_id": np.int32,
            "tap_id": np.int32,
            "tap_depth_mm": np.float32,
            "residual_mm": np.float32,
            "stuck": np.int32,
            "slipping": np.int32,
            "free": np.int32,
            "iterations": np.int32,
        }
        return self._set_info(features, ("sheared", "canonical"))

    def _generate_examples(
        self, samples: ContactSamples, paths: list[Path], split: str
    ) -> Iterator[tuple[str, dict]]:
        yield from examples.iterate_paired_examples(
            self.builder_config.settings, samples, paths, split
        )


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
