"""Recorded pins as they would have moved, had the sensor been turned about its axis: examples that nobody had to record.

turns = make_rotations(rest, sense)                         # rest (P, 2) px
pins = rotate_pins(turns, k, pins)                         # (B, P, 2) px, turned by the k-th angle
outputs = rotate_outputs(turns, k, outputs, targets)  # the pose that goes with it

A dome is nearly the same all round, its camera and its housing are not. So the network is given how far each example was turned, and
what it reads off pins as they are is corrected by examples as they are.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator

from jaxunshear.angles import rotation_2d
from jaxunshear.config.targets import Targets
from jaxunshear.data import pairing
from jaxunshear.errors import UserError

TWIST = "Rz_deg"  # the angle about the sensor's axis
ANGLES = 24  # a circle, in steps of 15 deg
SPLINE_NEIGHBOURS = 40  # pins that the motion between them is interpolated from
TRIED_TAPS = 200  # taps that are turned to find the sense
MAX_MOTION_DIFFERENCE = 0.75  # of their own motion: how far turned taps may be from recorded ones, and still resemble them


class Rotations(NamedTuple):
    """Angle k turns the pins' motions by k circles over ANGLES, and the label by as much times `sense`."""

    rest: Array  # (P, 2) px
    mixed: Array  # (ANGLES, P, P): the motion at the place that comes to lie at a pin, of those of all pins
    rotation: Array  # (ANGLES, 2, 2)
    radians: Array  # (ANGLES,)
    sense: int  # 1 or -1


def make_rotations(rest: Float[np.ndarray, "P 2"], sense: int) -> Rotations:
    """Of pins that stand untouched at `rest` px: thin-plate splines between them."""
    rest = np.asarray(rest, np.float64)
    radians = 2 * np.pi * np.arange(ANGLES) / ANGLES
    rotation = rotation_2d(radians)
    spline = RBFInterpolator(rest, np.eye(len(rest)), neighbors=min(SPLINE_NEIGHBOURS, len(rest)))
    middle = rest.mean(axis=0)
    mixed = np.stack([spline((rest - middle) @ each + middle) for each in rotation])
    single = partial(jnp.asarray, dtype=jnp.float32)
    return Rotations(single(rest), single(mixed), single(rotation), single(radians), sense)


def rotate_pins(
    rotations: Rotations, k: ArrayLike, pins: Float[Array, "B P 2"]
) -> Float[Array, "B P 2"]:
    """Pins px after a turn by angle `k`; pins that are not seen count as untouched."""
    motion = jnp.where(jnp.isfinite(pins), pins - rotations.rest[None], 0)
    return rotations.rest[None] + jnp.einsum(
        "pq,bqi,ji->bpj", rotations.mixed[k], motion, rotations.rotation[k]
    )


def rotate_outputs(
    rotations: Rotations, k: ArrayLike, outputs: Float[Array, "B K"], targets: Targets
) -> Float[Array, "B K"]:
    """PoseNet's outputs in [0, 1] of the pose after that turn: of all targets only the twist changes."""
    angle, column, columns = rotations.sense * rotations.radians[k], 0, []
    for target in targets:
        here = outputs[:, column : column + target.outputs]
        if target.name == TWIST:
            cosine, sine = 2 * here[:, 0] - 1, 2 * here[:, 1] - 1
            after = (
                cosine * jnp.cos(angle) - sine * jnp.sin(angle),
                sine * jnp.cos(angle) + cosine * jnp.sin(angle),
            )
            here = (1 + jnp.stack(after, -1)) / 2
        columns.append(here)
        column += target.outputs
    return jnp.concatenate(columns, -1)


def find_rotation_sense(
    rest: Float[np.ndarray, "P 2"],
    pins: Float[np.ndarray, "N P 2"],
    poses: Float[np.ndarray, "N 6"],
    targets: Targets,
) -> int:
    """Whether the twist grows (1) or falls (-1) as the pins px turn with their labels, from x towards y of the image.

    Taps are turned both ways and compared with those recorded nearest to where they should be. Raises UserError where the twist is no
    target over the full circle, and where neither resembles what was recorded: then what is touched does not turn with its label.
    """
    if not any(target.name == TWIST and target.is_circular for target in targets):
        raise UserError(
            f"pins.turned: asks for {TWIST} over the full circle among the targets: leave it at 0"
        )
    rows = np.random.default_rng(0).choice(len(pins), min(TRIED_TAPS, len(pins)), replace=False)
    motion = np.where(np.isfinite(pins), pins - rest, 0)
    apart = {}
    for sense in (1, -1):
        turns = make_rotations(rest, sense)
        scores = []
        for k in (ANGLES // 6, ANGLES // 4):
            wanted = poses[rows].copy()
            wanted[:, 5] += sense * 360 * k / ANGLES
            near, _ = pairing.find_nearest(targets, wanted, poses)
            difference = (
                np.asarray(rotate_pins(turns, k, jnp.asarray(pins[rows]))) - rest - motion[near]
            )
            scores.append(
                np.linalg.norm(difference, axis=(1, 2)) / np.linalg.norm(motion[near], axis=(1, 2))
            )
        apart[sense] = float(np.median(scores))
    sense = min(apart, key=apart.__getitem__)
    if not apart[sense] < MAX_MOTION_DIFFERENCE:
        raise UserError(
            f"pins.turned: turned touches do not resemble recorded ones (they differ by {apart[sense]:.2f} of their motion): "
            "leave it at 0"
        )
    return sense
