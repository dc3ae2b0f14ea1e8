"""Slides to the taps of a task that has no slides, by the motions in slides of other tasks.

>>> move = make_slide_transfer(readers, rest)  # of pairs of other tasks; pins at rest (P, 2) px
>>> slides = move(taps, "train", generator)  # pins (N, P, 2) px

A slide drags the skin, mostly in one direction; what it touches matters less. How far the skin
moves does depend on the object, so the motion is scaled by a random factor. Where the object is at
a place, as an edge is, the skin moves past it: other pins then show its shape.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay

from jaxunshear.data.reader import Batch, DrawnRows, Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.errors import UserError

FACTOR = (0.15, 2.5)  # of a motion; drawn evenly in its logarithm


# pins of taps (N, P, 2) px, split, generator -> pins of slides
SlideTransfer = Callable[[np.ndarray, str, np.random.Generator], np.ndarray]


def make_slide_transfer(
    readers: Sequence[Reader], rest: Float[np.ndarray, "P 2"], is_placed: bool = False
) -> SlideTransfer:
    """Make the function that moves taps as the slides of `readers` did whose pins are all seen.

    It raises UserError if there are none.

    Args:
        rest: the untouched pins of the taps, px.
        is_placed: whether the object of the taps is at a place; else it extends under all the skin.
    """
    triangles = Delaunay(rest) if is_placed else None

    @cache
    def read_motions(split: str) -> np.ndarray:
        motions = np.concatenate([_read_motions(reader, split) for reader in readers])
        if not len(motions):
            raise UserError(
                f"no {split} slide of the other tasks shows all pins, so none can be transferred: "
                "record slides of each task"
            )
        return motions

    def move(taps: np.ndarray, split: str, generator: np.random.Generator) -> np.ndarray:
        motions, (low, high) = read_motions(split), np.log(FACTOR)
        drawn = generator.integers(len(motions), size=len(taps))
        motion = np.exp(generator.uniform(low, high, (len(taps), 1, 1))) * motions[drawn]
        shown = taps if triangles is None else rest + _show_motions(triangles, taps - rest, motion)
        return (shown + motion).astype(np.float32)

    return move


def give_slides(stored: RecordedSet, transfer: SlideTransfer, split: str) -> Batch:
    """Give a slide to each labelled tap of a split; see `pairing.SlideSimulator`.

    Its label is unknown: labels are in the frame of the other task's, and motions are scaled.
    """
    pins = stored.read_labelled_taps(split)["pins"]
    slides = transfer(pins, split, np.random.default_rng([*split.encode()]))
    unknown = np.full((len(pins), 6), np.nan, np.float32)
    return {"row": np.arange(len(pins)), "sheared_pins": slides, "move": unknown}


class TransferReader(Reader):
    """Reads pairs of several tasks; draws new slides in each batch for tasks without any."""

    def __init__(
        self, load: Callable[[str], Batch], size: int, transfers: Mapping[int, SlideTransfer]
    ) -> None:
        super().__init__(load, size)
        self._transfers = transfers  # by task

    def _make_training_batch(
        self, drawn: DrawnRows, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        batch = super()._make_training_batch(drawn, fields, seed)
        for task, transfer in self._transfers.items():
            rows = np.flatnonzero(batch["stimulus"] == task)
            generator = np.random.default_rng([task, *seed])
            taps = batch["canonical_pins"][rows]
            batch["sheared_pins"][rows] = transfer(taps, "train", generator)
        return batch


def _show_motions(
    triangles: Delaunay, motion: Float[np.ndarray, "N P 2"], slide: Float[np.ndarray, "N P 2"]
) -> Float[np.ndarray, "N P 2"]:
    """Interpolate the motions in taps at pins that a slide has moved.

    Beyond the rim, and between pins none of which is seen, a pin keeps its motion.
    """
    places = (triangles.points + slide).reshape(-1, 2)
    found = triangles.find_simplex(places)
    corners = triangles.simplices[found]
    transform = triangles.transform[found]
    first_two = np.einsum("nij,nj->ni", transform[:, :2], places - transform[:, 2])
    weights = np.concatenate([first_two, 1 - first_two.sum(axis=1, keepdims=True)], axis=1)
    tap = np.repeat(np.arange(len(motion)), motion.shape[1])
    between = motion[tap[:, None], corners]
    weights = np.where(np.isfinite(between).all(axis=-1), weights, 0)
    total = weights.sum(axis=1, keepdims=True)
    is_inside = (found >= 0)[:, None] & (total > 0)
    shown = np.einsum("nc,nci->ni", weights, np.nan_to_num(between)) / np.where(total > 0, total, 1)
    shown = np.where(is_inside, shown, motion.reshape(-1, 2))
    return np.where(np.isfinite(motion), shown.reshape(motion.shape), np.nan)


def _read_motions(reader: Reader, split: str) -> Float[np.ndarray, "N P 2"]:
    rows = reader.rows(split)
    motion = rows["sheared_pins"] - rows["canonical_pins"]
    return motion[np.isfinite(motion).all(axis=(1, 2)) & (rows["sure"] == 1)]
