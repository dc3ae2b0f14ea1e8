"""Pins found in simulated images, in the place of the simulator's true ones: what networks over pins read where there is but a camera.

>>> found = detect_pairs(pairs, lattice, FIELDS)
>>> gather(run, iterate_batches(found, 32), len(found.pairs["pose"]), 0, targets, inputs=INPUTS)

Slide and tap are both found; what comes out is compared with the tap's true pins. Each image is followed by itself, as a robot sees it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxunshear.data.reader import Batch, Reader
from jaxunshear.evaluation.score_collection import IMAGES, PINS
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import track_images
from jaxunshear.selection import select_evenly

DETECTED = "found"  # the name of this test
MAX_PAIRS = 480  # slides, evenly chosen, each with its tap: some 15 ms an image
DETECTED_TAP = "seen_tap"
INPUTS = (*PINS, DETECTED_TAP)  # the true tap, the slide and the tap as found


class DetectedPairs(NamedTuple):
    """Test pairs whose tap and slide were both followed for sure."""

    pairs: Batch  # `sheared_pins` and SEEN_TAP (N, P, 2) px, NaN where a pin is not seen; `canonical_pins` true ones
    # of taps and slides, what share was followed, how far found pins are off, how many are missing
    reported: dict[str, dict[str, float]]


def detect_pairs(reader: Reader, lattice: Lattice, fields: Sequence[str]) -> DetectedPairs | None:
    """None where no pair can be followed, as in images too small to show pins."""
    count = reader.length("test")
    rows = select_evenly(count, MAX_PAIRS)
    batch = reader.take("test", rows, fields)
    reported: dict[str, dict[str, float]] = {}
    places: dict[str, np.ndarray] = {}
    sure = np.ones(len(rows), bool)
    for kind, image, true in zip(("tap", "sheared"), IMAGES, PINS, strict=True):
        motion, known = track_images(lattice, batch[image][..., 0], independent=True)
        places[true] = (lattice.rest + motion).astype(np.float32)
        reported[kind] = _measure_detection(places[true][known], batch[true][known], len(rows))
        sure &= known
    if not sure.any():
        return None
    pairs = {name: values for name, values in batch.items() if name not in IMAGES}
    pairs |= {PINS[1]: places[PINS[1]], DETECTED_TAP: places[PINS[0]]}
    return DetectedPairs({name: values[sure] for name, values in pairs.items()}, reported)


def iterate_batches(found: DetectedPairs, batch: int) -> Iterator[Batch]:
    for start in range(0, len(found.pairs[DETECTED_TAP]), batch):
        yield {name: values[start : start + batch] for name, values in found.pairs.items()}


def _measure_detection(found: np.ndarray, true: np.ndarray, images: int) -> dict[str, float]:
    seen = np.isfinite(found).all(-1)
    squares = np.sum(np.square(found - true), axis=-1)[seen]
    return {
        "images": images,
        "followed": len(found) / images,
        "rms_px": float(np.sqrt(squares.mean())) if len(squares) else float("nan"),
        "missing_per_image": float((~seen).sum() / max(len(found), 1)),
    }
