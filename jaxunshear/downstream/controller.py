"""The paper's controller (appendix C): proportional and integral, towards a pose normal to the edge, with a step along it.

>>> move, turn, memory = control(ControllerGains(), ControllerState(jnp.zeros(1), jnp.zeros(1)), edge_mm=jnp.array([1.0]), edge_deg=jnp.array([10.0]))
>>> move, turn                                    # ([[-0.8, 0.5]] mm and [6.] deg, in the sensor frame)
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


@dataclass(frozen=True)
class ControllerGains:
    """Of appendix C; it names no limits: ours keep one wrong answer from throwing the sensor off the object."""

    proportional: float = 0.5
    integral_mm: float = 0.3
    integral_deg: float = 0.1
    step_mm: float = 0.5  # along the edge
    limit_mm: float = 1.5  # of a correction
    limit_deg: float = 20.0  # what a tip of a millimetre needs


class ControllerState(NamedTuple):
    """Sums of the errors so far, zero at the start."""

    normal_mm: Array  # (B,)
    turn_deg: Array  # (B,)


def control(
    gains: ControllerGains, memory: ControllerState, edge_mm: Array, edge_deg: Array
) -> tuple[Array, Array, ControllerState]:
    """What to do about an edge seen at `edge_mm` (B,), negative inside, whose outward normal points to `edge_deg` (B,).

    Returns the move (B, 2) in mm and the turn (B,) in deg, both in the sensor frame: x across the edge, outwards, y along it,
    counter-clockwise around the object. Where a limit is met its sum does not grow further (anti-windup).
    """
    across, normal_mm = _compute_correction(
        -edge_mm, memory.normal_mm, gains.proportional, gains.integral_mm, gains.limit_mm
    )
    turn, turn_deg = _compute_correction(
        edge_deg, memory.turn_deg, gains.proportional, gains.integral_deg, gains.limit_deg
    )
    return (
        jnp.stack([across, jnp.full_like(across, gains.step_mm)], -1),
        turn,
        ControllerState(normal_mm, turn_deg),
    )


def _compute_correction(
    error: Array, total: Array, proportional: float, integral: float, limit: float
) -> tuple[Array, Array]:
    grown = total + error
    wanted = proportional * error + integral * grown
    held = jnp.clip(wanted, -limit, limit)
    winding = (wanted != held) & (jnp.sign(error) == jnp.sign(wanted))
    return held, jnp.where(winding, total, grown)
