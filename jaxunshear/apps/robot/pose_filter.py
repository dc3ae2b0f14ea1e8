"""Smooth the poses of a stream: a Kalman filter whose model is a constant rate.

Each quantity has a filter of its own, of its value and its rate, which white noise accelerates. How
much is smoothed depends on that noise (DRIFT) and on the noise of the poses alone.

>>> state = update_filter(None, 12.0, {"edge_mm": 0.3}, {"edge_mm": 0.2})
>>> state = update_filter(state, 12.1, {"edge_mm": 0.5}, {"edge_mm": 0.2})
>>> state.rate["edge_mm"]                                                      # mm per s
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.targets import get_unit

DRIFT = {"mm": 20.0, "deg": 200.0}  # per s^1.5: how much a rate changes, by unit
NOISE = {"mm": 0.3, "deg": 5.0}  # of a pose, if the model's run does not know its half-widths
RATE = {"mm": 30.0, "deg": 100.0}  # per s: what a rate may be at the start
MAX_GAP_S = 0.5  # without a pose, after which the filter starts anew
DEVIATIONS = 1.96  # in the half-width of an interval that holds 95 %


@dataclass(frozen=True)
class FilterState:
    """Values and rates by quantity, mm and deg, mm per s and deg per s, at a time."""

    time_s: float
    pose: Mapping[str, float]
    rate: Mapping[str, float]
    covariance: np.ndarray  # (K, 2, 2) of value and rate


def find_noise(names: Sequence[str], half_widths: Mapping[str, float]) -> dict[str, float]:
    """Find the standard deviation of each quantity, from the half-widths of 95 % that are known."""
    noise = _select(NOISE, names)
    known = {name: half_widths[name] / DEVIATIONS for name in names if name in half_widths}
    return dict(zip(names, noise.tolist(), strict=True)) | known


def update_filter(
    state: FilterState | None, time_s: float, pose: Mapping[str, float], noise: Mapping[str, float]
) -> FilterState:
    """Bring the state to a time and a pose; it starts anew after a gap, or if time runs back."""
    names = tuple(pose)
    measured = np.array([pose[name] for name in names])
    variance = np.array([noise[name] for name in names]) ** 2
    if state is None or not 0 <= time_s - state.time_s <= MAX_GAP_S:
        covariance = np.zeros((len(names), 2, 2))
        covariance[:, 0, 0], covariance[:, 1, 1] = variance, _select(RATE, names) ** 2
        return _make_state(time_s, names, measured, np.zeros(len(names)), covariance)
    step = time_s - state.time_s
    move = np.array([[1.0, step], [0.0, 1.0]])
    spread = np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    covariance = move @ state.covariance @ move.T
    covariance = covariance + _select(DRIFT, names)[:, None, None] ** 2 * spread
    rate = np.array([state.rate[name] for name in names])
    value = np.array([state.pose[name] for name in names]) + step * rate
    gain = covariance[:, :, 0] / (covariance[:, 0, 0] + variance)[:, None]
    surprise = _wrap_angles(names, measured - value)
    covariance = covariance - gain[:, :, None] * covariance[:, None, 0, :]
    value, rate = value + gain[:, 0] * surprise, rate + gain[:, 1] * surprise
    return _make_state(time_s, names, value, rate, covariance)


def _make_state(
    time_s: float, names: Sequence[str], value: np.ndarray, rate: np.ndarray, covariance: np.ndarray
) -> FilterState:
    value = _wrap_angles(names, value)
    values = dict(zip(names, value.tolist(), strict=True))
    rates = dict(zip(names, rate.tolist(), strict=True))
    return FilterState(time_s, values, rates, covariance)


def _wrap_angles(names: Sequence[str], values: np.ndarray) -> np.ndarray:
    is_angle = np.array([name.endswith("_deg") for name in names])
    return np.where(is_angle, wrap_degrees(values), values)


def _select(by_unit: Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    return np.array([by_unit[get_unit(name)] for name in names])
