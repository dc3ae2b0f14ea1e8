"""Rotation augmentation: recorded pins as they would have moved, had the sensor been turned.

rotations = make_rotations(rest, sense)                    # rest (P, 2) px
pins = rotate_pins(rotations, k, pins)                     # (B, P, 2) px, turned by the k-th angle
outputs = rotate_outputs(rotations, k, outputs, targets)   # the pose that goes with it

The sensor is turned about its axis. A dome is nearly the same all round, but its camera and its
housing are not. So the network is also given the angle of each example, and examples that are not
turned correct what it predicts of pins that are not turned.
"""

from functools import partial
from typing import NamedTuple

import jax
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
# over their motion: turned taps that differ less from recorded ones resemble them
MAX_MOTION_DIFFERENCE = 0.75


class Rotations(NamedTuple):
    """Rotations by k circles over ANGLES; the label turns by as much times `sense`."""

    rest: Array  # (P, 2) px
    # (ANGLES, P, P) weights of all pins in the motion at the place that is turned onto a pin
    mixed: Array
    rotation: Array  # (ANGLES, 2, 2)
    radians: Array  # (ANGLES,)
    sense: int  # 1 or -1


def make_rotations(rest: Float[np.ndarray, "P 2"], sense: int) -> Rotations:
    """Make the rotations of pins that rest at `rest` px, with thin-plate splines between pins."""
    rest = np.asarray(rest, np.float64)
    radians = 2 * np.pi * np.arange(ANGLES) / ANGLES
    rotation = rotation_2d(radians)
    spline = RBFInterpolator(rest, np.eye(len(rest)), neighbors=min(SPLINE_NEIGHBOURS, len(rest)))
    middle = rest.mean(axis=0)
    mixed = np.stack([spline((rest - middle) @ each + middle) for each in rotation])
    single = partial(jnp.asarray, dtype=jnp.float32)
    return Rotations(single(rest), single(mixed), single(rotation), single(radians), sense)


def sample_rotation(share: float, key: Array) -> Array:
    """Sample one angle for a batch: any of them with probability `share`, else none."""
    chance_key, angle_key = jax.random.split(key)
    is_rotated = jax.random.uniform(chance_key) < share
    return jnp.where(is_rotated, jax.random.randint(angle_key, (), 0, ANGLES), 0)


def rotate_pins(
    rotations: Rotations, k: ArrayLike, pins: Float[Array, "B P 2"]
) -> Float[Array, "B P 2"]:
    """Turn pins px by angle `k`; missing pins count as untouched."""
    motion = jnp.where(jnp.isfinite(pins), pins - rotations.rest[None], 0)
    return rotations.rest[None] + jnp.einsum(
        "pq,bqi,ji->bpj", rotations.mixed[k], motion, rotations.rotation[k]
    )


def rotate_outputs(
    rotations: Rotations, k: ArrayLike, outputs: Float[Array, "B K"], targets: Targets
) -> Float[Array, "B K"]:
    """Turn PoseNet's outputs in [0, 1] by angle `k`: only the twist changes."""
    angle = rotations.sense * rotations.radians[k]
    column = 0
    parts = []
    for target in targets:
        part = outputs[:, column : column + target.outputs]
        if target.name == TWIST:
            cosine, sine = 2 * part[:, 0] - 1, 2 * part[:, 1] - 1
            rotated = (
                cosine * jnp.cos(angle) - sine * jnp.sin(angle),
                sine * jnp.cos(angle) + cosine * jnp.sin(angle),
            )
            part = (1 + jnp.stack(rotated, -1)) / 2
        parts.append(part)
        column += target.outputs
    return jnp.concatenate(parts, -1)


def find_rotation_sense(
    rest: Float[np.ndarray, "P 2"],
    pins: Float[np.ndarray, "N P 2"],
    poses: Float[np.ndarray, "N 6"],
    targets: Targets,
) -> int:
    """Find whether the twist grows (1) or falls (-1) as pins px turn from x towards y of the image.

    Taps are turned both ways and compared with the recorded taps at the nearest poses.

    Raises UserError if the twist is no target over the full circle, and if turned taps resemble the
    recorded ones neither way: then the stimulus does not turn with its label.
    """
    if not any(target.name == TWIST and target.is_circular for target in targets):
        raise UserError(
            f"pins.turned: asks for {TWIST} over the full circle among the targets: leave it at 0"
        )
    rows = np.random.default_rng(0).choice(len(pins), min(TRIED_TAPS, len(pins)), replace=False)
    motion = np.where(np.isfinite(pins), pins - rest, 0)
    differences = {}
    for sense in (1, -1):
        rotations = make_rotations(rest, sense)
        ratios = []
        for k in (ANGLES // 6, ANGLES // 4):
            rotated_poses = poses[rows].copy()
            rotated_poses[:, 5] += sense * 360 * k / ANGLES
            nearest, _ = pairing.find_nearest(targets, rotated_poses, poses)
            rotated_pins = np.asarray(rotate_pins(rotations, k, jnp.asarray(pins[rows])))
            difference = rotated_pins - rest - motion[nearest]
            size = np.linalg.norm(motion[nearest], axis=(1, 2))
            ratios.append(np.linalg.norm(difference, axis=(1, 2)) / size)
        differences[sense] = float(np.median(ratios))
    sense = min(differences, key=differences.__getitem__)
    if not differences[sense] < MAX_MOTION_DIFFERENCE:
        raise UserError(
            "pins.turned: turned touches do not resemble recorded ones "
            f"(they differ by {differences[sense]:.2f} of their motion): leave it at 0"
        )
    return sense
