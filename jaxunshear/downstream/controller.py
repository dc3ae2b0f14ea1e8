"""The paper's controller (appendix C): proportional and integral.

It steers towards a pose normal to the edge, with a constant step along it.

>>> zero = ControllerState(jnp.zeros(1), jnp.zeros(1))
>>> control(ControllerGains(), zero, edge_mm=jnp.array([1.0]), edge_deg=jnp.array([10.0]))
    # move [[-0.8, 0.5]] mm and turn [6.] deg, in the sensor frame
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


@dataclass(frozen=True)
class ControllerGains:
    """Gains of appendix C, and limits of our own.

    The limits keep one wrong prediction from moving the sensor off the object.
    """

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


class Command(NamedTuple):
    """The next motion in the sensor frame.

    x points across the edge, outwards, and y along it, counter-clockwise around the object.
    """

    move: Array  # (B, 2) mm
    turn: Array  # (B,) deg
    state: ControllerState


def control(
    gains: ControllerGains, state: ControllerState, edge_mm: Array, edge_deg: Array
) -> Command:
    """Compute the next motion from the perceived edge.

    An error sum does not grow further while its correction is at a limit (anti-windup).

    Args:
        edge_mm: (B,) distance of the edge, negative inside.
        edge_deg: (B,) direction of its outward normal.
    """
    across, normal_mm = _compute_correction(
        -edge_mm, state.normal_mm, gains.proportional, gains.integral_mm, gains.limit_mm
    )
    turn, turn_deg = _compute_correction(
        edge_deg, state.turn_deg, gains.proportional, gains.integral_deg, gains.limit_deg
    )
    move = jnp.stack([across, jnp.full_like(across, gains.step_mm)], -1)
    return Command(move, turn, ControllerState(normal_mm, turn_deg))


def _compute_correction(
    error: Array, total: Array, proportional: float, integral: float, limit: float
) -> tuple[Array, Array]:
    new_total = total + error
    unlimited = proportional * error + integral * new_total
    correction = jnp.clip(unlimited, -limit, limit)
    winding_up = (unlimited != correction) & (jnp.sign(error) == jnp.sign(unlimited))
    return correction, jnp.where(winding_up, total, new_total)
