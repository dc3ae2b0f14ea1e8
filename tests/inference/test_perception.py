"""Methods of perception: which networks allow them, and whose output they give."""

import shutil
from dataclasses import asdict

import jax
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.registry import UNSHEARING
from jaxunshear.config.targets import make_range_targets, to_json
from jaxunshear.errors import UserError
from jaxunshear.files import write_json
from jaxunshear.inference.perception import (
    TRUE_POSE,
    compute_confidence,
    find_unshearing_network,
    list_methods,
    load_forward,
    make_edge_estimators,
)
from jaxunshear.models import posenet, unshearnet
from jaxunshear.release import RELEASED_PARTS
from jaxunshear.training import checkpoint
from jaxunshear.training.trainer import get_compile_options

NET = UnshearNet(size=32, widths=(8, 8), pose_channels=8, shear_channels=4)
POSENET = PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)
TARGETS = make_range_targets((), Ranges(lateral_mm=6))


def write_network(folder, kind, net, variables, targets):
    larger = variables | {"params": jax.tree.map(lambda x: 10 * x, variables["params"])}
    checkpoint.write_settings(
        folder, {"kind": kind, "net": asdict(net), "targets": to_json(targets)}
    )
    checkpoint.save(folder, 1, {"average": larger}, {"best_step": 1, "history": []})
    write_json(folder / "summary.json", {"steps": 1})


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    make = jax.jit(unshearnet.init, static_argnums=0, compiler_options=get_compile_options())
    write_network(folder / "disentangled", "unshear", NET, make(NET, jax.random.key(0)), ())
    init = jax.jit(posenet.init, static_argnums=(0, 1), compiler_options=get_compile_options())
    write_network(
        folder / "posenet", "posenet", POSENET, init(POSENET, 5, jax.random.key(0)), TARGETS
    )
    return folder


@pytest.fixture(scope="module")
def images():
    return (np.random.default_rng(0).random((3, 32, 32)) < 0.3).astype(np.uint8) * 255


def run_method(model, method, images):
    forward, variables, _ = load_forward(model, method)
    return jax.jit(forward)(variables, images)


@pytest.mark.parametrize("method", ["sheared", "disentangled"])
def test_posenet_reads_the_image_as_it_is_or_unsheared(model, images, method):
    unsheared, pose = run_method(model, method, images)
    image = images[..., None] / np.float32(255)
    if method == "disentangled":
        unshear = jax.jit(unshearnet.unshear, static_argnums=0)
        image = unshear(NET, checkpoint.load_best(model / method), image)
    np.testing.assert_allclose(unsheared, image, atol=1e-6)
    predict = jax.jit(posenet.predict, static_argnums=0)
    outputs = predict(POSENET, checkpoint.load_best(model / "posenet"), image)
    expected = posenet.unscale_outputs(outputs, TARGETS)
    assert pose.keys() == expected.keys()
    for name, answer in pose.items():
        np.testing.assert_allclose(answer, expected[name], rtol=1e-4, atol=1e-3)


def test_released_weights_perceive_as_the_run_does(model, images, tmp_path):
    for name in ("disentangled", "posenet"):
        checkpoint.write_weights(
            tmp_path / name, checkpoint.load_best(model / name), RELEASED_PARTS[name]
        )
        shutil.copy(model / name / "model.json", tmp_path / name)
    assert list_methods(tmp_path) == list_methods(model) == ("sheared", "disentangled")
    run_pose = run_method(model, "disentangled", images)[1]
    for name, answer in run_method(tmp_path, "disentangled", images)[1].items():
        np.testing.assert_allclose(answer, run_pose[name], atol=0.1)  # kernels are float16


def test_a_robot_gets_the_edge(model, images):
    estimators = make_edge_estimators(model, Experiment("small", "none"), ("disentangled",))
    edge_mm, edge_deg = estimators["disentangled"](images)
    _, pose = run_method(model, "disentangled", images)
    np.testing.assert_allclose(edge_mm, pose["edge_mm"], atol=1e-4)
    np.testing.assert_allclose(edge_deg, pose["edge_deg"], atol=1e-3)


def test_images_are_unsheared_whatever_gives_the_pose():
    assert find_unshearing_network(TRUE_POSE) == "disentangled"
    for network in ("disentangled", "entangled", "unet"):
        assert find_unshearing_network(network) == network
    for method in ("sheared", "learnt"):
        assert find_unshearing_network(method) not in UNSHEARING


def test_ways_are_those_whose_networks_are_there(model, tmp_path):
    shutil.copytree(model / "disentangled", tmp_path / "disentangled")
    assert list_methods(tmp_path) == ()
    shutil.copytree(model / "posenet", tmp_path / "posenet_sheared")
    assert list_methods(tmp_path) == ("learnt",)


def test_an_edge_that_is_none_is_refused(model, tmp_path):
    variables = checkpoint.load_best(model / "posenet")
    targets = make_range_targets(("x_mm", "yaw_deg"), Ranges())
    write_network(tmp_path / "other" / "posenet", "posenet", POSENET, variables, targets)
    with pytest.raises(
        UserError, match="other reads x_mm, yaw_deg: an edge is followed by edge_mm and edge_deg"
    ):
        make_edge_estimators(tmp_path / "other", Experiment("small", "none"), ("sheared",))


def test_confidence_of_crisp_grey_and_black(images):
    assert compute_confidence(np.float32(images[0] / 255)[..., None]) == pytest.approx(1)
    assert compute_confidence(np.full((8, 8, 1), 0.5, np.float32)) == pytest.approx(0.5)
    assert compute_confidence(np.zeros((8, 8, 1), np.float32)) == 0
