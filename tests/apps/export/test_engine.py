"""`stream` runs networks over images by onnxruntime, and gets what JAX computes."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxunshear.angles import wrap_degrees
from jaxunshear.apps.export import engine
from jaxunshear.apps.export.engine import compile_for_frames
from jaxunshear.inference.forward import compile_networks
from tests.apps.export.test_export import CASES, NET, SIZE, images

TOLERANCE = 1e-5
OF_IMAGES = [name for name in CASES if "pins" not in name]


@pytest.mark.parametrize("with_sheared_poses", [False, True])
@pytest.mark.parametrize("case", OF_IMAGES)
def test_onnxruntime_computes_what_jax_does(case, with_sheared_poses):
    networks = CASES[case]().networks
    values = np.random.default_rng(2).integers(0, 2, (3, SIZE, SIZE, 1)).astype(np.float32)
    expected = jax.device_get(compile_networks(networks, with_sheared_poses)(values))
    outputs = compile_for_frames(networks, with_sheared_poses)(values)
    image, poses = zip(outputs, expected, strict=True)
    assert image[1] is None or np.abs(image[0] - image[1]).max() < TOLERANCE
    assert poses[0].keys() == poses[1].keys()
    for kind, pose in poses[1].items():
        assert poses[0][kind].keys() == pose.keys()
        for name, value in pose.items():
            difference = poses[0][kind][name] - value
            if name.endswith("_deg"):  # of short vectors, as the weights are random
                difference = wrap_degrees(difference) / 360
            assert np.abs(difference).max() < TOLERANCE


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
