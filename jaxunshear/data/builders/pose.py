"""Build `tactip_pose`: taps at poses of their own, with drift."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config.configs import POSE_SET
from jaxunshear.data import examples
from jaxunshear.data.builders.stored import SimulatedSet, make_standard_configs
from jaxunshear.data.sampling import ContactSamples


class TactipPose(SimulatedSet, skip_registration=True):  # type: ignore[call-arg]
    BUILDER_CONFIGS = make_standard_configs(POSE_SET)
    DEFAULT_BUILDER_CONFIG_NAME = "demo"

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        size = settings.preprocess.size
        features = {
            "image": tfds.features.Image(shape=(size, size, 1), encoding_format="png"),
            "pins": tfds.features.Tensor(shape=(pins, 2), dtype=np.float32, encoding="bytes"),
            "pose": tfds.features.Tensor(
                shape=(6 if settings.ranges.tilt_deg else 4,), dtype=np.float32
            ),
            "edge": tfds.features.Tensor(shape=(2,), dtype=np.float32),
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
