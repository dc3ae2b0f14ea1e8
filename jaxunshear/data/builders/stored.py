"""Build sets with TFDS, without TensorFlow, from the examples of `jaxunshear.data`.

A set appears in one step (TFDS moves the finished folder into place) and with it `shards.json`, the
SHA-256 of each shard and a checksum of the metadata, by which a reader detects a truncated or
damaged file. Until then contacts lie under `<data_dir>/.partial/`.
"""

import contextlib
import dataclasses
import errno
import fcntl
import hashlib
import importlib.metadata
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import tensorflow_datasets as tfds

from jaxunshear.config import configs
from jaxunshear.config.data import DataSettings, SimulatedData
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import SimulationEngine, make_engine, simulate_chunks
from jaxunshear.data.examples import summarise_set
from jaxunshear.data.sampling import sample_contacts
from jaxunshear.errors import UserError
from jaxunshear.files import compute_checksum, write_json

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


def make_standard_configs(name: str) -> list[SetConfig]:
    """Make the configurations of a set that TFDS knows by name."""
    return [
        SetConfig(
            name=config,
            settings=settings,
            sensor=configs.get_config_sensor(config),
            description=f"{settings.poses} poses a stimulus, see README.md",
        )
        for config, settings in configs.CONFIGS[name].items()
    ]


def make_image_feature(size: int) -> tfds.features.Image:
    """Describe a binary image of `size` px."""
    return tfds.features.Image(shape=(size, size, 1), encoding_format="png")


def make_pins_feature(pins: int) -> tfds.features.Tensor:
    """Describe the positions of pins."""
    return tfds.features.Tensor(shape=(pins, 2), dtype=np.float32, encoding="bytes")


def make_vector_feature(length: int) -> tfds.features.Tensor:
    """Describe a vector of numbers, such as a pose."""
    return tfds.features.Tensor(shape=(length,), dtype=np.float32)


class StoredSet(tfds.core.GeneratorBasedBuilder, skip_registration=True):  # type: ignore[call-arg]
    """Makes the set, or continues to make it, when it is prepared.

    `file_format` need not be passed: it is array_record.
    """

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
            with _hold_lock(unfinished):
                if not folder.exists():
                    for incomplete in folder.parent.glob("incomplete.*"):
                        shutil.rmtree(incomplete)  # of a killed run: the lock excludes others
                    defaults = {
                        "file_format": "array_record",
                        "download_dir": unfinished / "downloads",
                    }
                    with _convert_full_disk_error():
                        super().download_and_prepare(**{**defaults, **options})
        shutil.rmtree(unfinished, ignore_errors=True)

    def _download_and_prepare(self, *args: object, **kwargs: object) -> None:
        super()._download_and_prepare(*args, **kwargs)
        folder = Path(self.data_dir)  # still the unfinished one
        shards = sorted(path for path in folder.iterdir() if ".array_record" in path.name)
        checksums = {path.name: compute_sha256(path) for path in shards}
        checksums[configs.METADATA] = compute_checksum(dict(self.info.metadata))
        write_json(folder / configs.MANIFEST, checksums)

    def _set_metadata(self, counts: dict, **more: object) -> None:
        versions = {
            name: importlib.metadata.version(name)
            for name in ("jax", "numpy", "tensorflow-datasets")
        }
        described = configs.describe_set(self.builder_config.settings, self.builder_config.sensor)
        self.info.metadata.update(**described, counts=counts, versions=versions, **more)


class SimulatedSet(StoredSet, skip_registration=True):  # type: ignore[call-arg]
    """Simulates the contacts of a set, or continues to."""

    VERSION = tfds.core.Version(SimulatedData.version)
    RELEASE_NOTES: ClassVar[dict[str, str]] = {
        "2.0.0": "Pins as levers; contact to 60 deg from the apex.",
        "2.1.0": "Presses in increments of 3 mm.",
        "2.3.0": "Polygons without a ridge along rows through a corner.",
        "2.4.0": "Pairs drift too.",
        "3.0.0": "Exact distances from every shape's outline; slides along x, y or both; "
        "the fitted sensor but for tiny and demo; a pose's split is its own: "
        "by seed, stimulus and number, whatever the set's size.",
        "1.0.0": "First release.",
    }
    engine: SimulationEngine | None = None  # tests put a fast stand-in for the simulator here

    def _split_generators(
        self, dl_manager: tfds.download.DownloadManager
    ) -> dict[str, Iterator[tuple[str, dict]]]:
        settings, sensor = self.builder_config.settings, self.builder_config.sensor
        samples = sample_contacts(settings)
        paths = simulate_chunks(
            settings, sensor, samples, self._unfinished_folder, self.engine or make_engine()
        )
        counts = summarise_set(settings, samples, paths)
        for split, count in counts["written"].items():
            if not count:
                raise UserError(
                    f"{self.name}/{self.builder_config.name}: no contact of split '{split}' "
                    "converged: draw more poses"
                )
        self._set_metadata(counts)
        return {split: self._generate_examples(samples, paths, split) for split in SPLITS}


def compute_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def _convert_full_disk_error() -> Iterator[None]:
    """Raise OSError for the RuntimeError by which array_record's writer reports a full disk.

    That error has the system's words in it.
    """
    try:
        yield
    except RuntimeError as error:
        words = os.strerror(errno.ENOSPC)
        if words not in str(error):
            raise
        raise OSError(errno.ENOSPC, words) from error


@contextlib.contextmanager
def _hold_lock(folder: Path) -> Iterator[None]:
    """Hold a lock on an unfinished set's folder; the system releases it when a process dies."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError(
                f"another process is making the set in {folder}: wait for it, or stop it"
            ) from error
        yield
    finally:
        os.close(handle)
