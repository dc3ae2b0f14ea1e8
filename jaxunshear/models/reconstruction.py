"""The outputs of both decoders in training, over images or over pins, and code agreement."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

RIDGE = 1e-4  # of the mean variance of a code: a direction much narrower than this is rounding
LEAST_VARIANCE = 1e-3  # of a code: one without information yet need not agree at any cost


class Reconstruction(NamedTuple):
    """Logits of images (B, S, S, 1), or pins (B, P, 2) px; None where there is none."""

    canonical: Array
    z_p: Array | None = None  # (B, ...)
    sheared: Array | None = None
    counterfactual: Array | None = None  # DS of the slide's pose code and the other's shear code
    disagreement: Array | None = None  # (B,) see `measure_disagreement`
    z_s: Array | None = None  # (B, ...)
    same_pose: Array | None = None  # DC of the pose code of a second contact at the pose


def measure_disagreement(
    one: Float[Array, "B *F"], other: Float[Array, "B *F"]
) -> Float[Array, "B"]:
    """Measure the squared difference of codes that should be equal, over the variance.

    This is the squared Mahalanobis distance by the covariance of the batch, over the number of
    directions. If the mean variance were used, differences in narrow directions would cost next to
    nothing, and shear that hides there would stay in the pose code.
    """
    one = one.reshape(one.shape[0], -1)
    other = other.reshape(other.shape[0], -1)
    both = jnp.concatenate([one, other])
    centred = both - jnp.mean(both, axis=0, keepdims=True)
    covariance = centred.T @ centred / len(both)
    size = covariance.shape[0]
    floor = RIDGE * jnp.trace(covariance) / size + RIDGE * LEAST_VARIANCE
    covariance += floor * jnp.eye(size, dtype=covariance.dtype)
    difference = one - other
    return jnp.mean(difference * jnp.linalg.solve(covariance, difference.T).T, axis=1)
