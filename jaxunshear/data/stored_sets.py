"""Make stored data sets, or find them, and read them.

    make_set(experiment.paired, experiment.sensor, data_dir)
    paired = open_set(experiment.paired, data_dir, experiment.sensor)
    steps = paired.train_batches(batch=16, seed=0, shift=0.015)(start_step=0)
    next(steps)["sheared"]  # (16, 128, 128, 1) uint8 in {0, 255}

A split is decoded once and held in memory at one bit a pixel: 9 MB of images for the demo's
training pairs, 0.9 GB for the paper's.
"""

import contextlib
import functools
import io
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image

from jaxunshear.config import configs
from jaxunshear.config.data import DataSettings, PairedData, PoseData, Recorded
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import pack_bits
from jaxunshear.data.reader import (
    IMAGES,
    OTHER_IMAGE,
    OTHER_PINS,
    PARTNERS,
    Batch,
    DrawnRows,
    Reader,
    check_split,
    sample_next,
    to_sensor_frame,
)
from jaxunshear.data.sampling import check_settings, find_slide_leaders
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import compute_checksum, explain_os_error, raise_machine_error, read_object
from jaxunshear.selection import number_poses

if TYPE_CHECKING:
    from jaxunshear.data.simulation import SimulationEngine

MAX_CHANGES = 3  # named in an error, at most


def _format_remedy(folder: Path) -> str:
    return f"delete {folder} and run `jaxunshear data` again"


def _make_damage_error(folder: Path, what: str) -> UserError:
    return UserError(f"the data set in {folder} is damaged ({what}): {_format_remedy(folder)}")


def read_metadata(settings: DataSettings, sensor: Sensor, data_dir: Path) -> dict:
    """Read `metadata.json` of a set: settings, sensor, counts, versions.

    Raises `UserError` if it is missing or damaged, or was made with other settings.
    """
    folder = configs.get_set_folder(settings, sensor, data_dir)
    if not folder.exists():
        raise UserError(f"there is no data set in {folder}: make it with `jaxunshear data`")
    try:
        metadata = read_object(folder / configs.METADATA)
        checksums = read_object(folder / configs.MANIFEST)
    except UserError as error:
        raise_machine_error(folder, error)
        raise _make_damage_error(folder, get_first_line(error)) from error
    is_intact = checksums.get(configs.METADATA) in (None, compute_checksum(metadata))
    if not is_intact or not isinstance(metadata.get("counts"), dict):
        raise _make_damage_error(folder, configs.METADATA)
    expected = configs.describe_set(settings, sensor)
    stored = {key: metadata.get(key) for key in expected}
    changes = configs.list_differences(stored, expected)
    if changes:
        more = f" and {len(changes) - MAX_CHANGES} more" if len(changes) > MAX_CHANGES else ""
        raise UserError(
            f"the data set in {folder} was made with another "
            f"{', '.join(changes[:MAX_CHANGES])}{more}: "
            "delete that folder, or use another data folder"
        )
    return metadata


def make_set(
    settings: DataSettings,
    sensor: Sensor = TACTIP_331,
    data_dir: Path = Path("datasets"),
    engine: "SimulationEngine | None" = None,
) -> dict:
    """Make the set that `settings` describe under `data_dir` unless it is there.

    A killed run is continued. Returns the set's metadata. Raises `UserError` for settings out of
    range, a set made with other settings, or a full disk.
    """
    check_settings(settings, sensor)
    folder = configs.get_set_folder(settings, sensor, data_dir)
    if not folder.exists():
        try:
            _build(settings, sensor, folder.parents[2], engine)
        except OSError as error:
            raise explain_os_error(folder, error) from error
    metadata = read_metadata(settings, sensor, data_dir)
    unfinished = configs.get_unfinished_folder(settings, sensor, data_dir)
    shutil.rmtree(unfinished, ignore_errors=True)
    return metadata


def _build(
    settings: DataSettings, sensor: Sensor, data_dir: Path, engine: "SimulationEngine | None"
) -> None:
    import absl.logging
    import tensorflow_datasets as tfds

    from jaxunshear.data import builders

    kinds = {
        PairedData.set_name: builders.TactipPaired,
        PoseData.set_name: builders.TactipPose,
        Recorded.set_name: builders.TactipRecorded,
    }
    set_name, name = settings.set_name, configs.compute_config_name(settings, sensor)
    is_standard = name in configs.CONFIGS.get(set_name, {})
    config = (
        name if is_standard else builders.SetConfig(name=name, settings=settings, sensor=sensor)
    )
    # TFDS warns of each configuration that it does not know
    absl.logging.set_verbosity(absl.logging.ERROR)
    tfds.disable_progress_bar()
    builder = kinds[set_name](config=config, data_dir=data_dir)
    if engine is not None:
        builder.engine = engine
    with contextlib.redirect_stdout(io.StringIO()):  # TFDS announces a download
        builder.download_and_prepare()


class SetReader(Reader):
    """Reads one set on disk."""

    def __init__(self, settings: DataSettings, folder: Path, metadata: dict) -> None:
        super().__init__(self._load, settings.preprocess.size)
        self.settings, self.folder, self.metadata = settings, folder, metadata

    def length(self, split: str) -> int:
        check_split(split)
        return self.metadata["counts"]["written"][split]

    def _load(self, split: str) -> Batch:
        count = self.length(split)
        try:
            rows = _read_rows(self.folder, split, count, _check_shards(self.folder, split))
            if "sheared_pins" in rows:  # simulated pairs
                return rows | {"felt": to_sensor_frame(rows["move"], rows["pose"])}
            return rows
        except UserError:
            raise
        except Exception as error:  # whatever a damaged file makes of itself
            raise_machine_error(self.folder, error)
            raise _make_damage_error(self.folder, get_first_line(error)) from error


def open_set(
    settings: DataSettings,
    data_dir: Path,
    sensor: Sensor = TACTIP_331,
    kind: type[SetReader] = SetReader,
) -> SetReader:
    """Open the set made with `settings`.

    Raises `UserError` if it is missing or was made with other settings.
    """
    folder = configs.get_set_folder(settings, sensor, data_dir)
    return kind(settings, folder, read_metadata(settings, sensor, data_dir))


def _check_shards(folder: Path, split: str) -> tuple[str, ...]:
    """Compare every shard of a split with its checksum; returns the checksums.

    Raises UserError for a shard that is missing or damaged.
    """
    from jaxunshear.data.builders import compute_sha256

    try:
        sums = read_object(folder / configs.MANIFEST)
    except UserError as error:
        raise_machine_error(folder / configs.MANIFEST, error)
        raise _make_damage_error(folder, configs.MANIFEST) from error
    shards = sorted(name for name in sums if f"-{split}." in name)
    for name in shards:
        path = folder / name
        if not path.exists():
            raise UserError(f"shard {path} is missing: {_format_remedy(folder)}")
        if compute_sha256(path) != sums[name]:
            raise UserError(f"shard {path} is truncated or damaged: {_format_remedy(folder)}")
    return tuple(sums[name] for name in shards)


# The stages of a run, one process, open the same sets one after the other.
@functools.lru_cache(maxsize=2 * len(SPLITS))
def _read_rows(folder: Path, split: str, count: int, sums: tuple[str, ...]) -> Batch:
    """Read all fields of a split, (count, ...) each, read-only; images at one bit a pixel.

    `sums` are the checksums of its shards: a set made anew is read anew.
    """
    import tensorflow_datasets as tfds

    builder = tfds.builder_from_directory(folder)
    features = builder.info.features
    images = [name for name in IMAGES if name in features]
    decoders = {name: tfds.decode.SkipDecoding() for name in images}
    source = builder.as_data_source(split, decoders=decoders)
    if len(source) != count:
        raise UserError(
            f"{folder} holds {len(source)} examples of split '{split}', "
            f"its metadata says {count}: delete it"
        )
    rows: Batch = {}
    for name, feature in features.items():
        if name in images:
            bits = -(-feature.shape[0] * feature.shape[1] // 8)
            rows[name] = np.zeros((count, bits), np.uint8)
        else:
            dtype = np.int32 if np.issubdtype(feature.np_dtype, np.integer) else feature.np_dtype
            rows[name] = np.zeros((count, *feature.shape), dtype)
    for index in range(count):
        for name, value in source[index].items():
            if name in images:
                value = pack_bits(np.asarray(Image.open(io.BytesIO(value)))[None])[0]
            rows[name][index] = value
    for value in rows.values():
        value.flags.writeable = False
    return rows


class Partners(NamedTuple):
    """The partners of B rows."""

    other: np.ndarray  # (B,) rows of another pose after another slide
    swapped: np.ndarray  # (B,) rows of the same pose after that other slide


class SharedSlides(NamedTuple):
    """Which rows of a split share a pose, and which a slide."""

    group: np.ndarray  # (N,) of poses that share their slides
    place: np.ndarray  # (N,) of the pose in its group
    slide: np.ndarray  # (N,)
    row: np.ndarray  # (groups, places, slides), -1 where there is none
    places: np.ndarray  # (groups,) how many poses each has

    def sample_partners(self, rows: np.ndarray, generator: np.random.Generator) -> Partners:
        """Sample partners for rows (B,)."""
        group, place, slide = self.group[rows], self.place[rows], self.slide[rows]
        other_place = sample_next(place, self.places[group], generator)
        other_slide = sample_next(slide, np.full(len(rows), self.row.shape[2]), generator)
        other = self.row[group, other_place, other_slide]
        swapped = self.row[group, place, other_slide]
        is_complete = (other >= 0) & (swapped >= 0)
        return Partners(np.where(is_complete, other, rows), np.where(is_complete, swapped, rows))


def index_shared_slides(rows: Batch, settings: PairedData) -> SharedSlides:
    """Index the slides that rows of a split share, by `stimulus`, `pose_id` and `slide_id` (N,)."""
    leaders = np.stack([find_slide_leaders(settings, name) for name in settings.names])
    leader = leaders[rows["stimulus"], rows["pose_id"]]
    group = number_poses(rows["stimulus"], leader)
    pose, first = np.unique(np.stack([group, rows["pose_id"]], axis=1), axis=0, return_inverse=True)
    starts = np.searchsorted(pose[:, 0], np.arange(group.max(initial=-1) + 1))
    place = first.reshape(-1) - starts[group]
    places = np.bincount(pose[:, 0])
    row = np.full((len(places), settings.poses_a_slide, settings.slides), -1)
    row[group, place, rows["slide_id"]] = np.arange(len(group))
    return SharedSlides(group, place, rows["slide_id"], row, places)


class FactorialReader(SetReader):
    """Reads a set whose slides are shared by several poses, with the fields `reader.PARTNERS`.

    So pose and slide can be combined freely: only a simulator can give the pose of this contact
    after the slide of that one. Partners are drawn by seed and step in training, and once and for
    all in evaluation; where one was dropped, both are the example itself. The sets are made with
    `paired.poses_a_slide` of two or more.
    """

    def __init__(self, settings: PairedData, folder: Path, metadata: dict) -> None:
        super().__init__(settings, folder, metadata)
        self.shared = functools.cache(lambda split: index_shared_slides(self.rows(split), settings))

    def take(self, name: str, rows: np.ndarray, fields: Sequence[str]) -> Batch:
        stored = super().take(name, rows, [field for field in fields if field not in PARTNERS])
        return stored | self._read_partners(name, rows, fields)

    def sample_partners(self, split: str, rows: np.ndarray, *step: int) -> Partners:
        """Sample the partners of rows (B,): for evaluation, or for a training's seed and step."""
        return self.shared(split).sample_partners(rows, np.random.default_rng(step or 0))

    def _make_training_batch(
        self, drawn: DrawnRows, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        own = [field for field in fields if field not in PARTNERS]
        stored = super()._make_training_batch(drawn, own, seed)
        return stored | self._read_partners("train", drawn.rows, fields, *seed)

    def _read_partners(
        self, split: str, rows: np.ndarray, fields: Sequence[str], *step: int
    ) -> Batch:
        partner_fields = [name for name in fields if name in PARTNERS]
        if not partner_fields:
            return {}
        partners, stored = self.sample_partners(split, rows, *step), self.rows(split)
        batch: Batch = {}
        for name in partner_fields:
            source = partners.other if name in (OTHER_PINS, OTHER_IMAGE) else partners.swapped
            batch[name] = stored[PARTNERS[name]][source]
        return self._unpack_images(batch)
