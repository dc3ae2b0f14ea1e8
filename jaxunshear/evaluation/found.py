"""Pins found in simulated images, in the place of the simulator's true ones: what networks over pins read where there is but a camera.

>>> found = found_pairs(pairs, lattice, FIELDS)
>>> gather(run, batches_of(found, 32), len(found.pairs["pose"]), 0, targets, inputs=INPUTS)

Slide and tap are both found; what comes out is compared with the tap's true pins. Each image is followed by itself, as a robot sees it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxunshear.dataset.reader import Batch, Reader
from jaxunshear.evaluation.gather import IMAGES, PINS
from jaxunshear.evenly import evenly
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.pin_tracking import track_images

FOUND = "found"  # the name of this test
MOST = 480  # slides, evenly chosen, each with its tap: some 15 ms an image
SEEN_TAP = "seen_tap"
INPUTS = (*PINS, SEEN_TAP)  # the true tap, the slide and the tap as found


class FoundPairs(NamedTuple):
    """Test pairs whose tap and slide were both followed for sure."""

    pairs: Batch  # `sheared_pins` and SEEN_TAP (N, P, 2) px, NaN where a pin is not seen; `canonical_pins` true ones
    # of taps and slides, what share was followed, how far found pins are off, how many are missing
    reported: dict[str, dict[str, float]]


def found_pairs(reader: Reader, lattice: Lattice, fields: Sequence[str]) -> FoundPairs | None:
    """None where no pair can be followed, as in images too small to show pins."""
    count = reader.length("test")
    rows = evenly(count, MOST)
    batch = reader.take("test", rows, fields)
    reported: dict[str, dict[str, float]] = {}
    places: dict[str, np.ndarray] = {}
    sure = np.ones(len(rows), bool)
    for kind, image, true in zip(("tap", "sheared"), IMAGES, PINS, strict=True):
        motion, known = track_images(lattice, batch[image][..., 0], independent=True)
        places[true] = (lattice.rest + motion).astype(np.float32)
        reported[kind] = _reported(places[true][known], batch[true][known], len(rows))
        sure &= known
    if not sure.any():
        return None
    pairs = {name: values for name, values in batch.items() if name not in IMAGES}
    pairs |= {PINS[1]: places[PINS[1]], SEEN_TAP: places[PINS[0]]}
    return FoundPairs({name: values[sure] for name, values in pairs.items()}, reported)


def batches_of(found: FoundPairs, batch: int) -> Iterator[Batch]:
    for start in range(0, len(found.pairs[SEEN_TAP]), batch):
        yield {name: values[start : start + batch] for name, values in found.pairs.items()}


def _reported(found: np.ndarray, true: np.ndarray, images: int) -> dict[str, float]:
    seen = np.isfinite(found).all(-1)
    squares = np.sum(np.square(found - true), axis=-1)[seen]
    return {
        "images": images,
        "followed": len(found) / images,
        "rms_px": float(np.sqrt(squares.mean())) if len(squares) else float("nan"),
        "missing_per_image": float((~seen).sum() / max(len(found), 1)),
    }
