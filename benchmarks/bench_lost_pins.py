"""Measures how many images of a worn dome are sure, and how exact their pins are.

Pins are lost, the same ones in all frames, and dust lies on the window. Simulated frames are
rendered without the lost pins and with the dust; in recorded ones lost pins are painted over, and
the truth is where the pins were seen before. `alone` is the share of images sure one by one, before
it is known which pins are lost, `sure` the share afterwards; `wrong` and `wrong_alone` are how many
of these have a pin with the number of another. Errors are of what networks take: all pins, lost
ones filled from their neighbours.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.configs import PAIRED, get_config_sensor
from jaxunshear.config.sensor import TACTIP_331, Preprocess
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.data.sampling import sample_pairs
from jaxunshear.data.simulation import render_images
from jaxunshear.files import Json
from jaxunshear.perception.lattice import Lattice, make_lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice, fit_lattice, make_layout
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.perception.worn_dome import find_lost_pins
from jaxunshear.progress import Progress
from jaxunshear.selection import select_evenly
from jaxunshear.simulator.simulate import simulate
from jaxunshear.text_table import format_text_table

FRAMES = 40  # taps and slides, or recorded ones, of a level
OUT_OF_VIEW = (1e3, 1e3, 1e-3)  # mm, of the tip of a lost pin
COLUMNS = (
    *("name", "lost", "dust", "frames", "alone", "wrong_alone", "sure", "wrong", "found"),
    "rms_px",
)
format_table = partial(format_text_table, columns=COLUMNS)


class Wear(NamedTuple):
    """How many pins are lost, and how many dots of dust there are, of 331 pins."""

    lost: int
    dust: int = 0


LEVELS = (
    *(Wear(0), Wear(1), Wear(3), Wear(7), Wear(10), Wear(17), Wear(26)),
    *(Wear(0, 3), Wear(0, 7), Wear(17, 3), Wear(17, 7), Wear(26, 7)),
)


class Worn(NamedTuple):
    """Frames of a worn dome."""

    images: np.ndarray  # (N, S, S)
    true: np.ndarray  # (N, P, 2) px, also of lost pins; NaN if a pin was never seen
    lost: np.ndarray  # (L,)


def bench_lost_pins(recordings: Path | None = None, seed: int = 0) -> list[Json]:
    """Return a row for each of LEVELS, of simulated frames and of those in `recordings`."""
    sources = [("simulated", *_simulate(seed))]
    if recordings is not None:
        sources.append(("recorded", *_read_recorded(recordings, seed)))
    rows: list[Json] = []
    with Progress("bench lost_pins", len(sources) * len(LEVELS), unit="levels") as progress:
        for source, lattice, frames in sources:
            for wear, worn in zip(LEVELS, frames, strict=True):
                row = _measure(lattice, worn)
                name = f"{source}/{wear.lost}/{wear.dust}"
                rows.append({"name": name} | wear._asdict() | row)
                progress.advance()
    return rows


def _measure(lattice: Lattice, worn: Worn) -> Json:
    """Track pins as `jaxunshear pins` does, and compare them with the truth."""
    detected = [detect_pins(image) for image in worn.images]
    alone = tracks = track_all(lattice, detected)
    lost = find_lost_pins(alone)
    if lost:
        lattice = make_lattice(lattice.rest, lattice.ring, lost)
        tracks = track_all(lattice, detected)
    sure = np.array([track.identified for track in tracks])
    filled = np.array([lattice.fill_holes(track.motion) for track in tracks])
    error_px = np.linalg.norm(lattice.rest + filled - worn.true, axis=-1)[sure]
    found = len(set(lost) & set(worn.lost.tolist())) / max(len(worn.lost), 1)
    return {
        "frames": len(worn.images),
        "alone": round(float(np.mean([track.identified for track in alone])), 4),
        "wrong_alone": _count_wrong(lattice, alone, worn.true),
        "sure": round(float(sure.mean()), 4),
        "wrong": _count_wrong(lattice, tracks, worn.true),
        "found": round(found, 3),
        "rms_px": round(float(np.sqrt(np.nanmean(error_px**2))), 4),
    }


def _count_wrong(lattice: Lattice, tracks: list[PinTrack], true: np.ndarray) -> int:
    """Count the sure frames in which a pin stands where another one does."""
    motion = np.array([track.motion for track in tracks])
    error_px = np.linalg.norm(lattice.rest + motion - true, axis=-1)
    sure = np.array([track.identified for track in tracks])
    return int(np.sum((error_px > 0.5 * lattice.spacing).any(axis=-1) & sure))


def _simulate(seed: int) -> tuple[Lattice, Iterator[Worn]]:
    """Simulate taps and slides; pins are in images of 128 px."""
    before, sensor = PAIRED["skin"], get_config_sensor("skin")
    poses = FRAMES // 2 // len(before.stimuli)
    settings = replace(before, poses=poses, taps=1, slides=1, seed=before.seed + 1 + seed)
    contacts = simulate(sensor, settings.stimuli, sample_pairs(settings).scenes)
    tips = np.asarray(contacts.pins)[np.asarray(contacts.converged)]
    number, age = np.arange(len(tips)), np.zeros(len(tips))
    _, true = render_images(settings, sensor, tips, number, age)

    def wear_down(wear: Wear) -> Worn:
        generator = np.random.default_rng([seed, *wear])
        lost = generator.choice(sensor.pins, wear.lost, replace=False)
        pins = np.concatenate([tips, _scatter_dust(generator, tips, wear.dust)], axis=1)
        shown = pins.copy()
        shown[:, lost] = OUT_OF_VIEW
        images, _ = render_images(settings, sensor, shown, number, age)
        return Worn(images, true, lost)

    rest = compute_rest_lattice(sensor, settings.camera, settings.preprocess)
    return rest, map(wear_down, LEVELS)


def _scatter_dust(generator: np.random.Generator, tips: np.ndarray, count: int) -> np.ndarray:
    """Scatter dots (N, count, 3) mm over the dome, of a pin's size, the same in all frames."""
    place = _scatter(generator, np.linalg.norm(tips[..., :2], axis=-1).max(), count)
    height = np.median(tips[..., 2]) + generator.uniform(-10, 10, count)
    return np.repeat(np.column_stack([place, height])[None], len(tips), axis=0)


def _scatter(generator: np.random.Generator, reach: float, count: int) -> np.ndarray:
    """Scatter places (count, 2) evenly over a disc of radius `reach` around the origin."""
    angle = generator.uniform(0, 2 * np.pi, count)
    away = reach * generator.uniform(size=count) ** 0.5
    return np.stack([away * np.cos(angle), away * np.sin(angle)], axis=-1)


def _read_recorded(path: Path, seed: int) -> tuple[Lattice, Iterator[Worn]]:
    """Read frames whose pins are all sure before they are painted over."""
    recordings = read_recordings(path, Preprocess())
    view = recordings.find_common_view()
    files = [recordings.files[row] for row in select_evenly(len(recordings), FRAMES)]
    images = np.array([prepare_frame(Preprocess(), read_image(file), view) for file in files])
    detected = [detect_pins(image) for image in images]
    lattice = fit_lattice([each.pins for each in detected], make_layout(TACTIP_331))
    tracks = track_all(lattice, detected)
    sure = np.array([track.identified for track in tracks])
    true = (lattice.rest + np.array([track.motion for track in tracks]))[sure]
    radius = float(np.median([each.radius for each in detected]))

    def wear_down(wear: Wear) -> Worn:
        generator = np.random.default_rng([seed, *wear])
        lost = generator.choice(len(lattice.rest), wear.lost, replace=False)
        worn = images[sure].copy()
        for image, pins in zip(worn, true, strict=True):
            _paint(image, pins[lost], radius + 1.0, 0)
        reach = np.linalg.norm(lattice.rest - lattice.centre, axis=-1).max()
        dust = lattice.centre + _scatter(generator, reach, wear.dust)
        for image in worn:
            _paint(image, dust, radius, 255)
        return Worn(worn, true, lost)

    return lattice, map(wear_down, LEVELS)


def _paint(image: np.ndarray, places: np.ndarray, radius: float, level: int) -> None:
    """Paint discs at places (N, 2) px into an image; those that are NaN are left out."""
    rows, columns = np.indices(image.shape)
    for column, row in places[np.isfinite(places[:, 0])]:
        image[np.hypot(columns - column, rows - row) <= radius] = level
