"""Reads a data set through grain: shuffled, shifted, re-paired batches that depend on the seed and the step alone.

    paired = open_set(experiment.paired, data_dir, experiment.sensor)
    steps = paired.train_batches(batch=16, seed=0, shift=0.015)(start_step=0)
    next(steps)["sheared"]  # (16, 128, 128, 1) uint8 in {0, 255}

A split is decoded once and held in memory at one bit a pixel: 9 MB of images for the demo's training pairs, 0.9 GB for the
paper's. A split with more than `MAX_MEMORY_BYTES` of images has them in an unlinked file beside the set instead.
"""

import functools
import io
import itertools
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import grain
import numpy as np
from PIL import Image

from jaxunshear.angles import rotate_2d
from jaxunshear.config.configs import MANIFEST, DataSettings, get_set_folder
from jaxunshear.config.data import PairedData
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import pack_bits, unpack_bits
from jaxunshear.data.generation import format_remedy, make_damage_error, read_metadata
from jaxunshear.data.pose_groups import group_by_pose
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import raise_machine_error, read_object

MAX_MEMORY_BYTES = 1 << 30
IMAGES = ("image", "canonical", "sheared", "other", "swapped")  # the last two as in `factorial`
PINS = ("pins", "canonical_pins", "sheared_pins", "other_pins", "swapped_pins")
TAP_FIELDS = ("canonical", "canonical_pins", "tap_id", "tap_depth_mm")  # what re-pairing exchanges
Batch = dict[str, np.ndarray]


class Reader:
    """Examples in memory. Images are (B, S, S, 1) uint8 in {0, 255}, pins (B, P, 2) float32 px (col, row), poses mm and deg;
    the other fields are those of the data card. `fields` names those wanted, all of them if None.

    `load`: split -> its rows by field, images at one bit a pixel (`chunks.pack_bits`), or (N, S, S) uint8 where they are grey.
    """

    def __init__(self, load: Callable[[str], Batch], size: int) -> None:
        self.rows, self._size = functools.cache(load), size  # rows: all of a split as it is stored

    def length(self, split: str) -> int:
        """Number of examples of a split."""
        if split not in SPLITS:
            raise UserError(f"split '{split}' is unknown: use one of {', '.join(SPLITS)}")
        return len(next(iter(self.rows(split).values())))

    def split(self, name: str, batch: int, fields: Sequence[str] | None = None) -> Iterator[Batch]:
        """A split once, in its stored order and pairing; the last batch may be smaller."""
        wanted = fields or tuple(self.rows(name))
        for start in range(0, self.length(name), batch):
            yield self.take(name, np.arange(start, min(start + batch, self.length(name))), wanted)

    def take(self, name: str, rows: np.ndarray, fields: Sequence[str]) -> Batch:
        """The given rows (B,) of a split, in this order."""
        stored = self.rows(name)
        return self._images({field: stored[field][rows] for field in fields})

    def train_batches(
        self, batch: int, seed: int, shift: float, fields: Sequence[str] | None = None
    ) -> Callable[[int], Iterator[Batch]]:
        """Endless training batches from any step on; every epoch is shuffled anew.

        `shift` is the largest random shift along each axis as a fraction of the image size, rounded to integer pixels; both
        images of a pair shift alike and their pins with them. A sheared image is paired with a random tap of its pose.
        """
        rows = self.rows("train")
        most = shift * self._size
        siblings = group_by_pose(rows["stimulus"], rows["pose_id"])
        wanted = fields or tuple(rows)

        def draw(row: int, generator: np.random.Generator) -> np.ndarray:
            offset = np.rint(generator.uniform(-most, most, 2)).astype(int)
            return np.array([row, generator.choice(siblings.get_group(row)), *offset])

        drawn = (
            grain.MapDataset.range(self.length("train"))
            .seed(seed)
            .shuffle()
            .repeat()
            .random_map(draw)
            .batch(batch)
        )
        order = _make_shuffle(self.length("train"), batch, seed)

        def at_once(step: int) -> np.ndarray:
            here = order(step)
            taps = siblings.sample_any(
                here, np.random.default_rng((seed, step, 1))
            )  # others draw by (seed, step)
            return np.stack([here, taps, *np.zeros((2, batch), int)], axis=-1)

        def at(step: int) -> Batch:
            here, taps, *offsets = (drawn[step] if shift else at_once(step)).T
            examples = self._make_training_batch(here, taps, wanted, (seed, step))
            return shift_examples(examples, np.stack(offsets, axis=-1)) if shift else examples

        def from_step(start_step: int = 0) -> Iterator[Batch]:
            return map(at, itertools.count(start_step))

        return from_step

    def _make_training_batch(
        self, here: np.ndarray, taps: np.ndarray, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        """Training examples of the rows `here`, with the taps of other rows. `seed`: of this step, for what else is drawn."""
        rows = self.rows("train")
        return self._images(
            {name: rows[name][taps if name in TAP_FIELDS else here] for name in fields}
        )

    def _images(self, rows: Batch) -> Batch:
        return {
            name: self._image(value) if name in IMAGES else value for name, value in rows.items()
        }

    def _image(self, stored: np.ndarray) -> np.ndarray:
        """One bit a pixel, or grey as it is."""
        grey = stored.shape[-2:] == (self._size, self._size)
        return (stored if grey else unpack_bits(stored, self._size))[..., None]


class SetReader(Reader):
    """One set on disk."""

    def __init__(self, settings: DataSettings, folder: Path, metadata: dict) -> None:
        super().__init__(self._load, settings.preprocess.size)
        self.settings, self.folder, self.metadata = settings, folder, metadata

    def length(self, split: str) -> int:
        if split not in SPLITS:
            raise UserError(f"split '{split}' is unknown: use one of {', '.join(SPLITS)}")
        return self.metadata["counts"]["written"][split]

    def _load(self, split: str) -> Batch:
        count = self.length(split)
        try:
            rows = _read_rows(self.folder, split, count, _check_shards(self.folder, split))
            return (
                rows | {"felt": to_sensor_frame(rows["move"], rows["pose"])}
                if isinstance(self.settings, PairedData)
                else rows
            )
        except UserError:
            raise
        except Exception as error:  # whatever a damaged file makes of itself
            raise_machine_error(self.folder, error)
            raise make_damage_error(self.folder, get_first_line(error)) from error


def open_set(
    settings: DataSettings,
    data_dir: Path,
    sensor: Sensor = TACTIP_331,
    kind: type[SetReader] = SetReader,
) -> SetReader:
    """The set made with `settings`. Raises `UserError` if it is missing or was made with other settings."""
    return kind(
        settings,
        get_set_folder(settings, sensor, data_dir),
        read_metadata(settings, sensor, data_dir),
    )


def to_sensor_frame(move: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Slides (N, 2) mm, or (N, 3) with their turn, deg, as the sensor at `pose` (N, 4) or (N, 6) feels them: in its own frame."""
    return np.concatenate(
        [rotate_2d(move[:, :2], np.radians(-pose[:, 2])), move[:, 2:]], axis=1
    ).astype(np.float32)


def shift_examples(examples: Batch, offsets: np.ndarray) -> Batch:
    """Moves images (B, S, S, 1) by `offsets` (B, 2), integer pixels (col, row), black flowing in, and pins with them."""
    moved = dict(examples)
    for name in examples.keys() & set(IMAGES):
        size = examples[name].shape[1]
        moved[name] = np.zeros_like(examples[name])
        for to, image, (columns, rows) in zip(
            moved[name], examples[name], offsets.tolist(), strict=True
        ):
            down, right = _overlap(rows, size), _overlap(columns, size)
            to[down[0], right[0]] = image[down[1], right[1]]
    for name in examples.keys() & set(PINS):
        moved[name] = examples[name] + offsets[:, None].astype(np.float32)
    return moved


def _overlap(offset: int, size: int) -> tuple[slice, slice]:
    """Where a shifted axis lands, and what of it stays in view."""
    return slice(max(offset, 0), size + min(offset, 0)), slice(
        max(-offset, 0), size - max(offset, 0)
    )


def _make_shuffle(count: int, batch: int, seed: int) -> Callable[[int], np.ndarray]:
    """Step -> the rows (batch,) of its examples: all `count` of them in every epoch, in another order. Drawing these one by one takes
    longer than a step of a small network over pins."""

    @functools.lru_cache(maxsize=2)
    def epoch(number: int) -> np.ndarray:
        return np.random.default_rng((seed, number)).permutation(count)

    def rows(step: int) -> np.ndarray:
        numbers, places = np.divmod(np.arange(step * batch, (step + 1) * batch), count)
        return np.concatenate(
            [epoch(at)[places[numbers == at]] for at in range(numbers[0], numbers[-1] + 1)]
        )

    return rows


def _check_shards(folder: Path, split: str) -> tuple[str, ...]:
    """Compares every shard of a split with its checksum from when it was written; returns the checksums."""
    from jaxunshear.data.builders.stored import compute_sha256

    try:
        sums = read_object(folder / MANIFEST)
    except UserError as error:
        raise_machine_error(folder / MANIFEST, error)
        raise make_damage_error(folder, MANIFEST) from error
    shards = sorted(name for name in sums if f"-{split}." in name)
    for name in shards:
        path = folder / name
        if not path.exists():
            raise UserError(f"shard {path} is missing: {format_remedy(folder)}")
        if compute_sha256(path) != sums[name]:
            raise UserError(f"shard {path} is truncated or damaged: {format_remedy(folder)}")
    return tuple(sums[name] for name in shards)


# The stages of a run, one process, open the same sets one after the other.
@functools.lru_cache(maxsize=2 * len(SPLITS))
def _read_rows(folder: Path, split: str, count: int, sums: tuple[str, ...]) -> Batch:
    """All fields of a split, (count, ...) each, read-only; images at one bit a pixel. `sums` are those of its shards: a set made anew
    is read anew."""
    import tensorflow_datasets as tfds

    builder = tfds.builder_from_directory(folder)
    features = builder.info.features
    images = [name for name in IMAGES if name in features]
    source = builder.as_data_source(
        split, decoders={name: tfds.decode.SkipDecoding() for name in images}
    )
    if len(source) != count:
        raise UserError(
            f"{folder} holds {len(source)} examples of split '{split}', its metadata says {count}: delete it"
        )
    rows: Batch = {}
    for name, feature in features.items():
        if name in images:
            bits = -(-feature.shape[0] * feature.shape[1] // 8)
            rows[name] = _room(folder, (count, bits), len(images))
        else:
            dtype = np.int32 if np.issubdtype(feature.np_dtype, np.integer) else feature.np_dtype
            rows[name] = np.zeros((count, *feature.shape), dtype)
    for index in range(count):
        for name, value in source[index].items():
            rows[name][index] = (
                pack_bits(np.asarray(Image.open(io.BytesIO(value)))[None])[0]
                if name in images
                else value
            )
    for value in rows.values():
        value.flags.writeable = False
    return rows


def _room(folder: Path, shape: tuple[int, int], images: int) -> np.ndarray:
    """Bytes in memory, or in an unlinked file if all of a split's `images` fields together are too large."""
    if images * shape[0] * shape[1] <= MAX_MEMORY_BYTES:
        return np.zeros(shape, np.uint8)
    beside = (
        folder.parent if os.access(folder.parent, os.W_OK) else None
    )  # data that are shared may be read-only
    return np.memmap(tempfile.TemporaryFile(dir=beside), np.uint8, "w+", shape=shape)
