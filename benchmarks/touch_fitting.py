"""Fits the weights of `jaxunshear/perception/touch.py` to simulated contacts.

Regressions give contact and shear; a network of one hidden layer gives slip.
"""

import json
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from jaxunshear.perception import touch as touches

SLIP_UNITS, SLIP_FITS = 16, 3  # of a network, and networks whose mean is taken
HELD_OUT = 4  # every so many poses set the interval alone
COVERAGE = 0.95
NOISE = 0  # column of the scalars, the only one that may speak against a contact
PENALTY = {"contact": 1e-4, "slip": 2e-4, "shear": 1e-3}


class Touches(NamedTuple):
    """N images whose pins are followed, with what is true of them."""

    features: touches.TouchFeatures
    pose: np.ndarray  # (N,) number of the pose; a tap and a slide share it
    depth_mm: np.ndarray  # (N,) if the axis meets the object, else 0
    nodes: np.ndarray  # (N,) that touch
    slip: np.ndarray  # (N,) share of these that slide
    drag: np.ndarray  # (N, 3) mm, mm and deg
    followed: np.ndarray  # (N,) share of all images, the same for each

    def take(self, rows: np.ndarray) -> "Touches":
        taken: Touches = jax.tree.map(lambda each: each[rows], self)
        return taken


def learn_weights(sets: Sequence[Touches], short: Sequence[Touches]) -> touches.TouchWeights:
    """Learn weights, and slip from `short` too; one of HELD_OUT poses sets the interval alone."""
    every: Touches = jax.tree.map(lambda *parts: np.concatenate(parts), *sets)
    is_learnt, is_touching = every.pose % HELD_OUT > 0, every.nodes > 0
    learnt, touching = every.take(is_learnt), every.take(is_learnt & is_touching)
    features, drag = touching.features, touching.drag
    sides = np.concatenate([features.vectors[..., 0], features.vectors[..., 1]])
    sliding = [touching, *(each.take(each.nodes > 0) for each in short)]
    slip_units, slip = _fit_slip(
        np.concatenate([each.features.slide for each in sliding]),
        np.concatenate([each.slip for each in sliding]),
    )
    weights = touches.TouchWeights(
        contact=_fit_contact(learnt.features.sizes, (learnt.nodes > 0).astype(float)),
        slip_units=slip_units,
        slip=slip,
        shear=_fit_ridge(sides, np.concatenate([drag[:, 0], drag[:, 1]])),
        turn=_fit_ridge(features.turns, drag[:, 2]),
        half_width=np.ones(2),
    )
    error, unit = compare_shear(every.take(~is_learnt & is_touching), weights)
    ratio = np.abs(error / unit)
    half_width = np.nanquantile(ratio[:, :2], COVERAGE), np.nanquantile(ratio[:, 2], COVERAGE)
    return weights._replace(half_width=np.array(half_width))


def format_weights(weights: touches.TouchWeights) -> str:
    """Format weights as the file that `touches.load_weights` loads, a field per line."""
    fields = {"command": "python -m benchmarks touch --weights FILE"} | {
        name: np.round(getattr(weights, name), 5).tolist() for name in weights._fields
    }
    lines = [f" {json.dumps(name)}: {json.dumps(value)}" for name, value in fields.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def compare_shear(
    contacts: Touches, weights: touches.TouchWeights
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and half-widths (N, 3) of the shear: mm, mm and deg."""
    touch = touches.predict_touch(weights, contacts.features)
    shear = np.stack([touch.shear_x_mm, touch.shear_y_mm, touch.shear_deg], axis=-1)
    width_mm = touch.shear_half_width_mm
    return shear - contacts.drag, np.stack([width_mm, width_mm, touch.shear_half_width_deg], -1)


def _fit_ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.mean(x**2, axis=0))
    scaled = x / size
    normal = scaled.T @ scaled / len(y) + PENALTY["shear"] * np.eye(len(size))
    weights: np.ndarray = np.linalg.solve(normal, scaled.T @ y / len(y)) / size
    return weights


def _standardise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return standardised columns with a last one of ones, and what undoes it to weights."""
    middle, spread = x.mean(axis=0), x.std(axis=0)
    undo = np.diag(np.append(1 / spread, 1))
    undo[-1, :-1] = -middle / spread
    return np.column_stack([(x - middle) / spread, np.ones(len(x))]), undo


def _fit_contact(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit weights, and a last one that is added, to y in {0, 1}, by cross entropy.

    NOISE has no positive weight, and all else no negative one: more motion never speaks against a
    contact.
    """
    scaled, undo = _standardise(x)

    def compute_loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        logit, size = scaled @ weights, PENALTY["contact"] * weights[:-1]
        loss = np.mean(np.logaddexp(0, logit) - y * logit) + np.sum(size * weights[:-1])
        slope = scaled.T @ (expit(logit) - y) / len(y)
        return float(loss), slope + 2 * np.append(size, 0)

    bounds: list[tuple[int | None, int | None]] = [(0, None)] * x.shape[1] + [(None, None)]
    bounds[NOISE] = (None, 0)
    return undo @ minimize(compute_loss, np.zeros(len(undo)), jac=True, bounds=bounds).x


def _fit_slip(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a network of one hidden layer to shares y in [0, 1], by cross entropy.

    Returns the weights of its units, and of its answer. It is the mean, before the answer's
    sigmoid, of SLIP_FITS networks that start from other random weights.
    """
    scaled, undo = _standardise(x)
    shape = (len(undo), SLIP_UNITS)

    def compute_loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        hidden, out = np.reshape(weights[: -SLIP_UNITS - 1], shape), weights[-SLIP_UNITS - 1 :]
        units = np.tanh(scaled @ hidden)
        logit, size = units @ out[:-1] + out[-1], PENALTY["slip"] * weights[:-1]
        loss = np.mean(np.logaddexp(0, logit) - y * logit) + np.sum(size * weights[:-1])
        error = (expit(logit) - y) / len(y)
        back = scaled.T @ (error[:, None] * out[:-1] * (1 - units**2))
        slope = np.concatenate([back.ravel(), units.T @ error, [error.sum()]])
        return float(loss), slope + 2 * np.append(size, 0)

    hidden, out, added = [], [], 0.0
    for seed in range(SLIP_FITS):
        rng = np.random.default_rng(seed)
        start = rng.normal(0, len(undo) ** -0.5, shape)
        answer = rng.normal(0, SLIP_UNITS**-0.5, SLIP_UNITS)
        first = np.concatenate([start.ravel(), answer, [0]])
        found = minimize(compute_loss, first, jac=True, method="L-BFGS-B").x
        hidden.append(undo @ np.reshape(found[: -SLIP_UNITS - 1], shape))
        out.append(found[-SLIP_UNITS - 1 : -1] / SLIP_FITS)
        added += found[-1] / SLIP_FITS
    return np.concatenate(hidden, axis=1), np.append(np.concatenate(out), added)
