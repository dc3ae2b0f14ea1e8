"""What both decoders make of slides in training, over images or over pins."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

LEAST_VARIANCE = 1e-3  # of a code: one that says nothing yet is not to agree at any cost


class Decoded(NamedTuple):
    """Logits of images (B, S, S, 1), or pins (B, P, 2) px; None where there is none."""

    canonical: Array
    z_p: Array | None = None  # (B, ...)
    sheared: Array | None = None
    exchanged: Array | None = None  # DS of the slide's pose code and the other's shear code
    disagreement: Array | None = None  # (B,) see `disagreement`
    z_s: Array | None = None  # (B, ...)


def disagreement(one: Float[Array, "B *F"], other: Float[Array, "B *F"]) -> Float[Array, "B"]:
    """Mean square difference of codes that should be equal, over their mean variance in the batch."""
    one, other = (code.reshape(code.shape[0], -1) for code in (one, other))
    variance = jnp.mean(jnp.var(jnp.concatenate([one, other]), axis=0))
    return jnp.mean(jnp.square(one - other), -1) / (variance + LEAST_VARIANCE)
