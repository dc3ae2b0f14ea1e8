"""Plain convolutions, and the comparison of what replaces them: values and both gradients."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

LAYOUT = ("NHWC", "HWIO", "NHWC")


def draw_normal(*shape: int, dtype=jnp.float32) -> jax.Array:
    return jnp.asarray(np.random.default_rng(sum(shape)).normal(size=shape), dtype)


def convolve(x, w, stride=1, padding="VALID"):
    return jax.lax.conv_general_dilated(x, w, 2 * (stride,), padding, dimension_numbers=LAYOUT)


def transpose(x, w):
    return jax.lax.conv_transpose(x, w, (2, 2), "SAME", dimension_numbers=LAYOUT)


def check_close(got, expected, tolerance: float) -> None:
    """Check arrays to a share of the largest entry, and their types."""
    assert got.shape == expected.shape and got.dtype == expected.dtype
    np.testing.assert_allclose(
        got, expected, atol=tolerance * float(np.abs(expected).max()), rtol=0
    )


def check_same_function(ours: Callable, reference: Callable, x, w, tolerance: float) -> None:
    """Check values and both gradients, with and without jit."""
    shaped = jax.eval_shape(reference, x, w)
    dy = draw_normal(*shaped.shape, dtype=shaped.dtype)

    def both(f: Callable) -> tuple[jax.Array, ...]:
        values, pull = jax.vjp(f, x, w)
        return values, *pull(dy)

    expected = jax.jit(lambda: both(reference))()
    for got in (both(ours), jax.jit(lambda: both(ours))()):
        for one, wanted in zip(got, expected, strict=True):
            check_close(one, wanted, tolerance)
