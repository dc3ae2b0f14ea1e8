"""Methods of perception: which networks allow them, and whose output they give."""

import shutil

import jax
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import UNSHEARING, PoseNet, UnshearNet
from jaxunshear.config.targets import make_range_targets
from jaxunshear.errors import UserError
from jaxunshear.inference.edge_methods import (
    TRUE_POSE,
    find_unshearing_network,
    list_methods,
    make_edge_estimators,
)
from jaxunshear.inference.forward import compute_confidence
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.models import posenet, unshearnet
from jaxunshear.release import RELEASED_PARTS
from jaxunshear.training import checkpoint
from tests.helpers.models import change_weights, init, write_network

NET = UnshearNet(size=32, widths=(8, 8), pose_channels=8, shear_channels=4)
POSENET = PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)
TARGETS = make_range_targets((), Ranges(lateral_mm=6))


def model_in(folder):
    return TrainedModel(folder, Experiment("small", "none"))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    for name, net, targets in (("disentangled", NET, ()), ("posenet", POSENET, TARGETS)):
        variables = change_weights(init(net, 0, targets), lambda x: 10 * x)
        write_network(folder / name, net, variables, targets)
    return model_in(folder)


@pytest.fixture(scope="module")
def images():
    return (np.random.default_rng(0).random((3, 32, 32)) < 0.3).astype(np.uint8) * 255


@pytest.mark.parametrize("method", ["sheared", "disentangled"])
def test_a_robot_gets_what_posenet_reads_of_the_image_as_it_is_or_unsheared(model, images, method):
    image = images[..., None] / np.float32(255)
    if method == "disentangled":
        unshear = jax.jit(unshearnet.unshear, static_argnums=0)
        image = unshear(NET, model.load_network(method).variables, image)
    predict = jax.jit(posenet.predict, static_argnums=0)
    outputs = predict(POSENET, model.load_network("posenet").variables, image)
    expected = posenet.unscale_outputs(outputs, TARGETS)
    edge_mm, edge_deg = make_edge_estimators(model, (method,))[method](images)
    np.testing.assert_allclose(edge_mm, expected["edge_mm"], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(edge_deg, expected["edge_deg"], rtol=1e-4, atol=1e-3)


def test_released_weights_perceive_as_the_run_does(model, images, tmp_path):
    for name in ("disentangled", "posenet"):
        variables = model.load_network(name).variables
        checkpoint.write_weights(tmp_path / name, variables, RELEASED_PARTS[name])
        shutil.copy(model.folder / name / "model.json", tmp_path / name)
    released = model_in(tmp_path)
    assert list_methods(released) == list_methods(model) == ("sheared", "disentangled")
    own, theirs = (
        make_edge_estimators(each, ("disentangled",))["disentangled"](images)
        for each in (model, released)
    )
    np.testing.assert_allclose(theirs, own, atol=0.1)  # kernels are float16


def test_images_are_unsheared_whatever_gives_the_pose():
    assert find_unshearing_network(TRUE_POSE) == "disentangled"
    for network in ("disentangled", "entangled", "unet"):
        assert find_unshearing_network(network) == network
    for method in ("sheared", "learnt"):
        assert find_unshearing_network(method) not in UNSHEARING


def test_methods_are_those_whose_networks_are_there(model, tmp_path):
    shutil.copytree(model.folder / "disentangled", tmp_path / "disentangled")
    assert list_methods(model_in(tmp_path)) == ()
    shutil.copytree(model.folder / "posenet", tmp_path / "posenet_sheared")
    assert list_methods(model_in(tmp_path)) == ("learnt",)


def test_an_edge_that_is_none_is_refused(tmp_path):
    targets = make_range_targets(("x_mm", "yaw_deg"), Ranges())
    write_network(tmp_path / "posenet", POSENET, init(POSENET, 0, targets), targets)
    with pytest.raises(UserError, match="reads x_mm, yaw_deg: an edge is followed by edge_mm"):
        make_edge_estimators(model_in(tmp_path), ("sheared",))


def test_confidence_of_crisp_grey_and_black(images):
    assert compute_confidence(np.float32(images[0] / 255)[..., None]) == pytest.approx(1)
    assert compute_confidence(np.full((8, 8, 1), 0.5, np.float32)) == pytest.approx(0.5)
    assert compute_confidence(np.zeros((8, 8, 1), np.float32)) == 0
