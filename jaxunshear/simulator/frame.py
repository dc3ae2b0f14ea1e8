"""Rotations between sensor frame, level frame and target frame, and lengths of motions.

The level frame is the sensor frame with its tilt undone: there the stimulus' top is the plane
z = 0. A `Frame` holds the rotations (B, 3, 3) from the sensor frame to the level frame, or None
where no sensor is tilted.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxunshear.simulator.paths import DEPTH, TILT_X, TURNS

Frame = Float[jax.Array, "B 3 3"] | None


def compute_level_frame(pose: Float[jax.Array, "B 6"]) -> Float[jax.Array, "B 3 3"]:
    """Compute the rotations from the sensor frame to the level frame of poses (Rodrigues)."""
    tilt = pose[:, TILT_X:]
    squared = jnp.sum(tilt**2, axis=-1)[:, None, None]
    angle = jnp.sqrt(jnp.maximum(squared, 1e-30))
    zero = jnp.zeros_like(tilt[:, 0])
    x, y = tilt[:, 0], tilt[:, 1]
    rows = [jnp.stack(row, -1) for row in ((zero, zero, y), (zero, zero, -x), (-y, x, zero))]
    cross = jnp.stack(rows, 1)
    return (
        jnp.eye(3, dtype=pose.dtype)[None]
        + jnp.sin(angle) / angle * cross
        + matmul((1 - jnp.cos(angle)) / angle**2 * cross, cross)
    )


def matmul(
    a: Float[jax.Array, "*A m k"], b: Float[jax.Array, "*B k n"]
) -> Float[jax.Array, "*C m n"]:
    """Multiply matrices in their own precision, also on a GPU.

    A GPU would otherwise round float32 to ten bits, which no part of the physics may do.
    """
    return jnp.matmul(a, b, precision="highest")


def transpose(frame: Frame) -> Frame:
    return None if frame is None else jnp.swapaxes(frame, 1, 2)


def rotate(frame: Frame, vectors: Float[jax.Array, "B N d"]) -> Float[jax.Array, "B N d"]:
    if frame is None:
        return vectors
    return jnp.einsum("bij,bnj->bni", frame, vectors, precision="highest")


def rotate_back(frame: Frame, vectors: Float[jax.Array, "B N d"]) -> Float[jax.Array, "B N d"]:
    if frame is None:
        return vectors
    return jnp.einsum("bji,bnj->bni", frame, vectors, precision="highest")


def transform_to_level(
    frame: Frame, points: Float[jax.Array, "B N 3"], centre_mm: Float[jax.Array, ""]
) -> Float[jax.Array, "B N 3"]:
    """Transform points of the sensor frame to the level frame.

    The lowest point of the dome lies at z = 0 in the level frame.
    """
    if frame is None:
        return points
    zero = jnp.zeros_like(centre_mm)
    centre = jnp.stack([zero, zero, centre_mm])[None, None]
    return rotate(frame, points - centre) + centre


def rotate_in_plane(
    angle: Float[jax.Array, "B"], xy: Float[jax.Array, "B N 2"]
) -> Float[jax.Array, "B N 2"]:
    """Rotate points in the plane by angles in rad."""
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    return jnp.stack(
        [cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], axis=-1
    )


def compute_increment_length(
    before: Float[jax.Array, "B 6"], after: Float[jax.Array, "B 6"], radius_mm: Float[jax.Array, ""]
) -> Float[jax.Array, "B"]:
    """Compute by how many mm the dome's tip moves; turns count at `radius_mm`."""
    change = after - before
    turns = radius_mm * jnp.linalg.norm(change[:, jnp.array(TURNS)], axis=-1)
    return jnp.linalg.norm(change[:, jnp.array([0, 1, DEPTH])], axis=-1) + turns
