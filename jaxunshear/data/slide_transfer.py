"""Slides to the taps of a task that has no slides, by the motions in slides of other tasks.

>>> move = make_slide_transfer(readers)  # of pairs of other tasks
>>> pins, slides = move(taps, "train", generator)  # (N, P, 2) px, (N, 6) mm and deg

A slide drags the skin, mostly in one direction; what it touches matters less. How far the skin
moves does depend on the object, so the motion is scaled by a random factor.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

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


def make_slide_transfer(readers: Sequence[Reader]) -> SlideTransfer:
    """Make the function that moves taps as the slides of `readers` did whose pins are all seen."""

    @cache
    def read_motions(split: str) -> Batch:
        parts = [_read_motions(reader, split) for reader in readers]
        return {name: join_field(parts, name) for name in ("motion", "move")}

    def move(taps: np.ndarray, split: str, generator: np.random.Generator) -> MovedTaps:
        slides, (low, high) = read_motions(split), np.log(FACTOR)
        drawn = generator.integers(len(slides["move"]), size=len(taps))
        factor = np.exp(generator.uniform(low, high, (len(taps), 1, 1)))
        pins = (taps + factor * slides["motion"][drawn]).astype(np.float32)
        return MovedTaps(pins, slides["move"][drawn])

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


def _read_motions(reader: Reader, split: str) -> Batch:
    rows = reader.rows(split)
    motion = rows["sheared_pins"] - rows["canonical_pins"]
    is_seen = np.isfinite(motion).all(axis=(1, 2)) & (rows["sure"] == 1)
    return take_rows({"motion": motion, "move": rows["move"]}, is_seen)
