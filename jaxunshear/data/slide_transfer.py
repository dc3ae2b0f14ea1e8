"""Slides to the taps of a task that has no slides, by the motions in slides of other tasks.

>>> move = make_slide_transfer(readers, rest)  # of pairs of other tasks; pins at rest (P, 2) px
>>> pins, slides = move(taps, "train", generator)  # (N, P, 2) px, (N, 6) mm and deg

A slide drags the skin, mostly in one direction; what it touches matters less. How far the skin
moves does depend on the object, so the motion is scaled by a random factor. Where the object is at
a place, as an edge is, the skin moves past it: other pins then show its shape.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay

from jaxunshear.data.chunks import join_field
from jaxunshear.data.pairing import take_rows
from jaxunshear.data.reader import Batch, DrawnRows, Reader
from jaxunshear.data.recorded_set import RecordedSet

FACTOR = (0.15, 2.5)  # of a motion; drawn evenly in its logarithm


class MovedTaps(NamedTuple):
    """Taps after slides."""

    pins: np.ndarray  # (N, P, 2) px
    move: np.ndarray  # (N, 6) the slides, mm and deg


# pins of taps (N, P, 2) px, split, generator
SlideTransfer = Callable[[np.ndarray, str, np.random.Generator], MovedTaps]


def make_slide_transfer(
    readers: Sequence[Reader], rest: Float[np.ndarray, "P 2"], is_placed: bool = False
) -> SlideTransfer:
    """Make the function that moves taps as the slides of `readers` did whose pins are all seen.

    Args:
        rest: the untouched pins of the taps, px.
        is_placed: whether the object of the taps is at a place; else it extends under all the skin.
    """
    triangles = Delaunay(rest) if is_placed else None

    @cache
    def read_motions(split: str) -> Batch:
        parts = [_read_motions(reader, split) for reader in readers]
        return {name: join_field(parts, name) for name in ("motion", "move")}

    def move(taps: np.ndarray, split: str, generator: np.random.Generator) -> MovedTaps:
        slides, (low, high) = read_motions(split), np.log(FACTOR)
        drawn = generator.integers(len(slides["move"]), size=len(taps))
        factor = np.exp(generator.uniform(low, high, (len(taps), 1, 1)))
        motion = factor * slides["motion"][drawn]
        shown = taps if triangles is None else rest + _show_motions(triangles, taps - rest, motion)
        return MovedTaps((shown + motion).astype(np.float32), slides["move"][drawn])

    return move


def give_slides(stored: RecordedSet, transfer: SlideTransfer, split: str) -> Batch:
    """Give a slide to each labelled tap of a split; see `pairing.SlideSimulator`."""
    pins = stored.read_labelled_taps(split)["pins"]
    moved = transfer(pins, split, np.random.default_rng([*split.encode()]))
    return {"row": np.arange(len(pins)), "sheared_pins": moved.pins, "move": moved.move}


class TransferReader(Reader):
    """Reads pairs of several tasks; those of tasks without slides get other ones in each batch."""

    def __init__(
        self, load: Callable[[str], Batch], size: int, transfers: Mapping[int, SlideTransfer]
    ) -> None:
        super().__init__(load, size)
        self._transfers = transfers  # by task

    def _make_training_batch(
        self, drawn: DrawnRows, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        batch = super()._make_training_batch(drawn, fields, seed)
        for task, transfer in self._transfers.items() if "sheared_pins" in batch else ():
            rows = np.flatnonzero(batch["stimulus"] == task)
            generator = np.random.default_rng([task, *seed])
            moved = transfer(batch["canonical_pins"][rows], "train", generator)
            batch["sheared_pins"][rows] = moved.pins
        return batch


def _show_motions(
    triangles: Delaunay, motion: Float[np.ndarray, "N P 2"], slide: Float[np.ndarray, "N P 2"]
) -> Float[np.ndarray, "N P 2"]:
    """Interpolate the motions in taps at pins that a slide has moved; beyond the rim they stay."""
    places = (triangles.points + slide).reshape(-1, 2)
    found = triangles.find_simplex(places)
    corners = triangles.simplices[found]
    transform = triangles.transform[found]
    first_two = np.einsum("nij,nj->ni", transform[:, :2], places - transform[:, 2])
    weights = np.concatenate([first_two, 1 - first_two.sum(axis=1, keepdims=True)], axis=1)
    tap = np.repeat(np.arange(len(motion)), motion.shape[1])
    shown = np.einsum("nc,nci->ni", weights, motion[tap[:, None], corners])
    shown = np.where((found >= 0)[:, None], shown, motion.reshape(-1, 2))
    return np.where(np.isfinite(motion), shown.reshape(motion.shape), np.nan)


def _read_motions(reader: Reader, split: str) -> Batch:
    rows = reader.rows(split)
    motion = rows["sheared_pins"] - rows["canonical_pins"]
    is_seen = np.isfinite(motion).all(axis=(1, 2)) & (rows["sure"] == 1)
    return take_rows({"motion": motion, "move": rows["move"]}, is_seen)
