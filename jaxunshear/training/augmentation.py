"""Augmentation of pins: rotation of recorded ones, domain randomisation of simulated ones.

rotations = make_rotations(rest, sense)                    # rest (P, 2) px
pins = rotate_pins(rotations, k, pins)                     # (B, P, 2) px, turned by the k-th angle
outputs = rotate_outputs(rotations, k, outputs, targets)   # the pose that goes with it

Rotated pins are as they would have moved, had the sensor been turned about its axis. A dome is
nearly the same all round, but its camera and its housing are not. So the network is also given the
angle of each example, and examples that are not turned correct what it predicts of pins that are
not turned.

rotate = make_pair_rotation(rest, share)
batch, is_rotated = rotate(batch, key)  # {"canonical_pins", "sheared_pins"}

A slide and its tap are turned together. The network that unshears is not given the angle, as what
it predicts is turned, too. Their labels do not fit any more.

randomise = make_randomisation(rest, share)  # rest in px
# {"pins"}, or {"canonical_pins", "sheared_pins"} (B, P, 2) px, and {"edge"}
batch = randomise(batch, key)

Randomised pins are as another sensor, camera and day would show them; networks that learn from them
work on real skin. Each batch is turned by one angle, and the edge's direction with it. For each
contact we draw how far its slide drags the pins, which depends on the friction of an unknown skin,
and how the sensor sits before its camera. Canonical pins keep their places, so unshearing removes
the camera's place as well.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator

from jaxunshear.angles import rotate_2d, rotation_2d, wrap_degrees
from jaxunshear.config.targets import Targets
from jaxunshear.data import pairing
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models.pin_networks import find_inside
from jaxunshear.perception.lattice import measure_spacing

TWIST = "Rz_deg"  # the angle about the sensor's axis
ANGLES = 24  # a circle, in steps of 15 deg
SPLINE_NEIGHBOURS = 40  # pins that the motion between them is interpolated from
TRIED_TAPS = 200  # taps that are turned to find the sense
# over their motion: turned taps that differ less from recorded ones resemble them
MAX_MOTION_DIFFERENCE = 0.75
# Factor of the simulated motion of a slide, uniform in its logarithm. We assume that skin which
# slips is dragged in proportion to its friction: 0.2 to 0.8, as of rubber on plastic, is half to
# twice the fitted 0.39. No recorded slide decides this range.
MOTION_FACTOR = (0.5, 2.0)
# standard deviations of the camera's place
TURNED_DEG = 4.0
SHIFTED = 0.065  # in spacings of the pins
Batch = Json


class Rotations(NamedTuple):
    """Rotations by k circles over ANGLES; the label turns by as much times `sense`."""

    rest: Array  # (P, 2) px
    # (ANGLES, P, P) weights of all pins in the motion at the place that is turned onto a pin; with
    # mirrored ones twice as many
    mixed: Array
    rotation: Array  # as many, (2, 2) each
    radians: Array  # (ANGLES,)
    sense: int  # 1 or -1


def make_rotations(rest: Float[np.ndarray, "P 2"], sense: int, mirrored: bool = False) -> Rotations:
    """Make the rotations of pins that rest at `rest` px, with thin-plate splines between pins.

    `mirrored`: as many more, of mirrored pins.
    """
    rest = np.asarray(rest, np.float64)
    radians = 2 * np.pi * np.arange(ANGLES) / ANGLES
    rotation = rotation_2d(radians)
    if mirrored:
        rotation = np.concatenate([rotation, rotation @ np.diag([1.0, -1.0])])
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
            f"pins.rotated_share: asks for {TWIST} over the full circle among the targets: "
            "leave it at 0"
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
            "pins.rotated_share: turned touches do not resemble recorded ones "
            f"(they differ by {differences[sense]:.2f} of their motion): leave it at 0"
        )
    return sense


def make_randomisation(
    rest: Float[np.ndarray, "P 2"], share: float
) -> Callable[[Batch, Array], Batch]:
    """Make the function that randomises a `share` of all batches; the others stay as they are."""
    rotations, spacing_px = make_rotations(rest, 1), measure_spacing(rest)

    def randomise(batch: Batch, key: Array) -> Batch:
        chance_key, angle_key, motion_key, camera_key = jax.random.split(key, 4)
        k = jax.random.randint(angle_key, (), 0, ANGLES)
        randomised = batch | _rotate_batch(rotations, k, batch)
        if "sheared_pins" in randomised and "canonical_pins" in randomised:
            tap, slide = randomised["canonical_pins"], randomised["sheared_pins"]
            log_factor = jax.random.uniform(
                motion_key, (len(tap), 1, 1), tap.dtype, *np.log(MOTION_FACTOR)
            )
            randomised["sheared_pins"] = tap + jnp.exp(log_factor) * (slide - tap)
        field = "sheared_pins" if "sheared_pins" in randomised else "pins"
        randomised[field] = _randomise_camera(
            rotations.rest, randomised[field], SHIFTED * spacing_px, camera_key
        )
        is_randomised = jax.random.uniform(chance_key) < share
        return {
            name: jnp.where(is_randomised, randomised[name], value) for name, value in batch.items()
        }

    return randomise


def make_pair_rotation(
    rest: Float[np.ndarray, "P 2"], share: float
) -> Callable[[Batch, Array], tuple[Batch, Array]]:
    """Make the function that turns a `share` of all batches, and mirrors half of these.

    Slides and their taps turn together, and labels stay. It also returns whether a batch turned.
    Pins are turned by angles alone that bring all of them near others: of a square pad by four.
    """
    rotations = make_rotations(rest, 1, mirrored=True)
    fitting = jnp.asarray(_find_fitting(rest, np.asarray(rotations.rotation)))

    def rotate(batch: Batch, key: Array) -> tuple[Batch, Array]:
        chance_key, angle_key = jax.random.split(key)
        is_rotated = jax.random.uniform(chance_key) < share
        k = fitting[jax.random.randint(angle_key, (), 0, len(fitting))]

        def turn(pins: Array) -> Array:
            is_missing = jnp.isnan(pins[..., 0]).astype(pins.dtype)
            missing = jnp.einsum("pq,bq->bp", jnp.abs(rotations.mixed[k]), is_missing)
            turned = rotate_pins(rotations, k, pins)
            return jnp.where(missing[..., None] < 0.5, turned, jnp.nan)

        rotated = {
            name: jnp.where(is_rotated, turn(pins), pins)
            for name, pins in batch.items()
            if name.endswith("pins")
        }
        return batch | rotated, is_rotated

    return rotate


def _find_fitting(rest: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Find the rotations that ask for no motion beyond the rim."""
    pins = np.asarray(rest, np.float64)
    middle = pins.mean(axis=0)
    turned = np.stack([(pins - middle) @ each + middle for each in rotation])
    return np.flatnonzero(find_inside(pins, turned).all(axis=1))


def _rotate_batch(rotations: Rotations, k: Array, batch: Batch) -> Batch:
    """Turn all pins of a batch by angle `k`, and the edge's direction, degrees in (-180, 180]."""
    rotated = {
        name: rotate_pins(rotations, k, batch[name]) for name in batch if name.endswith("pins")
    }
    if "edge" in batch:
        degrees = batch["edge"][:, 1] + jnp.degrees(rotations.radians[k])
        rotated["edge"] = jnp.stack([batch["edge"][:, 0], wrap_degrees(degrees)], -1)
    return rotated


def _randomise_camera(rest: Array, pins: Array, shift_px: float, key: Array) -> Array:
    """Turn and shift the sensor of each example before its camera, pins (B, P, 2) px."""
    angle_key, shift_key = jax.random.split(key)
    radians = jnp.radians(TURNED_DEG) * jax.random.normal(angle_key, (len(pins), 1))
    middle = rest.mean(axis=0)
    rotated = rotate_2d(pins - middle[None, None], radians)
    shape = (len(pins), 1, 2)
    return middle[None, None] + rotated + shift_px * jax.random.normal(shift_key, shape)
