"""Operations of networks, against counts by hand."""

import jax
import numpy as np
import pytest

from jaxunshear.config.networks import PinPoseNet, PinRenderer, PinUnshear, PoseNet, UnshearNet
from jaxunshear.models.operations import measure_size
from jaxunshear.models.registry import InitFacts, get_functions

PINS = np.random.default_rng(0).uniform(10, 50, (7, 2)).astype(np.float32)


def size_of(net, outputs=0):
    facts = InitFacts(outputs, rest=PINS)
    variables = jax.eval_shape(
        lambda key: get_functions(net).init(net, facts, key), jax.random.key(0)
    )
    variables = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), variables)
    return variables, measure_size(net, variables, outputs)


@pytest.mark.parametrize("net", [PinPoseNet(hidden=256), PinRenderer(hidden=256)])
def test_a_dense_layer_has_two_operations_for_each_weight(net):
    variables, size = size_of(net, outputs=3)
    leaves = jax.tree.leaves(variables["params"])
    weights = sum(leaf.size for leaf in leaves if leaf.ndim == 2)
    assert size.parameters == sum(leaf.size for leaf in leaves)
    assert 2 * weights <= size.operations <= 2.1 * weights


def test_convolutions_grow_with_the_area_of_the_image():
    for kind in (UnshearNet, PoseNet):
        small, large = (size_of(kind(size=size), 3)[1].operations for size in (64, 128))
        assert large == pytest.approx(4 * small, rel=0.1)


def test_parts_that_unshearing_leaves_out_are_not_counted():
    """DS and z_s are parameters, and no work."""
    _, with_code = size_of(PinUnshear(shear_code=4))
    _, without = size_of(PinUnshear(shear_code=0))
    assert with_code.parameters > without.parameters
    assert with_code.operations == pytest.approx(without.operations, rel=0.01)
