"""Build `tactip_recorded`: taps and slides of a laboratory, with the pins detected in them."""

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config.data import Recorded
from jaxunshear.config.splits import SPLITS
from jaxunshear.data import recorded_examples
from jaxunshear.data.builders.stored import (
    StoredSet,
    make_image_feature,
    make_pins_feature,
    make_vector_feature,
)
from jaxunshear.data.preprocessing import find_sensor_frame, prepare_chunks
from jaxunshear.data.recorded_contacts import RecordedContacts, read_contacts


class TactipRecorded(StoredSet, skip_registration=True):  # type: ignore[call-arg]
    VERSION = tfds.core.Version(Recorded.version)
    RELEASE_NOTES: ClassVar[dict[str, str]] = {"1.0.0": "First release."}
    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "The folders of taps and slides that the settings name, in one of the layouts of README.md."
    )

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        features = {
            "image": make_image_feature(settings.preprocess.size),
            "pins": make_pins_feature(pins),
            "sure": np.int32,
            "slid": np.int32,
            "pose": make_vector_feature(6),
            "move": make_vector_feature(6),
            "pose_id": np.int32,
            "number": np.int32,
        }
        return self._set_info(features, ("image", "pose"))

    def _split_generators(
        self, dl_manager: tfds.download.DownloadManager
    ) -> dict[str, Iterator[tuple[str, dict]]]:
        settings, sensor = self.builder_config.settings, self.builder_config.sensor
        contacts = read_contacts(settings)
        frame = find_sensor_frame(contacts, settings, sensor)
        paths = prepare_chunks(contacts, settings, frame, self._unfinished_folder)
        counts, description = recorded_examples.summarise_recordings(contacts, frame, paths)
        self._set_metadata(counts, **description)
        return {split: self._generate_examples(contacts, paths, split) for split in SPLITS}

    def _generate_examples(
        self, contacts: RecordedContacts, paths: list[Path], split: str
    ) -> Iterator[tuple[str, dict]]:
        yield from recorded_examples.iterate_examples(
            self.builder_config.settings, contacts, paths, split
        )
