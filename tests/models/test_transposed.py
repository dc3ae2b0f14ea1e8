"""The transposed convolution is Flax's, written so that XLA has cuDNN's gradient for its kernel."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.models.layers import ConvTranspose

OURS, FLAX = ConvTranspose(4, use_bias=False), nn.ConvTranspose(4, (4, 4), (2, 2), use_bias=False)
X = jax.random.normal(jax.random.key(0), (2, 5, 7, 3))


def slopes(layer: nn.Module) -> tuple[Array, Array]:
    kernel = FLAX.init(jax.random.key(1), X)

    def value(kernel: dict, x: Array) -> Array:
        return jnp.sum(jnp.sin(layer.apply(kernel, x)))

    return jax.grad(value, (0, 1))(kernel, X)


def test_a_seed_gives_the_kernel_that_flax_would_have() -> None:
    ours, flax = (layer.init(jax.random.key(1), X)["params"]["kernel"] for layer in (OURS, FLAX))
    np.testing.assert_array_equal(ours, flax)


def test_values_and_gradients_are_those_of_flax() -> None:
    kernel = FLAX.init(jax.random.key(1), X)
    np.testing.assert_allclose(OURS.apply(kernel, X), FLAX.apply(kernel, X), atol=1e-5)
    for ours, flax in zip(
        jax.tree.leaves(slopes(OURS)), jax.tree.leaves(slopes(FLAX)), strict=True
    ):
        np.testing.assert_allclose(ours, flax, atol=1e-4)


def test_no_convolution_of_its_gradient_is_dilated() -> None:
    ours, flax = (
        jax.jit(lambda layer=layer: slopes(layer)).lower().as_text() for layer in (OURS, FLAX)
    )
    assert "lhs_dilate = [2, 2]" in flax
    assert "lhs_dilate = [2, 2]" not in ours
    assert "rhs_dilate = [2, 2]" not in ours
