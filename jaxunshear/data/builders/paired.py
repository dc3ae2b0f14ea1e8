"""Build `tactip_paired`: sheared tactile images, each with a tap at the same pose."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config.configs import PAIRED_SET
from jaxunshear.data import examples
from jaxunshear.data.builders.stored import SimulatedSet, make_standard_configs
from jaxunshear.data.sampling import ContactSamples


class TactipPaired(SimulatedSet, skip_registration=True):  # type: ignore[call-arg]
    BUILDER_CONFIGS = make_standard_configs(PAIRED_SET)
    DEFAULT_BUILDER_CONFIG_NAME = "demo"

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        size = settings.preprocess.size
        image = tfds.features.Image(shape=(size, size, 1), encoding_format="png")
        features = {
            "canonical": image,
            "sheared": image,
            "canonical_pins": tfds.features.Tensor(
                shape=(pins, 2), dtype=np.float32, encoding="bytes"
            ),
            "sheared_pins": tfds.features.Tensor(
                shape=(pins, 2), dtype=np.float32, encoding="bytes"
            ),
            "pose": tfds.features.Tensor(
                shape=(6 if settings.ranges.tilt_deg else 4,), dtype=np.float32
            ),
            "edge": tfds.features.Tensor(shape=(2,), dtype=np.float32),
            "move": tfds.features.Tensor(
                shape=(3 if settings.ranges.twist_deg else 2,), dtype=np.float32
            ),
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
