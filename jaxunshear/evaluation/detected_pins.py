"""Detect pins in simulated images, to replace the simulator's true ones as on a real sensor.

>>> detected = detect_pairs(pairs, lattice, FIELDS)
>>> score_test(scorer, detected.make_test(batch=32))

Pins are detected in slide and tap, and unsheared pins are compared with the tap's true pins. Each
image is tracked by itself, as on a robot.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxunshear.data.reader import Batch, Reader
from jaxunshear.evaluation.contact_scores import TestSet
from jaxunshear.models.modality import IMAGES, PINS
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import track_images
from jaxunshear.selection import select_evenly

DETECTED = "found"  # the name of this test
MAX_PAIRS = 480  # slides, evenly chosen, each with its tap: some 15 ms an image
DETECTED_TAP = "seen_tap"
INPUTS = (*PINS.pair, DETECTED_TAP)  # the true tap, the detected slide and the detected tap


class DetectedPairs(NamedTuple):
    """Test pairs in whose tap and slide all pins were identified."""

    # detected `sheared_pins` and DETECTED_TAP, NaN if a pin is missing; true `canonical_pins`
    pairs: Batch
    # by "tap" and "sheared": share of images, error of their pins, number of missing ones
    reported: dict[str, dict[str, float]]

    def make_test(self, batch: int) -> TestSet:
        count = len(self.pairs[DETECTED_TAP])
        batches: list[Batch] = []
        for start in range(0, count, batch):
            rows = slice(start, start + batch)
            batches.append({name: values[rows] for name, values in self.pairs.items()})
        return TestSet(batches, count, INPUTS, title="evaluate found pins")


def detect_pairs(reader: Reader, lattice: Lattice, fields: Sequence[str]) -> DetectedPairs | None:
    """Detect the pins of test pairs; None if no pair is identified, as in images without pins."""
    rows = select_evenly(reader.length("test"), MAX_PAIRS)
    batch = reader.take("test", rows, fields)
    reported: dict[str, dict[str, float]] = {}
    detected: dict[str, np.ndarray] = {}
    both_identified = np.ones(len(rows), bool)
    fields_by_kind = zip(("tap", "sheared"), IMAGES.pair, PINS.pair, strict=True)
    for kind, image_field, pin_field in fields_by_kind:
        motion, identified = track_images(lattice, batch[image_field][..., 0], independent=True)
        pins = (lattice.rest + motion).astype(np.float32)
        reported[kind] = _measure_detection(pins[identified], batch[pin_field][identified], rows)
        detected[kind] = pins
        both_identified &= identified
    if not both_identified.any():
        return None
    pairs = {name: values for name, values in batch.items() if name not in IMAGES.pair}
    pairs |= {PINS.sheared: detected["sheared"], DETECTED_TAP: detected["tap"]}
    return DetectedPairs(
        {name: values[both_identified] for name, values in pairs.items()}, reported
    )


def _measure_detection(
    detected: np.ndarray, true: np.ndarray, images: np.ndarray
) -> dict[str, float]:
    present = np.isfinite(detected).all(-1)
    squares = np.sum(np.square(detected - true), axis=-1)[present]
    return {
        "images": len(images),
        "followed": len(detected) / len(images),
        "rms_px": float(np.sqrt(squares.mean())) if len(squares) else float("nan"),
        "missing_per_image": float((~present).sum() / max(len(detected), 1)),
    }
