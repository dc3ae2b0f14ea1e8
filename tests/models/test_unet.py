"""The U-Net: shapes, what it shares with UnshearNet, and that its skips carry what a code cannot."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import UNet, UnshearNet
from jaxunshear.errors import UserError
from jaxunshear.models import registry, unet, unshearnet
from jaxunshear.training.trainer import get_compile_options

NET = UNet(size=32, widths=(4, 6, 8))
init = jax.jit(unet.init, static_argnums=0, compiler_options=get_compile_options())
unshear = jax.jit(registry.unshear, static_argnums=0)


def images(count=3, size=32):
    return jnp.asarray(np.random.default_rng(0).random((count, size, size, 1)) < 0.2, jnp.float32)


@pytest.mark.parametrize("widths", [(4, 6), pytest.param((4, 6, 8, 6), marks=pytest.mark.long)])
def test_images_come_out_as_large_as_they_went_in(widths):
    net = replace(NET, widths=widths)
    variables = init(net, jax.random.key(0))
    found = unshear(net, variables, images())
    assert found.shape == (3, 32, 32, 1)
    assert 0 < float(found.min()) < float(found.max()) < 1
    np.testing.assert_allclose(registry.unshear(net, variables, images()), found, atol=1e-6)
    trained, statistics = jax.eval_shape(partial(unet.reconstruct, net), variables, images())
    assert trained.canonical.shape == found.shape
    assert trained.sheared is None and trained.z_p is None
    assert jax.tree.structure(statistics) == jax.tree.structure(variables["batch_stats"])


def test_skips_keep_every_pixel_in_its_place():
    """A dot moves the output only near itself in the last layer's skip: with all other paths cut, far pixels stay."""
    start = init(NET, jax.random.key(1))
    cut = {
        name: jax.tree.map(lambda x, scale=0 if name.startswith("Up") else 10: scale * x, part)
        for name, part in start["params"].items()
    }
    dot = jnp.zeros((1, 32, 32, 1)).at[0, 10, 20].set(1.0)
    without, with_dot = (unshear(NET, start | {"params": cut}, x) for x in (0 * dot, dot))
    changed = np.argwhere(np.abs(np.asarray(with_dot - without))[0, ..., 0] > 1e-7)
    assert len(changed)
    assert np.abs(changed - [10, 20]).max() <= 4


def test_a_size_that_cannot_be_halved_is_refused():
    with pytest.raises(UserError, match="size"):
        unet.init(replace(NET, size=36), jax.random.key(0))


@pytest.mark.parametrize(
    "widths", [(16, 32, 64, 128, 256), pytest.param((32, 64, 64, 128, 256), marks=pytest.mark.long)]
)
def test_the_large_entangled_network_has_as_many_parameters(widths):
    net = UnshearNet(widths=widths)
    large = unshearnet.match_entangled_size(net)
    assert not large.disentangled
    pairs = list(zip((1, *large.widths), large.widths, strict=False))
    down = [16 * a * b + 2 * b for a, b in pairs]  # kernel, scale, bias
    up = [16 * b * a + 2 * a for a, b in pairs[1:]]
    count = unshearnet.count_parameters
    assert count(large) == sum(down) + sum(up) + 16 * large.widths[0] + 1
    assert count(large) == pytest.approx(count(net), rel=0.01)
    assert count(replace(net, disentangled=False)) < 0.6 * count(net)
