"""Score contact geometry against how far the simulator's skin was pressed in.

The geometry is that of taps, of sheared and of unsheared images. The true indentation is known at
the pins of the tap, where a camera sees it. An estimated geometry is interpolated to there, by the
cubic surface through its heights at the image's pins.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.data import simulation
from jaxunshear.data.recordings import read_recordings
from jaxunshear.data.simulation import SimulatedContacts, render_untouched_images, simulate_contacts
from jaxunshear.downstream.geometry import (
    INVERSE,
    HeightEstimator,
    interpolate_heights,
    make_height_estimators,
)
from jaxunshear.errors import UserError
from jaxunshear.evaluation.intervals import compute_intervals
from jaxunshear.files import Json
from jaxunshear.inference.edge_methods import Unshear, load_unshearers
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.perception.sensor_check import MIN_PLAUSIBILITY, judge_image
from jaxunshear.results.applications import GeometryScore, GeometryScores

SEED = 0
SHOWN_IMAGES = 8  # of recordings
UNTOUCHED = "untouched"  # images without contact: what a method estimates of nothing


class Geometry(NamedTuple):
    """Heights of N contacts by kind of image and method, at the tap's pins.

    Rows are NaN if the pins of the image were not identified.
    """

    height_mm: dict[tuple[str, str], np.ndarray]  # (N, P)
    ms: dict[tuple[str, str], float]  # per image, from image to heights, networks included


@dataclass(frozen=True)
class GeometryResult:
    """Contacts that no network was trained on, their heights, and how well these are true."""

    contacts: SimulatedContacts
    geometry: Geometry
    methods: Mapping[str, HeightEstimator]  # from pins to heights
    networks: Mapping[str, Unshear]  # that unshear
    table: GeometryScores


def score_geometry(model: TrainedModel, count: int = 300) -> GeometryResult:
    """Score contact geometry by the networks of a model, over about `count` new contacts.

    Scales are fitted to other taps. Raises UserError if no network of it unshears.
    """
    if count < 3:
        raise UserError(f"--contacts {count}: use at least 3")
    paired = model.require_simulation("geometry")
    networks = load_unshearers(model)
    if not networks:
        raise UserError(
            f"{model.folder} holds no trained network that unshears: "
            "train one first, or name another --model"
        )
    lattice, experiment = model.lattice, model.experiment
    taps = simulate_contacts(experiment, simulation.SCALE_TAPS, seed=1)
    estimators = make_height_estimators(lattice, taps)
    contacts = simulate_contacts(experiment, count)
    untouched = render_untouched_images(experiment, len(contacts.stimulus))
    geometry = estimate_geometry(lattice, contacts, untouched, estimators, networks)
    scales = {name: estimator.mm_per_unit for name, estimator in estimators.items()}
    rows = _score(paired.names, contacts, geometry)
    table = GeometryScores(rows, scales, contacts.dropped)
    return GeometryResult(contacts, geometry, estimators, networks, table)


def estimate_geometry(
    lattice: Lattice,
    contacts: SimulatedContacts,
    untouched: np.ndarray,
    estimators: Mapping[str, HeightEstimator],
    networks: Mapping[str, Unshear],
) -> Geometry:
    """Estimate heights of taps, of sheared images, and of what each network makes of these.

    `untouched` are images (N, S, S) of the sensor that touches nothing.
    """
    geometry = Geometry({}, {})
    images = {
        "tap": contacts.tap,
        "sheared": contacts.sheared,
        **dict.fromkeys(networks, contacts.sheared),
        UNTOUCHED: untouched,
    }
    for kind, batch in images.items():
        if kind in networks:
            networks[kind](batch[:1])  # compiles
        start = time.perf_counter()
        motion = networks[kind](batch) if kind in networks else measure_motions(lattice, batch)
        motion_s = time.perf_counter() - start
        identified = np.flatnonzero(~np.isnan(motion[:, 0, 0]))
        heights = np.full((len(estimators), *motion.shape[:2]), np.nan)
        for row, (name, estimator) in enumerate(estimators.items()):
            start = time.perf_counter()
            if len(identified):
                heights[row, identified] = estimator(motion[identified])
            spent_s = motion_s + time.perf_counter() - start
            geometry.ms[kind, name] = 1e3 * spent_s / len(batch)
        for contact in identified:
            heights[:, contact] = interpolate_heights(
                lattice.rest + motion[contact], heights[:, contact].T, contacts.tap_pins[contact]
            ).T
        for row, name in enumerate(estimators):
            geometry.height_mm[kind, name] = heights[row]
    return geometry


def _score(
    names: tuple[str, ...], contacts: SimulatedContacts, geometry: Geometry
) -> list[GeometryScore]:
    rows = []
    groups = {"all": np.ones(len(contacts.stimulus), bool)}
    groups |= {name: contacts.stimulus == index for index, name in enumerate(names)}
    for group, inside in groups.items():
        for (kind, method), height in geometry.height_mm.items():
            matched = inside & ~np.isnan(height[:, 0])
            row = GeometryScore(
                name=f"{group}/{kind}/{method}",
                stimulus=group,
                kind=kind,
                way=method,
                contacts=int(inside.sum()),
                unmatched=int((inside & ~matched).sum()),
                ms_per_image=geometry.ms[kind, method],
            )
            if matched.any():
                scores = _score_heights(
                    kind, height[matched], contacts.indentation_mm[matched], matched
                )
                row = replace(row, **scores)
            rows.append(row)
    return rows


def _score_heights(kind: str, height: np.ndarray, true: np.ndarray, matched: np.ndarray) -> Json:
    """Compute fields of a score from heights (M, P) mm of the `matched` of N contacts.

    The untouched sensor has no true height, so its largest one is reported.
    """
    values = {"correlation": compute_correlation(height, true)}
    if kind != UNTOUCHED:
        values["rmse_mm"] = np.sqrt(np.mean((height - true) ** 2, axis=-1))
    fields: Json = {name: float(contacts.mean()) for name, contacts in values.items()}
    intervals = compute_intervals(values, np.flatnonzero(matched), SEED)
    fields |= {f"{name}_interval": interval for name, interval in intervals.items()}
    if kind == UNTOUCHED:
        fields["largest_mm"] = float(np.abs(height).max())
    return fields


def compute_correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute Pearson's correlation row by row, (N,) of (N, P); 0 for a flat row."""
    a, b = a - a.mean(axis=-1, keepdims=True), b - b.mean(axis=-1, keepdims=True)
    scale = np.sqrt(np.sum(a**2, axis=-1) * np.sum(b**2, axis=-1))
    return np.divide(np.sum(a * b, axis=-1), scale, out=np.zeros(len(a)), where=scale > 0)


def estimate_recorded_heights(
    path: Path, model: TrainedModel, result: GeometryResult
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Estimate heights (N, P) mm of the first images at `path`, by kind; return names first.

    Rows are NaN for images that are not the sensor's. The truth is not known.
    """
    recordings = read_recordings(path, model.experiment.paired.preprocess)
    frames = list(islice(recordings.iterate_frames(), SHOWN_IMAGES))
    batch = np.stack([frame.image for frame in frames])
    # networks over images render pins for any input, so the recorded image decides
    plausibility = np.array([judge_image(image, model.appearance).plausibility for image in batch])
    motions = {"as recorded": measure_motions(model.lattice, batch)}
    motions |= {name: unshear(batch) for name, unshear in result.networks.items()}
    heights = {}
    for kind, motion in motions.items():
        height_mm = result.methods[INVERSE](motion)
        heights[kind] = np.where(plausibility[:, None] < MIN_PLAUSIBILITY, np.nan, height_mm)
    return [frame.name for frame in frames], heights
