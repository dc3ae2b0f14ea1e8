"""Pin networks in use: pins are tracked in the image; results are NaN if they are not."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PinPoseNet, PinUnshear, UnshearNet
from jaxunshear.config.targets import make_range_targets
from jaxunshear.downstream import servo
from jaxunshear.downstream.contour import trace_contour
from jaxunshear.downstream.servo_scores import score_trajectories
from jaxunshear.inference.edge_methods import list_methods, load_unshearers, make_edge_estimators
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.models import pin_networks, posenet
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.pin_tracking import measure_motions, track_images
from jaxunshear.simulator.stimuli import STIMULI
from tests.helpers.models import change_weights, init, write_run

EXPERIMENT = Experiment("small", "none", unshear=UnshearNet(input="pins"))
PAIRED = EXPERIMENT.paired
LATTICE = compute_rest_lattice(EXPERIMENT.sensor, PAIRED.camera, PAIRED.preprocess)
TARGETS = make_range_targets((), PAIRED.ranges)
NETS = {"disentangled": PinUnshear(hidden=16, layers=1), "posenet": PinPoseNet(hidden=16, layers=1)}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Write random networks, whose outputs depend on the pins alone."""
    variables = {}
    for seed, (name, net) in enumerate(NETS.items()):
        draw = np.random.default_rng(seed).normal
        fresh = init(net, seed, TARGETS if name == "posenet" else (), LATTICE.rest, 2.0)
        variables[name] = change_weights(
            fresh, lambda x, draw=draw: x + draw(0, 0.05, x.shape).astype(x.dtype)
        )
    folder = tmp_path_factory.mktemp("pins")
    write_run(folder, EXPERIMENT, NETS, variables, TARGETS)
    return TrainedModel(folder, EXPERIMENT)


@pytest.fixture(scope="module")
def images_and_pins():
    """Draw an image of pins shifted by 2 px, one of them hidden, and a black one; also the pins."""
    pins = LATTICE.rest + np.array([2.0, 0.0])
    pins[np.argmax(LATTICE.rest[:, 0])] = np.nan
    given = jnp.asarray(pins[None], jnp.float32)
    drawn = np.asarray(draw_dots(given, 1.6, PAIRED.preprocess.size))[..., 0]
    return np.concatenate([drawn, 0 * drawn]).astype(np.uint8) * 255, pins


def test_pins_are_followed_and_what_is_not_is_nan(images_and_pins):
    images, pins = images_and_pins
    hidden = np.isnan(pins)
    for alone in (False, True):
        tracked = track_images(LATTICE, images, alone)
        assert tracked.identified.tolist() == [True, False]
        np.testing.assert_array_equal(np.isnan(tracked.motion[0]), hidden)
        assert np.isnan(tracked.motion[1]).all()
        distance = np.linalg.norm(LATTICE.rest + tracked.motion[0] - pins, axis=-1)
        assert np.nanmax(distance) < 0.5
    motion = measure_motions(LATTICE, images)
    np.testing.assert_array_equal(motion[0][~hidden], tracked.motion[0][~hidden])
    np.testing.assert_allclose(motion[0][hidden[:, 0]], [[2.0, 0]], atol=0.3)
    assert np.isnan(motion[1]).all()


def run_network(model, name, pins):
    net, variables, _ = model.load_network(name)
    run = pin_networks.predict if name == "posenet" else pin_networks.unshear
    return np.asarray(jax.jit(partial(run, net))(variables, jnp.asarray(pins, jnp.float32)))


def test_a_robot_gets_what_the_networks_read_of_its_pins(model, images_and_pins):
    images, _ = images_and_pins
    assert list_methods(model) == ("sheared", "disentangled")
    pins = LATTICE.rest + track_images(LATTICE, images[:1]).motion
    after = run_network(model, "disentangled", pins)
    for way, given in (("sheared", pins), ("disentangled", after)):
        edge_mm, edge_deg = make_edge_estimators(model, (way,))[way](images)
        expected = posenet.unscale_outputs(run_network(model, "posenet", given), TARGETS)
        assert edge_mm[0] == pytest.approx(float(expected["edge_mm"][0]), abs=1e-4)
        assert edge_deg[0] == pytest.approx(float(expected["edge_deg"][0]), abs=1e-3)
        assert np.isnan([edge_mm[1], edge_deg[1]]).all()
    motion = load_unshearers(model)["disentangled"](images)
    # not drawn and found again
    np.testing.assert_allclose(motion[0], after[0] - LATTICE.rest, atol=1e-4)
    assert np.isnan(motion[1]).all()


def test_a_walk_goes_straight_on_while_no_pins_are_followed(tmp_path):
    blind = {"disentangled": lambda images: (np.full(len(images), np.nan),) * 2}
    steps = 4 * 0.5 / trace_contour(STIMULI["disk"]).length
    task = servo.ServoTask("disk", starts=1, depth_mm=2.0, max_outline_lengths=steps)
    trajectories, contour = servo.follow_contour(
        task, EXPERIMENT.sensor, PAIRED, blind, tmp_path / "disk.npz"
    )
    steps = np.diff(trajectories.point[0], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps[:, :2], axis=-1), task.gains.step_mm, rtol=1e-5)
    np.testing.assert_allclose(steps[:, 2], 0, atol=1e-6)
    row = score_trajectories(trajectories, contour, "disk")[0]
    assert row.steps == row.unfollowed == int(trajectories.steps) and row.seen_mean_mm is None


@pytest.mark.long
def test_servo_then_reconstruct_by_pins(command, brief, model, tmp_path):
    words = ("--out", tmp_path / "walks", "--stimulus", "disk")
    more = ("--model", model.folder, "--starts", 1, "--ways", "sheared,disentangled")
    for name, options, failures in (
        ("servo", more, "unfollowed"),
        ("reconstruct", (model.folder,), "unmatched"),
    ):
        answer = command(name, *words, *options)
        assert answer.code == 0, answer.err
        rows = json.loads((tmp_path / "walks" / f"{name}.json").read_text())["rows"]
        found = {(row["way"], row[failures]) for row in rows}
        assert found == {("sheared", 0), ("disentangled", 0)}
