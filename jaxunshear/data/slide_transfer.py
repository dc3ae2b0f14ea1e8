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
from jaxunshear.triangles import find_corners

FACTOR = (0.15, 2.5)  # of a motion; drawn evenly in its logarithm


# pins of taps (N, P, 2) px, split, generator -> pins of slides
SlideTransfer = Callable[[np.ndarray, str, np.random.Generator], np.ndarray]


def make_slide_transfer(
    readers: Sequence[Reader], rest: Float[np.ndarray, "P 2"], is_placed: bool = False
) -> SlideTransfer:
    """Make the function that moves taps as the slides of `readers` did whose pins are all seen.

    It raises UserError if there are none.

    Args:
        rest: the untouched pins of the taps, px; taps of a moved frame may be given, too.
        is_placed: whether the object of the taps is at a place; else it extends under all the skin.
    """
    mesh = Delaunay(rest) if is_placed else None

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
        slides = taps + motion if mesh is None else _move_past(mesh, taps, motion)
        return slides.astype(np.float32)

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


def _move_past(
    mesh: Delaunay, taps: Float[np.ndarray, "N P 2"], motion: Float[np.ndarray, "N P 2"]
) -> Float[np.ndarray, "N P 2"]:
    """Move pins past an object that stays: each shows what pins of the tap show where it gets to.

    Beyond the rim and beside missing pins, a pin takes what it shows with it.
    """
    slides, places = taps + motion, (mesh.points + motion).reshape(-1, 2)
    corners, weights, is_outside = find_corners(mesh, places)
    tap = np.arange(len(taps)).repeat(taps.shape[1])
    shown = np.einsum("nc,nci->ni", weights, taps[tap[:, None], corners])
    shown[is_outside] = np.nan
    shown = shown.reshape(taps.shape)
    return np.where(np.isfinite(slides + shown), shown, slides)


def _read_motions(reader: Reader, split: str) -> Float[np.ndarray, "N P 2"]:
    rows = reader.rows(split)
    motion = rows["sheared_pins"] - rows["canonical_pins"]
    return motion[np.isfinite(motion).all(axis=(1, 2)) & (rows["sure"] == 1)]
