"""Pins drawn as round dots, where only their places are known.

>>> images = draw_dots(pins, radius_px=1.4, size=128)       # (B, P, 2) px -> (B, 128, 128, 1) in {0, 1}
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Float32


def draw_dots(
    pins: Float[Array, "B P 2"], radius_px: float, size: int
) -> Float32[Array, "B {size} {size} 1"]:
    """Binary images of pins px as (column, row); a pin that is NaN is not drawn.

    A Gaussian is separable, so all dots of an image are one product of matrices; its level at the radius is the threshold.
    """
    pixel = jnp.arange(size, dtype=pins.dtype)
    seen = jnp.isfinite(pins).all(-1, keepdims=True)
    place = jnp.where(seen, pins, -1e3)
    column, row = (
        jnp.exp2(-jnp.square((pixel[None, :, None] - place[:, None, :, k]) / radius_px))
        for k in (0, 1)
    )
    level = jnp.matmul(row, column.swapaxes(-1, -2))
    return (level >= 0.5).astype(jnp.float32)[..., None]
