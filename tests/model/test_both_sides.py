"""Unshearing from both sides: a mirror image in gives the mirror image out, whatever the network has learnt."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.dataset.reading import mirrored
from jaxunshear.model import unet, unshearnet
from jaxunshear.model.layers import both_sides
from jaxunshear.model.settings import UNet, UnshearNet
from jaxunshear.model.unshearing import unshear
from jaxunshear.training.loop import run_once

NETS = {
    "disentangled": UnshearNet(size=32, widths=(6, 8), pose_channels=4, shear_channels=3),
    "unet": UNet(size=32, widths=(4, 6)),
}


@pytest.fixture(scope="module")
def images():
    return (jax.random.uniform(jax.random.key(1), (3, 32, 32, 1)) > 0.7).astype(jnp.float32)


def in_mirror(images):
    """As training mirrors each of them."""
    return jnp.stack([mirrored({"sheared": image})["sheared"] for image in np.asarray(images)])


@pytest.fixture(scope="module", params=NETS)
def network(request):
    net = NETS[request.param]
    init = unet.init if isinstance(net, UNet) else unshearnet.init
    variables = jax.jit(init, static_argnums=0, compiler_options=run_once())(net, jax.random.key(0))
    return net, jax.tree.map(lambda x: 10 * x, variables)  # fresh kernels are so small that every image is grey


@pytest.mark.parametrize("jit", [False, True])
def test_a_mirror_image_in_gives_the_mirror_image_out(network, images, jit):
    net, variables = network
    plain, both = (partial(unshear, n) for n in (net, replace(net, both_sides=True)))
    if jit:
        plain, both = jax.jit(plain), jax.jit(both)
    given = both(variables, images)
    np.testing.assert_allclose(both(variables, in_mirror(images)), in_mirror(given), atol=1e-6)
    once, turned = plain(variables, images), plain(variables, in_mirror(images))
    np.testing.assert_allclose(given, (once + in_mirror(turned)) / 2, atol=1e-6)
    assert float(jnp.abs(turned - in_mirror(once)).max()) > 1e-3  # alone it does not


def test_each_image_is_on_its_own(network, images):
    net, variables = network
    run = jax.jit(partial(unshear, replace(net, both_sides=True)))
    np.testing.assert_allclose(run(variables, images[1:2]), run(variables, images)[1:2], atol=1e-6)


def test_what_keeps_every_pixel_is_kept(images):
    np.testing.assert_array_equal(both_sides(lambda x: x, images), images)


def test_it_costs_twice_and_only_where_it_is_asked_for(network, images):
    net, variables = network
    plain, both = (
        jax.jit(partial(unshear, n)).lower(variables, images).cost_analysis()["flops"]
        for n in (net, replace(net, both_sides=True))
    )
    assert plain < both < 2.1 * plain and both > 1.9 * plain
