"""`stream` runs networks over images by onnxruntime, and gets what JAX computes."""

import dataclasses
from functools import partial

import jax
import numpy as np
import pytest

from jaxunshear.apps.export import engine
from jaxunshear.apps.export.engine import compile_for_frames
from jaxunshear.inference.forward import compile_networks
from tests.apps.export.test_export import CASES, NET, SIZE, images

OF_IMAGES = [name for name in CASES if "pins" not in name]


@pytest.mark.parametrize("with_sheared_poses", [False, True])
@pytest.mark.parametrize("case", OF_IMAGES)
def test_onnxruntime_computes_what_jax_does(case, with_sheared_poses):
    networks = CASES[case]().networks
    values = np.random.default_rng(2).integers(0, 2, (3, SIZE, SIZE, 1)).astype(np.float32)
    expected = jax.device_get(compile_networks(networks, with_sheared_poses)(values))
    outputs = compile_for_frames(networks, with_sheared_poses)(values)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), outputs, expected)


@pytest.mark.parametrize("kind", ["pins", "separate encoders"])
def test_other_networks_stay_with_jax(kind, monkeypatch):
    networks = CASES["images" if kind == "separate encoders" else kind]().networks
    if kind == "separate encoders":
        net = dataclasses.replace(NET, separate_encoders=True)
        networks = {"disentangled": networks["disentangled"]._replace(net=net)}
    monkeypatch.setattr(engine, "compile_networks", lambda *arguments: arguments)
    assert compile_for_frames(networks, True) == (networks, True)


def test_a_gpu_stays_with_jax(monkeypatch):
    networks = images().networks
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(engine, "compile_networks", lambda *arguments: arguments)
    assert compile_for_frames(networks, False) == (networks, False)
