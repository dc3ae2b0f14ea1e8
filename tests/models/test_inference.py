"""Weights as constants: the same answers, nothing left to do for each image but what depends on it."""

import re

import jax
import numpy as np
import pytest

from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.inference.forward import jit_for_inference
from jaxunshear.models import posenet, unshearnet
from jaxunshear.training.trainer import get_compile_options

UNSHEAR = UnshearNet(size=32, widths=(4, 8, 8), pose_channels=6, shear_channels=5)
POSE = PoseNet(size=32, widths=(4, 8, 8, 8, 8), hidden=8)


def unshear(variables, images):
    return unshearnet.unshear(UNSHEAR, variables, images)


def pose_init(net, key):
    return posenet.init(net, 5, key)


def predict(variables, images):
    return posenet.predict(POSE, variables, images)


@pytest.mark.parametrize(
    ("run", "init", "net"),
    [(unshear, unshearnet.init, UNSHEAR), (predict, pose_init, POSE)],
    ids=["unshear", "posenet"],
)
def test_ready_networks_answer_alike_and_take_images_alone(run, init, net):
    variables = jax.jit(init, static_argnums=0, compiler_options=get_compile_options())(
        net, jax.random.key(0)
    )
    images = np.random.default_rng(0).random((2, 32, 32, 1), np.float32)
    prepared, plain = jit_for_inference(run, variables), jax.jit(run)
    np.testing.assert_allclose(prepared(images), plain(variables, images), rtol=1e-5, atol=1e-6)
    compiled = prepared.lower(images).compile()
    assert len(re.findall(r" parameter\(\d+\)", compiled.as_text().split("ENTRY")[1])) == 1
    # the first and last kernels, spread by einsums on every call, are no longer part of the work
    assert (
        compiled.cost_analysis()["flops"]
        < plain.lower(variables, images).compile().cost_analysis()["flops"]
    )
