"""Networks of plain Flax layers and of fast ones have the same parameters, values, gradients and statistics, to rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import PoseNet, UNet, UnshearNet
from jaxunshear.environment import KERNELS_VARIABLE, check_environment
from jaxunshear.errors import UserError
from jaxunshear.models import layer_choice, registry

WIDTHS = (16, 16, 32)
NETS = {
    "entangled": UnshearNet(32, WIDTHS, disentangled=False),
    "disentangled": UnshearNet(32, WIDTHS, pose_channels=8, shear_channels=4),
    "unet": UNet(32, WIDTHS),
    "posenet": PoseNet(32, (16, 16, 16, 16, 16), hidden=8),
}


def fresh(net, key):
    return registry.get_functions(net).init(net, registry.InitFacts(outputs=3), key)


def training_pass(net, variables, images):
    """Outputs, and the new running statistics."""
    functions = registry.get_functions(net)
    if functions.predict_training:
        return functions.predict_training(net, variables, images)
    return functions.reconstruct(net, variables, images, jax.random.key(0))


def put_to_use(net, variables, images):
    run = registry.predict if registry.get_functions(net).predict else registry.unshear
    return run(net, variables, images)


def everything(net, way, dtype):
    """Variables, outputs in training and in use, statistics, gradients of all parameters."""
    with layer_choice.use_layers(way):
        variables = jax.tree.map(
            lambda x: x.astype(dtype), jax.jit(lambda key: fresh(net, key))(jax.random.key(0))
        )
        images = jax.random.bernoulli(jax.random.key(1), 0.3, (3, 32, 32, 1)).astype(dtype)

        def loss(params):
            outputs, statistics = training_pass(net, variables | {"params": params}, images)
            leaves = jax.tree.leaves(outputs)
            return sum(
                jnp.sum(jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape) * leaf)
                for leaf in leaves
            ), (outputs, statistics)

        gradients, (outputs, statistics) = jax.jit(jax.grad(loss, has_aux=True))(
            variables["params"]
        )
        used = jax.jit(lambda given, seen: put_to_use(net, given, seen))(variables, images)
    return jax.tree.map(np.asarray, (variables, outputs, statistics, used, gradients))


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
    plain, fast = (
        everything(NETS[name], way, jnp.float32) for way in (layer_choice.PLAIN, layer_choice.FAST)
    )
    jax.tree.map(np.testing.assert_array_equal, plain[0], fast[0])  # one seed, the same weights
    close(plain[1:], fast[1:], 2e-5)


@pytest.mark.parametrize("name", [pytest.param("disentangled", marks=pytest.mark.long), "posenet"])
def test_they_are_the_same_function_in_double_precision(name):
    with (
        jax.enable_x64(True),
        jax.numpy_dtype_promotion("standard"),
    ):  # Flax' statistics begin in single precision
        plain, fast = (
            everything(NETS[name], way, jnp.float64)
            for way in (layer_choice.PLAIN, layer_choice.FAST)
        )
    close(plain[1:], fast[1:], 1e-12)


def test_the_switch_is_one_variable(monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    assert layer_choice.choose_layers() == layer_choice.FAST
    monkeypatch.setenv(KERNELS_VARIABLE, "plain")
    assert layer_choice.choose_layers() == layer_choice.PLAIN and layer_choice.pick_layer(1, 2) == 1
    monkeypatch.setenv(KERNELS_VARIABLE, "quick")
    with pytest.raises(
        UserError, match="JAXUNSHEAR_KERNELS=quick is unknown: use one of auto, plain, fast"
    ):
        layer_choice.choose_layers()
    with pytest.raises(UserError, match=KERNELS_VARIABLE):
        check_environment()
