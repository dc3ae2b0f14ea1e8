"""Pins of simulated frames with noise, specks, glints and drift, against where the simulator put them: error against run time.

A row for each sensor, image size and kind of contact. `sure` is the share of frames whose identities were said to be sure, `wrong` how
many of those have a pin with another one's name.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from jaxunshear.config.configs import PAIRED, get_config_sensor
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.image import Nuisance
from jaxunshear.data.simulated_contacts import simulate_contacts
from jaxunshear.files import Json
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import fit_motion_prior, track_pins
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.progress import Progress

CONFIGS = ("tiny", "demo", "calibrated")  # of which sensor and camera are taken
SIZES = (128, 256)
FRAMES = 400


def bench_pins(size: int | None = None, seed: int = 0) -> list[Json]:
    """Rows of about FRAMES taps and as many slides for each sensor; another `seed` gives other contacts."""
    rows = []
    sizes = SIZES if size is None else (size,)
    with Progress("bench pins", len(CONFIGS) * len(sizes), unit="sensors and sizes") as progress:
        for config in CONFIGS:
            for px in sizes:
                rows += _rows(config, px, seed)
                progress.advance()
    return rows


def _rows(config: str, size: int, seed: int) -> list[Json]:
    before = PAIRED[config]
    paired = replace(
        before,
        camera=replace(before.camera, frame_px=size),
        preprocess=replace(before.preprocess, size=size),
        nuisance=Nuisance(drift_px=1.0 * size / 128, drift_brightness=0.1),
    )
    experiment = Experiment("bench_pins", "none", sensor=get_config_sensor(config), paired=paired)
    contacts = simulate_contacts(experiment, FRAMES, seed)
    lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
    seen = {
        "tap": (contacts.tap, contacts.tap_pins),
        "sheared": (contacts.sheared, contacts.sheared_pins),
    }
    return [
        {
            "name": f"{experiment.sensor.name}/{kind}",
            "sensor": experiment.sensor.name,
            "kind": kind,
            "size": size,
        }
        | compare_pins(lattice, images, true)
        for kind, (images, true) in seen.items()
    ]


def compare_pins(lattice: Lattice, images: np.ndarray, true: np.ndarray) -> Json:
    """Of images (N, S, S) with true pins (N, P, 2) px: errors of found pins, identities, and milliseconds a frame."""
    found, find_ms = _time_items(detect_pins, images)
    tracks, follow_ms = _time_items(lambda each: track_pins(lattice, each), found)
    usual = fit_motion_prior(lattice, tracks)
    for row, track in enumerate(tracks):
        if usual is not None and not track.identified:
            (tracks[row],), more = _time_items(
                lambda each: track_pins(lattice, each, usual), found[row : row + 1]
            )
            follow_ms[row] += more[0]
    motion = np.array([track.motion for track in tracks])
    off = np.linalg.norm(lattice.rest + motion - true, axis=-1)
    mistaken = off > 0.5 * lattice.spacing
    sure = np.array([track.identified for track in tracks])
    right = off[~np.isnan(off) & ~mistaken]
    full = find_ms + follow_ms
    return {
        "frames": len(images),
        "sure": float(sure.mean()),
        "wrong": int(np.sum(mistaken.any(axis=-1) & sure)),
        "rms_px": float(np.sqrt(np.mean(right**2))) if len(right) else None,
        "missed": float(np.mean([track.missed for track in tracks])),
        "extra": float(np.mean([track.extra for track in tracks])),
        "find_ms": float(np.median(find_ms)),
        "follow_ms": float(np.median(follow_ms)),
        "ms": float(np.median(full)),
        "ms_p95": float(np.percentile(full, 95)),
    }


Item = TypeVar("Item")
Answer = TypeVar("Answer")


def _time_items(
    work: Callable[[Item], Answer], items: Iterable[Item]
) -> tuple[list[Answer], np.ndarray]:
    """Answers, and milliseconds (N,) of each."""
    answers, spent = [], []
    for item in items:
        began = time.perf_counter()
        answers.append(work(item))
        spent.append(1e3 * (time.perf_counter() - began))
    return answers, np.array(spent)


COLUMNS = (
    "name",
    "size",
    "frames",
    "sure",
    "wrong",
    "rms_px",
    "missed",
    "extra",
    "find_ms",
    "follow_ms",
    "ms",
    "ms_p95",
)
