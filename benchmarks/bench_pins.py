"""Measures error and run time of finding the pins of simulated frames.

The frames have noise, specks, glints and drift. There is a row for each sensor, image size and kind
of contact. `sure` is the share of frames whose pins were identified, `wrong` how many of these
frames have a pin with the number of another pin.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from jaxunshear.config.configs import PAIRED, get_config_sensor
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import Nuisance
from jaxunshear.data.simulation import SimulatedContacts, simulate_contacts
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import fit_motion_prior, track_pins
from jaxunshear.progress import Progress
from jaxunshear.text_table import format_text_table

CONFIGS = ("tiny", "demo", "calibrated")  # for sensor and camera
SIZES = (128, 256)
FRAMES = 400
COLUMNS = (
    *("name", "size", "frames", "sure", "wrong", "rms_px", "missed", "extra"),
    *("find_ms", "follow_ms", "ms", "ms_p95"),
)
format_table = partial(format_text_table, columns=COLUMNS)


def bench_pins(size: int | None = None, seed: int = 0) -> list[Json]:
    """Return rows of about FRAMES taps and as many slides for each sensor."""
    if size is not None and not 64 <= size <= 1024:
        raise UserError(f"--size {size}: use 64 to 1024 px")
    rows = []
    sizes = SIZES if size is None else (size,)
    with Progress("bench pins", len(CONFIGS) * len(sizes), unit="sensors and sizes") as progress:
        for config in CONFIGS:
            for px in sizes:
                rows += _measure_sensor(config, px, seed)
                progress.advance()
    return rows


def _measure_sensor(config: str, size: int, seed: int) -> list[Json]:
    contacts, lattice = simulate_frames(config, size, FRAMES, seed)
    frames = {
        "tap": (contacts.tap, contacts.tap_pins),
        "sheared": (contacts.sheared, contacts.sheared_pins),
    }
    sensor = get_config_sensor(config).name
    rows = []
    for kind, (images, pins) in frames.items():
        row = {"name": f"{sensor}/{kind}", "sensor": sensor, "kind": kind, "size": size}
        rows.append(row | compare_pins(lattice, images, pins))
    return rows


class Frames(NamedTuple):
    """Simulated contacts, with the lattice of an untouched dome in the same images."""

    contacts: SimulatedContacts
    lattice: Lattice


def simulate_frames(config: str, size: int, count: int, seed: int) -> Frames:
    """Simulate taps and slides with the sensor and camera of a config, in images of `size` px."""
    before = PAIRED[config]
    paired = replace(
        before,
        camera=replace(before.camera, frame_px=size),
        preprocess=replace(before.preprocess, size=size),
        nuisance=Nuisance(drift_px=1.0 * size / 128, drift_brightness=0.1),
    )
    experiment = Experiment("bench_pins", "none", sensor=get_config_sensor(config), paired=paired)
    lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
    return Frames(simulate_contacts(experiment, count, seed), lattice)


def compare_pins(lattice: Lattice, images: np.ndarray, true: np.ndarray) -> Json:
    """Compare the pins in images (N, S, S) with true pins (N, P, 2) px: errors and times."""
    detections, find_ms = time_items(detect_pins, images)
    tracks, follow_ms = time_items(lambda each: track_pins(lattice, each), detections)
    prior = fit_motion_prior(lattice, tracks)
    for row, track in enumerate(tracks):
        if prior is not None and not track.identified:
            (tracks[row],), more_ms = time_items(
                lambda each: track_pins(lattice, each, prior), detections[row : row + 1]
            )
            follow_ms[row] += more_ms[0]
    motion = np.array([track.motion for track in tracks])
    error_px = np.linalg.norm(lattice.rest + motion - true, axis=-1)
    mistaken = error_px > 0.5 * lattice.spacing
    identified = np.array([track.identified for track in tracks])
    right_px = error_px[~np.isnan(error_px) & ~mistaken]
    total_ms = find_ms + follow_ms
    return {
        "frames": len(images),
        "sure": float(identified.mean()),
        "wrong": int(np.sum(mistaken.any(axis=-1) & identified)),
        "rms_px": float(np.sqrt(np.mean(right_px**2))) if len(right_px) else None,
        "missed": float(np.mean([track.missed for track in tracks])),
        "extra": float(np.mean([track.extra for track in tracks])),
        "find_ms": float(np.median(find_ms)),
        "follow_ms": float(np.median(follow_ms)),
        "ms": float(np.median(total_ms)),
        "ms_p95": float(np.percentile(total_ms, 95)),
    }


Item = TypeVar("Item")
Answer = TypeVar("Answer")


def time_items(
    work: Callable[[Item], Answer], items: Iterable[Item]
) -> tuple[list[Answer], np.ndarray]:
    """Return the answers, and milliseconds (N,) of processor time of each."""
    answers, times_ms = [], []
    for item in items:
        start = time.process_time()
        answers.append(work(item))
        times_ms.append(1e3 * (time.process_time() - start))
    return answers, np.array(times_ms)
