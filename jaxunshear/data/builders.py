"""Build sets with TFDS, without TensorFlow, from the examples of `jaxunshear.data`.

A set appears in one step (TFDS moves the finished folder into place) and with it `shards.json`, the
SHA-256 of each shard and a checksum of the metadata, by which a reader detects a truncated or
damaged file. Until then contacts lie under `<data_dir>/.partial/`.
"""

import dataclasses
import errno
import functools
import hashlib
import importlib.metadata
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config import configs
from jaxunshear.config.data import DataSettings, PairedData, PoseData, Recorded, SimulatedData
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data import chunks, recorded_frames
from jaxunshear.data.recorded_contacts import RecordedContacts, read_contacts
from jaxunshear.data.sampling import ContactSamples, sample_contacts
from jaxunshear.data.sensor_frame import find_sensor_frame
from jaxunshear.data.simulation import SimulationEngine, make_engine, simulate_chunks
from jaxunshear.errors import UserError
from jaxunshear.files import compute_checksum, hold_lock, write_json

if not hasattr(tfds, "core"):  # TFDS logs what its own import raised, and goes on without its parts
    raise UserError(
        "tensorflow_datasets could not be imported; its own lines above say why: "
        "a lack of memory, or a broken install"
    )

HOMEPAGE = "https://arxiv.org/abs/2109.03615"  # the paper whose data these sets imitate


@dataclasses.dataclass(eq=False)
class SetConfig(tfds.core.BuilderConfig):
    settings: DataSettings | None = None
    sensor: Sensor = TACTIP_331


def _make_standard_configs(name: str) -> list[SetConfig]:
    return [
        SetConfig(
            name=config,
            settings=settings,
            sensor=configs.get_config_sensor(config),
            description=f"{settings.poses} poses a stimulus, see README.md",
        )
        for config, settings in configs.CONFIGS[name].items()
    ]


def _make_image_feature(size: int) -> tfds.features.Image:
    return tfds.features.Image(shape=(size, size, 1), encoding_format="png")


def _make_pins_feature(pins: int) -> tfds.features.Tensor:
    return tfds.features.Tensor(shape=(pins, 2), dtype=np.float32, encoding="bytes")


def _make_vector_feature(length: int) -> tfds.features.Tensor:
    return tfds.features.Tensor(shape=(length,), dtype=np.float32)


def compute_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class StoredSet(tfds.core.GeneratorBasedBuilder, skip_registration=True):  # type: ignore[call-arg]
    """Makes the set, or continues to make it, when it is prepared.

    `file_format` need not be passed: it is array_record.
    """

    # settings, contacts, paths of their chunks, split -> (key, example) of each
    iterate_examples: ClassVar[Callable[..., Iterator[tuple[str, dict]]]]

    def _set_info(self, features: dict, keys: tuple[str, str]) -> tfds.core.DatasetInfo:
        info = self.dataset_info_from_configs(
            features=tfds.features.FeaturesDict(features),
            supervised_keys=keys,
            metadata=tfds.core.MetadataDict(),
            homepage=HOMEPAGE,
        )
        # else TFDS asks its own bucket for a set of this name, over the network, and leaves an
        # empty folder behind each time
        info.initialize_from_bucket = lambda: None
        return info

    @property
    def _unfinished_folder(self) -> Path:
        config, data_dir = self.builder_config, Path(self._data_dir_root)
        return configs.get_unfinished_folder(config.settings, config.sensor, data_dir)

    def download_and_prepare(self, **options: object) -> None:
        """Make the set unless it is there. Raises `UserError` if another process is making it."""
        unfinished, folder = self._unfinished_folder, Path(self.data_dir)
        if not folder.exists():
            with hold_lock(unfinished / "lock", wait=False) as is_free:
                if not is_free:
                    raise UserError(
                        f"another process is making the set in {unfinished}: "
                        "wait for it, or stop it"
                    )
                for incomplete in folder.parent.glob("incomplete.*"):
                    shutil.rmtree(incomplete)  # of a killed run: the lock excludes others
                options = {
                    "file_format": "array_record",
                    "download_dir": unfinished / "downloads",
                } | options
                try:
                    super().download_and_prepare(**options)
                except RuntimeError as error:  # by which array_record reports a full disk
                    words = os.strerror(errno.ENOSPC)
                    if words not in str(error):
                        raise
                    raise OSError(errno.ENOSPC, words) from error
        shutil.rmtree(unfinished, ignore_errors=True)

    def _download_and_prepare(self, *args: object, **kwargs: object) -> None:
        super()._download_and_prepare(*args, **kwargs)
        folder = Path(self.data_dir)  # still the unfinished one
        shards = sorted(path for path in folder.iterdir() if ".array_record" in path.name)
        checksums = {path.name: compute_sha256(path) for path in shards}
        checksums[configs.METADATA] = compute_checksum(dict(self.info.metadata))
        write_json(folder / configs.MANIFEST, checksums)

    def _generate_examples(
        self, contacts: ContactSamples | RecordedContacts, paths: list[Path], split: str
    ) -> Iterator[tuple[str, dict]]:
        yield from self.iterate_examples(self.builder_config.settings, contacts, paths, split)

    def _set_metadata(self, **facts: object) -> None:
        versions = {
            name: importlib.metadata.version(name)
            for name in ("jax", "numpy", "tensorflow-datasets")
        }
        described = configs.describe_set(self.builder_config.settings, self.builder_config.sensor)
        self.info.metadata.update(**described, versions=versions, **facts)


class SimulatedSet(StoredSet, skip_registration=True):  # type: ignore[call-arg]
    """Simulates the contacts of a set, or continues to."""

    VERSION = tfds.core.Version(SimulatedData.version)
    engine: SimulationEngine | None = None  # tests put a fast stand-in for the simulator here

    def _split_generators(
        self, dl_manager: tfds.download.DownloadManager
    ) -> dict[str, Iterator[tuple[str, dict]]]:
        settings, sensor = self.builder_config.settings, self.builder_config.sensor
        samples = sample_contacts(settings)
        paths = simulate_chunks(
            settings, sensor, samples, self._unfinished_folder, self.engine or make_engine()
        )
        counts = chunks.summarise_set(settings, samples, paths)
        for split, count in counts["written"].items():
            if not count:
                raise UserError(
                    f"{self.name}/{self.builder_config.name}: no contact of split '{split}' "
                    "converged: draw more poses"
                )
        self._set_metadata(counts=counts)
        return {split: self._generate_examples(samples, paths, split) for split in SPLITS}


class TactipPaired(SimulatedSet, skip_registration=True):  # type: ignore[call-arg]
    """`tactip_paired`: sheared images, each with a tap."""

    iterate_examples = staticmethod(chunks.iterate_paired_examples)
    BUILDER_CONFIGS = _make_standard_configs(PairedData.set_name)
    DEFAULT_BUILDER_CONFIG_NAME = "demo"

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        image, ranges = _make_image_feature(settings.preprocess.size), settings.ranges
        features = {
            "canonical": image,
            "sheared": image,
            "canonical_pins": _make_pins_feature(pins),
            "sheared_pins": _make_pins_feature(pins),
            "pose": _make_vector_feature(6 if ranges.tilt_deg else 4),
            "edge": _make_vector_feature(2),
            "move": _make_vector_feature(3 if ranges.twist_deg else 2),
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


class TactipPose(SimulatedSet, skip_registration=True):  # type: ignore[call-arg]
    """`tactip_pose`: taps, with drift."""

    iterate_examples = staticmethod(chunks.iterate_pose_examples)
    BUILDER_CONFIGS = _make_standard_configs(PoseData.set_name)
    DEFAULT_BUILDER_CONFIG_NAME = "demo"

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        features = {
            "image": _make_image_feature(settings.preprocess.size),
            "pins": _make_pins_feature(pins),
            "pose": _make_vector_feature(6 if settings.ranges.tilt_deg else 4),
            "edge": _make_vector_feature(2),
            "stimulus": tfds.features.ClassLabel(names=list(settings.names)),
            "pose_id": np.int32,
            "residual_mm": np.float32,
            "age": np.float32,
        }
        return self._set_info(features, ("image", "pose"))


class TactipRecorded(StoredSet, skip_registration=True):  # type: ignore[call-arg]
    """`tactip_recorded`: taps and slides of a laboratory, with the pins detected in them."""

    iterate_examples = staticmethod(recorded_frames.iterate_examples)
    VERSION = tfds.core.Version(Recorded.version)
    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "The folders of taps and slides that the settings name, in one of the layouts of README.md."
    )

    @functools.cached_property
    def _contacts(self) -> RecordedContacts:
        return read_contacts(self.builder_config.settings)

    def _info(self) -> tfds.core.DatasetInfo:
        settings, pins = self.builder_config.settings, self.builder_config.sensor.pins
        others = len(self._contacts.others)
        features = {
            "image": _make_image_feature(settings.preprocess.size),
            "pins": _make_pins_feature(pins),
            **({"others": _make_vector_feature(others)} if others else {}),
            "sure": np.int32,
            "slid": np.int32,
            "pose": _make_vector_feature(6),
            "move": _make_vector_feature(6),
            "pose_id": np.int32,
            "number": np.int32,
        }
        return self._set_info(features, ("image", "pose"))

    def _split_generators(
        self, dl_manager: tfds.download.DownloadManager
    ) -> dict[str, Iterator[tuple[str, dict]]]:
        settings, sensor = self.builder_config.settings, self.builder_config.sensor
        contacts = self._contacts
        frame = find_sensor_frame(contacts, settings, sensor)
        paths = recorded_frames.prepare_chunks(contacts, settings, frame, self._unfinished_folder)
        description = recorded_frames.summarise_recordings(contacts, frame.describe(), paths)
        for split, count in description["counts"]["written"].items():
            if not count:
                first = description["counts"]["dropped_frames"][:1]
                raise UserError(f"no frame of split '{split}' can be read; the first: {first}")
        self._set_metadata(**description)
        return {split: self._generate_examples(contacts, paths, split) for split in SPLITS}
