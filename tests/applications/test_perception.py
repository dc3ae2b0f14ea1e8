"""Ways of perceiving: which networks allow them, whose answer they give, and what each leaves out."""

import shutil
from dataclasses import asdict

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.applications.perception import TRUE, load_forward, perceptions, unsheared_by, ways_of
from jaxunshear.errors import UserError
from jaxunshear.model import pose_head, posenet, unshearnet
from jaxunshear.release import PARTS
from jaxunshear.settings.data import Ranges
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.networks import PoseNet, UnshearNet
from jaxunshear.settings.registry import UNSHEARING
from jaxunshear.settings.targets import of_ranges, to_json
from jaxunshear.storage import write_json
from jaxunshear.training import checkpoint
from jaxunshear.training.loop import run_once

NET = UnshearNet(size=32, widths=(8, 8), pose_channels=8, shear_channels=4)
POSENET = PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)
# PoseNet knows more poses than the pairs show
OF_PAIRS, OF_TAPS = (of_ranges((), Ranges(lateral_mm=mm)) for mm in (3, 6))


def kept(folder, kind, net, variables, targets):
    larger = variables | {"params": jax.tree.map(lambda x: 10 * x, variables["params"])}
    checkpoint.write_settings(folder, {"kind": kind, "net": asdict(net), "targets": to_json(targets)})
    checkpoint.save(folder, 1, {"average": larger}, {"best_step": 1, "history": []})
    write_json(folder / "summary.json", {"steps": 1})


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    variables = jax.jit(unshearnet.init, static_argnums=0, compiler_options=run_once())(NET, jax.random.key(0))
    variables["params"]["head"] = pose_head.init(unshearnet.code_shape(NET), 5, jax.random.key(2))
    kept(folder / "disentangled", "unshear", NET, variables, OF_PAIRS)
    init = jax.jit(posenet.init, static_argnums=(0, 1), compiler_options=run_once())
    kept(folder / "posenet", "posenet", POSENET, init(POSENET, 5, jax.random.key(0)), OF_TAPS)
    return folder


@pytest.fixture(scope="module")
def images():
    return (np.random.default_rng(0).random((3, 32, 32)) < 0.3).astype(np.uint8) * 255


def viewed(model, way, images):
    forward, variables, _ = load_forward(model, way)
    return jax.jit(forward)(variables, images)


def test_the_code_is_read_by_its_head_and_both_is_the_mean(model, images):
    (seen, code), (drawn, image), (_, both) = (viewed(model, way, images) for way in ("code", "disentangled", "both"))
    variables = checkpoint.load_best(model / "disentangled")
    z_p, _ = jax.jit(unshearnet.encode, static_argnums=0)(NET, variables, images[..., None] / np.float32(255))
    outputs = jax.jit(pose_head.predict)(variables["params"]["head"], z_p)
    expected = posenet.pose_from_outputs(outputs, OF_PAIRS)
    for name, answer in code.items():
        np.testing.assert_allclose(answer, expected[name], rtol=1e-4, atol=1e-4)
        assert np.abs(answer - image[name]).max() > 1e-3
    np.testing.assert_allclose(seen, drawn, atol=1e-6)
    mean = posenet.mean_pose(code, image, OF_PAIRS)
    for name, answer in both.items():
        np.testing.assert_allclose(answer, mean[name], rtol=1e-4, atol=1e-3)


def test_released_weights_perceive_by_their_head(model, images, tmp_path):
    for name in ("disentangled", "posenet"):
        checkpoint.write_weights(tmp_path / name, checkpoint.load_best(model / name), PARTS[name])
        shutil.copy(model / name / "model.json", tmp_path / name)
    assert ways_of(tmp_path) == ways_of(model)
    of_run = viewed(model, "code", images)[1]
    for name, answer in viewed(tmp_path, "code", images)[1].items():
        np.testing.assert_allclose(answer, of_run[name], atol=0.1)  # kernels are float16


def test_a_robot_gets_the_heads_edge(model, images):
    edge_mm, edge_deg = perceptions(model, Experiment("small", "none"), ("code",))["code"](images)
    _, pose = viewed(model, "code", images)
    np.testing.assert_allclose(edge_mm, pose["edge_mm"], atol=1e-4)
    np.testing.assert_allclose(edge_deg, pose["edge_deg"], atol=1e-3)


def test_the_code_alone_draws_nothing_and_both_encode_once(model, images):
    def products(way):
        forward, variables, _ = load_forward(model, way)
        compiled = jax.jit(lambda known, images: forward(known, images)[1]).lower(variables, images).compile()
        return compiled.cost_analysis()["flops"]

    code, image, both = map(products, ("code", "disentangled", "both"))
    variables = checkpoint.load_best(model / "disentangled")
    encode = jax.jit(lambda known, images: unshearnet.encode(NET, known, images)[0])
    encoding = encode.lower(variables, jnp.zeros((3, 32, 32, 1))).compile().cost_analysis()["flops"]
    assert code < image < both < image + code - 0.9 * encoding


def test_images_are_unsheared_whatever_gives_the_pose():
    assert {unsheared_by(way) for way in (TRUE, "code", "both", "disentangled")} == {"disentangled"}
    assert (unsheared_by("entangled"), unsheared_by("unet")) == ("entangled", "unet")
    assert not {unsheared_by("sheared"), unsheared_by("learnt")} & set(UNSHEARING)


def test_ways_that_ask_for_a_head_are_there_where_one_is(model, tmp_path):
    assert ways_of(model) == ("sheared", "disentangled", "code", "both")
    shutil.copytree(model / "disentangled", tmp_path / "disentangled")
    assert ways_of(tmp_path) == ("code",)
    variables = checkpoint.load_best(model / "disentangled")
    del variables["params"]["head"]
    shutil.rmtree(tmp_path / "disentangled")
    kept(tmp_path / "disentangled", "unshear", NET, variables, OF_PAIRS)
    shutil.copytree(model / "posenet", tmp_path / "posenet")
    assert ways_of(tmp_path) == ("sheared", "disentangled")
    with pytest.raises(
        UserError, match="disentangled has no head that reads the pose code, which networks over images get by"
    ):
        load_forward(tmp_path, "both")


def test_a_head_that_gives_no_targets_and_an_edge_that_is_none_are_refused(model, tmp_path):
    variables = checkpoint.load_best(model / "disentangled")
    kept(tmp_path / "older" / "disentangled", "unshear", NET, variables, ())
    with pytest.raises(UserError, match="disentangled does not state what its head reads"):
        load_forward(tmp_path / "older", "code")
    kept(tmp_path / "other" / "disentangled", "unshear", NET, variables, of_ranges(("x_mm", "yaw_deg"), Ranges()))
    with pytest.raises(UserError, match="other reads x_mm, yaw_deg: an edge is followed by edge_mm and edge_deg"):
        perceptions(tmp_path / "other", Experiment("small", "none"), ("code",))
