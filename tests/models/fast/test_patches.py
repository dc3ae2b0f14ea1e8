"""Convolutions as one matrix product: values and gradients of `lax.conv_general_dilated`, and a trunk over pins of either form."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxunshear.config.networks import PinUnshear
from jaxunshear.models import layer_choice, pin_networks
from jaxunshear.models.fast.conv import convolve

ORDER = ("NHWC", "HWIO", "NHWC")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("side", [1, 2, 7, 20])
def test_values_and_gradients_are_those_of_a_convolution(side, stride, dtype):
    with jax.enable_x64(dtype is np.float64):
        given = (
            jax.random.normal(jax.random.key(0), (2, side, side + 1, 3), dtype),
            jax.random.normal(jax.random.key(1), (3, 3, 3, 5), dtype),
        )

        def found(way):
            def loss(x, w):
                y = way(x, w, (stride, stride), "SAME", dimension_numbers=ORDER)
                return jnp.sum(jnp.sin(y)), y

            return jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True))(*given)

        ours, theirs = found(convolve), found(lax.conv_general_dilated)
    near = partial(
        np.testing.assert_allclose, rtol=0, atol=(1e-4 if dtype is np.float32 else 1e-12)
    )
    assert all(leaf.dtype == dtype for leaf in jax.tree.leaves(ours))
    jax.tree.map(near, ours, theirs)


def test_a_trunk_over_pins_is_the_same_with_plain_layers():
    net = PinUnshear(hidden=8, layers=1, convolved=(4, 6))
    rest = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), -1).reshape(-1, 2) * 7
    variables = pin_networks.init(net, rest, 2.0, jax.random.key(0))
    pins = rest[None] + jax.random.normal(jax.random.key(1), (3, *rest.shape))

    def found(way):
        with layer_choice.use_layers(way):
            return np.asarray(jax.jit(partial(pin_networks.unshear, net))(variables, pins))

    fast, plain = found(layer_choice.FAST), found(layer_choice.PLAIN)
    np.testing.assert_allclose(fast, plain, atol=1e-4)
    assert np.abs(plain - rest[None]).max() > 1e-3
