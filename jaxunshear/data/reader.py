"""Read a data set in batches that depend on the seed and the step alone.

Training batches are shuffled, and paired anew: each slide with any tap at its pose. Images are
shifted by processes of grain, if `shift` is above zero.

    paired = open_set(experiment.paired, data_dir, experiment.sensor)
    steps = paired.train_batches(batch=16, seed=0, shift=0.015)(start_step=0)
    next(steps)["sheared"]  # (16, 128, 128, 1) uint8 in {0, 255}

A split is decoded once and held in memory at one bit a pixel: 9 MB of images for the demo's
training pairs, 0.9 GB for the paper's.
"""

import functools
import io
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import grain
import numpy as np
from PIL import Image

from jaxunshear.angles import rotate_2d
from jaxunshear.config.configs import MANIFEST, get_set_folder
from jaxunshear.config.data import DataSettings
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import pack_bits, unpack_bits
from jaxunshear.data.generation import format_remedy, make_damage_error, read_metadata
from jaxunshear.data.pose_groups import group_by_pose
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import raise_machine_error, read_object

IMAGES = ("image", "canonical", "sheared", "other", "swapped")  # the last two as in `factorial`
PINS = ("pins", "canonical_pins", "sheared_pins", "other_pins", "swapped_pins")
TAP_FIELDS = ("canonical", "canonical_pins", "tap_id", "tap_depth_mm")  # what re-pairing exchanges
Batch = dict[str, np.ndarray]


class Reader:
    """Holds examples in memory.

    Images are (B, S, S, 1) uint8 in {0, 255}, pins (B, P, 2) float32 px (col, row), poses mm and
    deg; the other fields are those of the data card. `fields` selects some, all of them if None.

    `load`: split -> its rows by field, images at one bit a pixel (`chunks.pack_bits`), or
    (N, S, S) uint8 if they are grey.
    """

    def __init__(self, load: Callable[[str], Batch], size: int) -> None:
        self.rows, self._size = functools.cache(load), size  # rows: all of a split as it is stored

    def length(self, split: str) -> int:
        """Return the number of examples of a split."""
        _check_split(split)
        return len(next(iter(self.rows(split).values())))

    def split(self, name: str, batch: int, fields: Sequence[str] | None = None) -> Iterator[Batch]:
        """Iterate once over a split, in its stored order and pairing.

        The last batch may be smaller.
        """
        selected, count = fields or tuple(self.rows(name)), self.length(name)
        for start in range(0, count, batch):
            yield self.take(name, np.arange(start, min(start + batch, count)), selected)

    def take(self, name: str, rows: np.ndarray, fields: Sequence[str]) -> Batch:
        """Return rows (B,) of a split, in this order."""
        stored = self.rows(name)
        return self._unpack_images({field: stored[field][rows] for field in fields})

    def train_batches(
        self, batch: int, seed: int, shift: float, fields: Sequence[str] | None = None
    ) -> Callable[[int], Iterator[Batch]]:
        """Return a function that iterates over training batches without end, from any step on.

        Every epoch is shuffled anew. `shift` is the largest random shift along each axis as a
        fraction of the image size, rounded to integer pixels; both images of a pair shift alike and
        their pins with them. A sheared image is paired with a random tap of its pose.
        """
        fields = fields or tuple(self.rows("train"))
        if shift:
            make_batch = self._make_shifted_batches(batch, seed, shift * self._size, fields)
        else:
            make_batch = self._make_plain_batches(batch, seed, fields)

        def iterate_from(start_step: int = 0) -> Iterator[Batch]:
            return map(make_batch, itertools.count(start_step))

        return iterate_from

    def _make_shifted_batches(
        self, batch: int, seed: int, max_shift_px: float, fields: Sequence[str]
    ) -> Callable[[int], Batch]:
        rows = self.rows("train")
        groups = group_by_pose(rows["stimulus"], rows["pose_id"])

        def draw_example(row: int, generator: np.random.Generator) -> np.ndarray:
            offset = np.rint(generator.uniform(-max_shift_px, max_shift_px, 2)).astype(int)
            return np.array([row, generator.choice(groups.get_group(row)), *offset])

        examples = (
            grain.MapDataset.range(self.length("train"))
            .seed(seed)
            .shuffle()
            .repeat()
            .random_map(draw_example)
            .batch(batch)
        )

        def make_batch(step: int) -> Batch:
            here, taps, *offsets = examples[step].T
            unshifted = self._make_training_batch(here, taps, fields, (seed, step))
            return shift_examples(unshifted, np.stack(offsets, axis=-1))

        return make_batch

    def _make_plain_batches(
        self, batch: int, seed: int, fields: Sequence[str]
    ) -> Callable[[int], Batch]:
        rows = self.rows("train")
        groups = group_by_pose(rows["stimulus"], rows["pose_id"])
        select_rows = _make_shuffle(self.length("train"), batch, seed)

        def make_batch(step: int) -> Batch:
            here = select_rows(step)
            # other draws of a step are seeded by (seed, step)
            taps = groups.sample_any(here, np.random.default_rng((seed, step, 1)))
            return self._make_training_batch(here, taps, fields, (seed, step))

        return make_batch

    def _make_training_batch(
        self, here: np.ndarray, taps: np.ndarray, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        """Make training examples of the rows `here`, with the taps of other rows.

        `seed`, of this step, is for what a subclass draws.
        """
        rows = self.rows("train")
        return self._unpack_images(
            {name: rows[name][taps if name in TAP_FIELDS else here] for name in fields}
        )

    def _unpack_images(self, rows: Batch) -> Batch:
        return {
            name: self._unpack_image(value) if name in IMAGES else value
            for name, value in rows.items()
        }

    def _unpack_image(self, stored: np.ndarray) -> np.ndarray:
        """Unpack images at one bit a pixel; grey ones stay as they are."""
        is_grey = stored.shape[-2:] == (self._size, self._size)
        return (stored if is_grey else unpack_bits(stored, self._size))[..., None]


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise UserError(f"split '{split}' is unknown: use one of {', '.join(SPLITS)}")


class SetReader(Reader):
    """Reads one set on disk."""

    def __init__(self, settings: DataSettings, folder: Path, metadata: dict) -> None:
        super().__init__(self._load, settings.preprocess.size)
        self.settings, self.folder, self.metadata = settings, folder, metadata

    def length(self, split: str) -> int:
        _check_split(split)
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
            raise make_damage_error(self.folder, get_first_line(error)) from error


def open_set(
    settings: DataSettings,
    data_dir: Path,
    sensor: Sensor = TACTIP_331,
    kind: type[SetReader] = SetReader,
) -> SetReader:
    """Open the set made with `settings`.

    Raises `UserError` if it is missing or was made with other settings.
    """
    folder = get_set_folder(settings, sensor, data_dir)
    return kind(settings, folder, read_metadata(settings, sensor, data_dir))


def to_sensor_frame(move: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Convert slides to the sensor frame at `pose` (N, 4) or (N, 6).

    Slides are (N, 2) mm, or (N, 3) with their twist, deg.
    """
    rotated = rotate_2d(move[:, :2], np.radians(-pose[:, 2]))
    return np.concatenate([rotated, move[:, 2:]], axis=1).astype(np.float32)


def shift_examples(examples: Batch, offsets: np.ndarray) -> Batch:
    """Shift images (B, S, S, 1), and pins with them, by `offsets` (B, 2), integer px (col, row).

    Black flows in.
    """
    shifted = dict(examples)
    for name in examples.keys() & set(IMAGES):
        size = examples[name].shape[1]
        shifted[name] = np.zeros_like(examples[name])
        pairs = zip(shifted[name], examples[name], offsets.tolist(), strict=True)
        for target, image, (right, down) in pairs:
            rows, columns = _find_overlap(down, size), _find_overlap(right, size)
            target[rows.target, columns.target] = image[rows.source, columns.source]
    for name in examples.keys() & set(PINS):
        shifted[name] = examples[name] + offsets[:, None].astype(np.float32)
    return shifted


class _Overlap(NamedTuple):
    """Where a shifted axis lands, and which part of it stays in view."""

    target: slice
    source: slice


def _find_overlap(offset: int, size: int) -> _Overlap:
    target = slice(max(offset, 0), size + min(offset, 0))
    return _Overlap(target, slice(max(-offset, 0), size - max(offset, 0)))


def _make_shuffle(count: int, batch: int, seed: int) -> Callable[[int], np.ndarray]:
    """Return a function from a step to the rows (batch,) of its examples.

    Every epoch has all `count` of them, in another order. Drawing these one by one would take
    longer than a step of a small network over pins.
    """

    @functools.lru_cache(maxsize=2)
    def permute(epoch: int) -> np.ndarray:
        return np.random.default_rng((seed, epoch)).permutation(count)

    def select_rows(step: int) -> np.ndarray:
        epochs, places = np.divmod(np.arange(step * batch, (step + 1) * batch), count)
        parts = [
            permute(epoch)[places[epochs == epoch]] for epoch in range(epochs[0], epochs[-1] + 1)
        ]
        return np.concatenate(parts)

    return select_rows


def _check_shards(folder: Path, split: str) -> tuple[str, ...]:
    """Compare every shard of a split with its checksum; returns the checksums.

    Raises UserError for a shard that is missing or damaged.
    """
    from jaxunshear.data.builders import compute_sha256

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
            rows[name][index] = _pack_png(value) if name in images else value
    for value in rows.values():
        value.flags.writeable = False
    return rows


def _pack_png(data: bytes) -> np.ndarray:
    return pack_bits(np.asarray(Image.open(io.BytesIO(data)))[None])[0]
