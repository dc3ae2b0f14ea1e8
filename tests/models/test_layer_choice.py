"""Plain and fast layers, and weights as constants: the same networks, to rounding."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from jaxunshear.config.networks import PinUnshear, PoseNet, UNet, UnshearNet
from jaxunshear.environment import KERNELS_VARIABLE, check_environment
from jaxunshear.errors import UserError
from jaxunshear.inference.forward import jit_for_inference
from jaxunshear.models import layer_choice, pin_networks, registry
from jaxunshear.models.layers import ConvTranspose
from tests.helpers.convolutions import check_same_function, draw_normal

WIDTHS = (16, 16, 32)
NETS = {
    "entangled": UnshearNet(32, WIDTHS, disentangled=False),
    "disentangled": UnshearNet(32, WIDTHS, pose_channels=8, shear_channels=4),
    "unet": UNet(32, WIDTHS),
    "posenet": PoseNet(32, (16, 16, 16, 16, 16), hidden=8),
}


def fresh(net, key):
    return registry.get_functions(net).init(net, registry.InitFacts(outputs=3), key)


def get_use(net):
    return registry.predict if registry.get_functions(net).predict else registry.unshear


def use_in_training(net, variables, images):
    """Return outputs, and the new running statistics."""
    functions = registry.get_functions(net)
    if functions.predict_training:
        return functions.predict_training(net, variables, images)
    return functions.reconstruct(net, variables, images, jax.random.key(0))


def everything(net, way, dtype):
    """Variables, outputs in training and in use, statistics, gradients of all parameters."""
    with layer_choice.use_layers(way):
        variables = jax.jit(lambda key: fresh(net, key))(jax.random.key(0))
        variables = jax.tree.map(lambda x: x.astype(dtype), variables)
        images = jax.random.bernoulli(jax.random.key(1), 0.3, (3, 32, 32, 1)).astype(dtype)

        def loss(params):
            found = use_in_training(net, variables | {"params": params}, images)
            leaves = jax.tree.leaves(found[0])
            waves = [jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape) for leaf in leaves]
            return sum(map(jnp.vdot, waves, leaves)), found

        gradients, found = jax.jit(jax.grad(loss, has_aux=True))(variables["params"])
        used = jax.jit(partial(get_use(net), net))(variables, images)
    return jax.tree.map(np.asarray, (variables, *found, used, gradients))


def compare(net, dtype=jnp.float32):
    return [everything(net, way, dtype) for way in (layer_choice.PLAIN, layer_choice.FAST)]


def close(one, other, tolerance):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for (path, a), b in zip(jax.tree.leaves_with_path(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape, path
        scale = max(np.abs(a).max(), 1e-3)
        np.testing.assert_allclose(a / scale, b / scale, rtol=0, atol=tolerance, err_msg=str(path))


@pytest.mark.parametrize(
    "name", [pytest.param("entangled", marks=pytest.mark.long), "disentangled", "unet", "posenet"]
)
def test_plain_and_fast_layers_are_one_network(name):
    plain, fast = compare(NETS[name])
    jax.tree.map(np.testing.assert_array_equal, plain[0], fast[0])  # one seed, the same weights
    close(plain[1:], fast[1:], 2e-5)


@pytest.mark.parametrize("name", [pytest.param("disentangled", marks=pytest.mark.long), "posenet"])
def test_they_are_the_same_function_in_double_precision(name):
    # Flax' statistics begin in single precision
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        plain, fast = compare(NETS[name], jnp.float64)
    close(plain[1:], fast[1:], 1e-12)


def test_a_trunk_over_pins_is_the_same_with_plain_layers():
    net = PinUnshear(hidden=8, layers=1, conv_channels=(4, 6))
    rest = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), -1).reshape(-1, 2) * 7
    variables = pin_networks.init(net, rest, 2.0, jax.random.key(0))
    pins = rest[None] + jax.random.normal(jax.random.key(1), (3, *rest.shape))

    def found(way):
        with layer_choice.use_layers(way):
            return np.asarray(jax.jit(partial(pin_networks.unshear, net))(variables, pins))

    fast, plain = found(layer_choice.FAST), found(layer_choice.PLAIN)
    np.testing.assert_allclose(fast, plain, atol=1e-4)
    assert np.abs(plain - rest[None]).max() > 1e-3


def test_the_transposed_convolution_is_flax_s_without_its_dilated_gradient():
    """Written so that XLA has cuDNN's gradient for its kernel."""
    layers = ConvTranspose(4, use_bias=False), nn.ConvTranspose(4, (4, 4), (2, 2), use_bias=False)
    x = draw_normal(2, 5, 7, 3)
    kernels = [layer.init(jax.random.key(1), x)["params"]["kernel"] for layer in layers]
    np.testing.assert_array_equal(*kernels)
    ours, flax = (
        lambda x, w, layer=layer: layer.apply({"params": {"kernel": w}}, x) for layer in layers
    )
    check_same_function(ours, flax, x, kernels[0], 1e-5)
    texts = [
        jax.jit(jax.grad(lambda x, w, f=f: jnp.sum(f(x, w) ** 2), (0, 1))).lower(x, kernels[0])
        for f in (ours, flax)
    ]
    ours, flax = (text.as_text() for text in texts)
    assert "lhs_dilate = [2, 2]" in flax
    assert "lhs_dilate = [2, 2]" not in ours and "rhs_dilate = [2, 2]" not in ours


def test_the_switch_is_one_variable(monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    assert layer_choice.choose_layers() == layer_choice.FAST
    monkeypatch.setenv(KERNELS_VARIABLE, "plain")
    assert layer_choice.choose_layers() == layer_choice.PLAIN and layer_choice.pick_layer(1, 2) == 1
    monkeypatch.setenv(KERNELS_VARIABLE, "quick")
    for check in (layer_choice.choose_layers, check_environment):
        with pytest.raises(
            UserError, match=f"{KERNELS_VARIABLE}=quick is unknown: use one of auto"
        ):
            check()


@pytest.mark.parametrize("name", ["disentangled", "posenet"])
def test_networks_with_constant_weights_answer_alike_and_take_images_alone(name):
    net, images = NETS[name], np.random.default_rng(0).random((2, 32, 32, 1), np.float32)
    variables = jax.jit(partial(fresh, net))(jax.random.key(0))
    run = partial(get_use(net), net)
    prepared, plain = jit_for_inference(run, variables), jax.jit(run)
    np.testing.assert_allclose(prepared(images), plain(variables, images), rtol=1e-5, atol=1e-6)
    compiled, other = prepared.lower(images).compile(), plain.lower(variables, images).compile()
    assert len(re.findall(r" parameter\(\d+\)", compiled.as_text().split("ENTRY")[1])) == 1
    # the first and last kernels, spread by einsums on every call, are no longer part of the work
    assert compiled.cost_analysis()["flops"] < other.cost_analysis()["flops"]
