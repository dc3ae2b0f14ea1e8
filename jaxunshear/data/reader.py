"""Read examples in batches that depend on the seed and the step alone.

Training batches are shuffled, and paired anew: each slide with any tap at its pose. Images are
shifted if `shift` is above zero. grain draws the rows and the shifts.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import grain
import numpy as np

from jaxunshear.angles import rotate_2d
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import join_field, unpack_bits
from jaxunshear.errors import UserError
from jaxunshear.selection import number_poses

IMAGES = ("image", "canonical", "sheared", "other", "swapped")
PINS = ("pins", "canonical_pins", "sheared_pins", "other_pins", "swapped_pins")
TAP_FIELDS = ("canonical", "canonical_pins", "tap_id", "tap_depth_mm")  # what re-pairing exchanges
# Swap partners, for slides that poses share: "other" is another pose after another slide, "swapped"
# the example's own pose after that other slide. By field, the stored field they are taken from.
SHEARED_PINS, OTHER_PINS, SWAPPED_PINS = PINS[2:]
SHEARED_IMAGE, OTHER_IMAGE, SWAPPED_IMAGE = IMAGES[2:]
PARTNERS = {
    OTHER_PINS: SHEARED_PINS,
    SWAPPED_PINS: SHEARED_PINS,
    OTHER_IMAGE: SHEARED_IMAGE,
    SWAPPED_IMAGE: SHEARED_IMAGE,
}
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
        check_split(split)
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
        their pins with them. A sheared image is paired with a random tap of its `pose_id`; alone in
        it, with its own.
        """
        rows = self.rows("train")
        groups, count = group_by_pose(rows["stimulus"], rows["pose_id"]), self.length("train")
        if shift:
            draw = _draw_with_shifts(groups, count, batch, seed, shift * self._size)
        else:
            draw = _draw_without_shifts(groups, count, batch, seed)

        def make_batch(step: int) -> Batch:
            drawn = draw(step)
            made = self._make_training_batch(drawn, fields or tuple(rows), (seed, step))
            return made if drawn.offsets is None else shift_examples(made, drawn.offsets)

        def iterate_from(start_step: int = 0) -> Iterator[Batch]:
            return map(make_batch, itertools.count(start_step))

        return iterate_from

    def _make_training_batch(
        self, drawn: "DrawnRows", fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        """Make training examples; `seed`, of this step, is for what a subclass draws."""
        batch: Batch = {}
        for name in fields:
            selected = drawn.taps if name in TAP_FIELDS else drawn.rows
            batch[name] = self.rows("train")[name][selected]
        return self._unpack_images(batch)

    def _unpack_images(self, rows: Batch) -> Batch:
        """Unpack images at one bit a pixel; grey ones stay as they are."""
        unpacked = dict(rows)
        for name in rows.keys() & set(IMAGES):
            stored = rows[name]
            is_grey = stored.shape[-2:] == (self._size, self._size)
            unpacked[name] = (stored if is_grey else unpack_bits(stored, self._size))[..., None]
        return unpacked


def concatenate_batches(batches: Sequence[Batch]) -> Batch:
    """Concatenate the arrays of all batches, name by name."""
    return {name: join_field(batches, name) for name in batches[0]}


def check_split(split: str) -> None:
    if split not in SPLITS:
        raise UserError(f"split '{split}' is unknown: use one of {', '.join(SPLITS)}")


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
            height, width = size - abs(down), size - abs(right)
            visible = image[max(-down, 0) :, max(-right, 0) :][:height, :width]
            target[max(down, 0) :, max(right, 0) :][:height, :width] = visible
    for name in examples.keys() & set(PINS):
        shifted[name] = examples[name] + offsets[:, None].astype(np.float32)
    return shifted


class PoseGroups(NamedTuple):
    """Rows by pose."""

    group: np.ndarray  # (N,) of each row
    rank: np.ndarray  # (N,) of each row in its group
    members: np.ndarray  # (N,) rows, group by group
    start: np.ndarray  # (groups,) where each begins in `members`
    size: np.ndarray  # (groups,)

    def get_group(self, row: int) -> np.ndarray:
        """Return all rows of a row's group, itself among them."""
        start = self.start[self.group[row]]
        return self.members[start : start + self.size[self.group[row]]]

    def sample_any(self, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Sample one row (B,) of each row's group."""
        group = self.group[rows]
        return self.members[self.start[group] + generator.integers(self.size[group])]

    def sample_other(self, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Sample another row (B,) of each row's group, or itself if there is no other."""
        group = self.group[rows]
        rank = sample_next(self.rank[rows], self.size[group], generator)
        return self.members[self.start[group] + rank]


def sample_next(index: np.ndarray, size: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Sample another index (B,) below `size` (B,), or the same if there is but one."""
    return (index + 1 + generator.integers(np.maximum(size - 1, 1))) % size


def group_by_pose(stimulus: np.ndarray, pose: np.ndarray) -> PoseGroups:
    """Group rows (N,) by their stimulus and the number of their pose on it."""
    group = number_poses(stimulus, pose)
    members, size = np.argsort(group, kind="stable"), np.bincount(group)
    start = np.cumsum(size) - size
    rank = np.empty_like(members)
    rank[members] = np.arange(len(members)) - start[group[members]]
    return PoseGroups(group, rank, members, start, size)


class DrawnRows(NamedTuple):
    """The rows of a step's B examples."""

    rows: np.ndarray  # (B,)
    taps: np.ndarray  # (B,) of the same poses, whose taps they are paired with
    offsets: np.ndarray | None = None  # (B, 2) px (col, row), by which images are shifted


def _draw_with_shifts(
    groups: PoseGroups, count: int, batch: int, seed: int, max_shift_px: float
) -> Callable[[int], DrawnRows]:
    """Return a function that draws the rows of a step."""

    def draw_example(row: int, generator: np.random.Generator) -> np.ndarray:
        offset = np.rint(generator.uniform(-max_shift_px, max_shift_px, 2)).astype(int)
        return np.array([row, generator.choice(groups.get_group(row)), *offset])

    shuffled = grain.MapDataset.range(count).seed(seed).shuffle().repeat()
    examples = shuffled.random_map(draw_example).batch(batch)

    def draw(step: int) -> DrawnRows:
        rows, taps, *offsets = examples[step].T
        return DrawnRows(rows, taps, np.stack(offsets, axis=-1))

    return draw


def _draw_without_shifts(
    groups: PoseGroups, count: int, batch: int, seed: int
) -> Callable[[int], DrawnRows]:
    """Return a function that draws the rows of a step.

    Every epoch has all `count` rows, in another order. Drawing these one by one would take longer
    than a step of a small network over pins.
    """

    @functools.lru_cache(maxsize=2)
    def permute(epoch: int) -> np.ndarray:
        return np.random.default_rng((seed, epoch)).permutation(count)

    def draw(step: int) -> DrawnRows:
        epochs, places = np.divmod(np.arange(step * batch, (step + 1) * batch), count)
        parts = [
            permute(epoch)[places[epochs == epoch]] for epoch in range(epochs[0], epochs[-1] + 1)
        ]
        rows = np.concatenate(parts)
        # other draws of a step are seeded by (seed, step)
        return DrawnRows(rows, groups.sample_any(rows, np.random.default_rng((seed, step, 1))))

    return draw
