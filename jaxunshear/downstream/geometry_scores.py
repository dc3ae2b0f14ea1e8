"""How well the contact geometry of taps, sheared and unsheared images agrees with how far the simulator's skin was pressed in.

The truth stands where a camera sees it: at the places of the tap's pins. There a geometry is read off its cubic surface, through its
heights where the image's pins are.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment, require_simulated
from jaxunshear.data import simulated_contacts
from jaxunshear.data.simulated_contacts import (
    SimulatedContacts,
    render_untouched_images,
    simulate_contacts,
)
from jaxunshear.downstream.geometry import (
    HeightEstimator,
    interpolate_heights,
    make_height_estimators,
)
from jaxunshear.errors import UserError
from jaxunshear.evaluation.bootstrap import compute_intervals
from jaxunshear.files import Json
from jaxunshear.inference.perception import (
    Unshear,
    compute_model_lattice,
    list_unshearing_networks,
    load_unshearers,
)
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.results.applications import GeometryScore, GeometryScores

SEED = 0
UNTOUCHED = "untouched"  # the kind of image that shows what a way makes of no contact


class Geometry(NamedTuple):
    """Heights of N contacts by kind of image and way, at the tap's pins; NaN rows where pins were not identified for sure."""

    height_mm: dict[tuple[str, str], np.ndarray]  # (N, P)
    ms: dict[tuple[str, str], float]  # an image, from image to heights, networks included


@dataclass(frozen=True)
class GeometryResult:
    """Contacts that no network has seen, their heights, and how well these agree with the truth."""

    lattice: Lattice  # where pins stand untouched
    contacts: SimulatedContacts
    geometry: Geometry
    methods: Mapping[str, HeightEstimator]  # from pins to heights
    networks: Mapping[str, Unshear]  # that unshear
    table: GeometryScores


def score_geometry(folder: Path, experiment: Experiment, count: int = 300) -> GeometryResult:
    """Contact geometry by the networks of a finished run in `folder`, of about `count` fresh contacts; scales are fitted to other taps.
    Raises UserError."""
    if count < 3:
        raise UserError(f"--contacts {count}: use at least 3")
    paired, _ = require_simulated(experiment, "geometry")
    networks = load_unshearers(folder, experiment, list_unshearing_networks(folder))
    if not networks:
        raise UserError(
            f"{folder} holds no trained network that unshears: train one first, or name another --model"
        )
    lattice = compute_model_lattice(experiment)
    ways = make_height_estimators(
        lattice, simulate_contacts(experiment, simulated_contacts.SCALE_TAPS, seed=1)
    )
    contacts = simulate_contacts(experiment, count)
    found = estimate_geometry(
        lattice,
        contacts,
        render_untouched_images(experiment, len(contacts.stimulus)),
        ways,
        networks,
    )
    scales = {name: way.mm_per_unit for name, way in ways.items()}
    table = GeometryScores(_scores(paired.names, contacts, found), scales, contacts.dropped)
    return GeometryResult(lattice, contacts, found, ways, networks, table)


def estimate_geometry(
    lattice: Lattice,
    contacts: SimulatedContacts,
    untouched: np.ndarray,
    ways: Mapping[str, HeightEstimator],
    networks: Mapping[str, Unshear],
) -> Geometry:
    """Heights of taps, sheared images, what each network makes of these, and images (N, S, S) of the sensor that touches nothing."""
    height: dict[tuple[str, str], np.ndarray] = {}
    ms: dict[tuple[str, str], float] = {}
    images = {
        "tap": contacts.tap,
        "sheared": contacts.sheared,
        **dict.fromkeys(networks, contacts.sheared),
    }
    for kind, given in (images | {UNTOUCHED: untouched}).items():
        if kind in networks:
            networks[kind](given[:1])  # compiles
        began = time.perf_counter()
        motion = networks[kind](given) if kind in networks else measure_motions(lattice, given)
        spent = time.perf_counter() - began
        sure = np.flatnonzero(~np.isnan(motion[:, 0, 0]))
        felt = np.full((len(ways), *motion.shape[:2]), np.nan)
        for row, (name, way) in enumerate(ways.items()):
            began = time.perf_counter()
            if len(sure):
                felt[row, sure] = way(motion[sure])
            ms[kind, name] = 1e3 * (spent + time.perf_counter() - began) / len(given)
        for one in sure:
            felt[:, one] = interpolate_heights(
                lattice.rest + motion[one], felt[:, one].T, contacts.tap_pins[one]
            ).T
        height |= {(kind, name): felt[row] for row, name in enumerate(ways)}
    return Geometry(height, ms)


def _scores(
    names: tuple[str, ...], contacts: SimulatedContacts, geometry: Geometry
) -> list[GeometryScore]:
    """For each stimulus, kind and way, and for all stimuli."""
    rows = []
    groups = {"all": np.ones(len(contacts.stimulus), bool)}
    groups |= {name: contacts.stimulus == index for index, name in enumerate(names)}
    for group, inside in groups.items():
        for (kind, way), height in geometry.height_mm.items():
            matched = inside & ~np.isnan(height[:, 0])
            row = GeometryScore(
                name=f"{group}/{kind}/{way}",
                stimulus=group,
                kind=kind,
                way=way,
                contacts=int(inside.sum()),
                unmatched=int((inside & ~matched).sum()),
                ms_per_image=geometry.ms[kind, way],
            )
            if matched.any():
                row = replace(
                    row,
                    **_agreement(kind, height[matched], contacts.indentation_mm[matched], matched),
                )
            rows.append(row)
    return rows


def _agreement(kind: str, height: np.ndarray, true: np.ndarray, matched: np.ndarray) -> Json:
    """Fields of a score: of heights (M, P) mm of the `matched` ones of N contacts; the untouched sensor has no true height."""
    each = {"correlation": compute_correlation(height, true)}
    if kind != UNTOUCHED:
        each["rmse_mm"] = np.sqrt(np.mean((height - true) ** 2, axis=-1))
    spans = compute_intervals(each, np.flatnonzero(matched), SEED)
    found: Json = {name: float(values.mean()) for name, values in each.items()}
    found |= {f"{name}_interval": span for name, span in spans.items()}
    return found | ({"largest_mm": float(np.abs(height).max())} if kind == UNTOUCHED else {})


def compute_correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pearson's, row by row, (N,) of (N, P); 0 where a row is flat."""
    a, b = (x - x.mean(axis=-1, keepdims=True) for x in (a, b))
    scale = np.sqrt(np.sum(a**2, axis=-1) * np.sum(b**2, axis=-1))
    return np.divide(np.sum(a * b, axis=-1), scale, out=np.zeros(len(a)), where=scale > 0)
