"""Measures the time of one core that reading the pins of a frame takes, step by step.

Beside it stands a plain pass over the same frames, which labels the white parts and computes their
centroids, and no more. There is a row for each image size, of simulated taps and slides with noise,
specks, glints and drift.
"""

from functools import partial

import numpy as np
from scipy import ndimage

from benchmarks.bench_pins import SIZES, simulate_frames, time_items
from jaxunshear.files import Json
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import track_pins
from jaxunshear.progress import Progress
from jaxunshear.text_table import format_text_table

CONFIG = "calibrated"  # whose sensor was fitted to recordings
FRAMES = 200  # taps, and as many slides
STEPS = ("detect", "identify", "sum", "plain")
PERCENTS = {"_ms": 50, "_ms_p95": 95}
COLUMNS = (
    *("name", "frames", "sure"),
    *(f"{step}{percent}" for step in STEPS for percent in PERCENTS),
    *("ratio", "ratio_p95"),
)
format_table = partial(format_text_table, columns=COLUMNS)


def bench_read(frames: int = FRAMES) -> list[Json]:
    """Return a row for each of SIZES: milliseconds of processor time, medians and percentiles."""
    rows = []
    with Progress("bench read", len(SIZES), unit="sizes") as progress:
        for size in SIZES:
            rows.append(_measure_size(size, frames))
            progress.advance()
    return rows


def _measure_size(size: int, frames: int) -> Json:
    contacts, lattice = simulate_frames(CONFIG, size, frames, seed=0)
    images = np.concatenate([contacts.tap, contacts.sheared])
    detect_pins(images[0])  # the first call has tables to compute
    _, plain_ms = time_items(compute_centroids, images)
    detected, detect_ms = time_items(detect_pins, images)
    tracks, identify_ms = time_items(partial(track_pins, lattice), detected)
    total_ms = detect_ms + identify_ms
    times_ms = dict(zip(STEPS, (detect_ms, identify_ms, total_ms, plain_ms), strict=True))
    row = {"name": f"{size} px", "size": size, "frames": len(images)}
    row["sure"] = float(np.mean([track.identified for track in tracks]))
    for step, ms in times_ms.items():
        for name, percent in PERCENTS.items():
            row[step + name] = float(np.percentile(ms, percent))
    ratio = total_ms / plain_ms
    return row | {"ratio": float(np.median(ratio)), "ratio_p95": float(np.percentile(ratio, 95))}


def compute_centroids(image: np.ndarray) -> np.ndarray:
    """Compute the centroids (N, 2) px, as (row, column), of the white parts of an image (S, S)."""
    white = image > 127
    labels, count = ndimage.label(white)
    return np.array(ndimage.center_of_mass(white, labels, np.arange(1, count + 1)))
