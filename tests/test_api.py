"""Trained models from Python: inputs are checked, results are those of the commands."""

import re
from pathlib import Path

import numpy as np
import pytest

from jaxunshear import load_model
from jaxunshear.api import ServoTask, reconstruct
from jaxunshear.api import servo as walk
from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import make_slide_targets
from jaxunshear.downstream import servo
from jaxunshear.downstream.contour import trace_contour
from jaxunshear.errors import UserError
from jaxunshear.inference import trained_model
from jaxunshear.inference.forward import UNSHEARED
from jaxunshear.inference.readers import Codes
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.simulator.stimuli import STIMULI
from tests.helpers.dots import press


@pytest.fixture(scope="module")
def model():
    return load_model("standard")


@pytest.fixture(scope="module")
def images(model):
    """Draw a few pressed and shifted lattices as a camera would show them."""
    paired = model.experiment.paired
    lattice = compute_rest_lattice(model.experiment.sensor, paired.camera, paired.preprocess)
    push = np.random.default_rng(0).normal(0, 2, (3, 1, 2))
    pressed = np.float32(press(lattice.rest) + push)
    drawn = np.asarray(draw_dots(pressed, 1.5, model.size))[..., 0]
    return np.stack([model.prepare(np.uint8(255 * frame)) for frame in drawn])


def test_images_codes_and_poses_of_released_weights(model, images):
    assert images.shape == (3, model.size, model.size) and images.dtype == np.uint8
    unsheared = model.unshear(images)
    assert unsheared.shape == images.shape and 0 <= unsheared.min() < unsheared.max() <= 1
    codes = model.codes(images)
    assert len(codes.pose) == 3 and codes.pose.ndim == 2
    assert codes.shear is None  # released weights leave it out
    pose = model.pose(images)
    np.testing.assert_array_equal(
        pose[UNSHEARED]["edge_mm"], model.predict(images).poses[UNSHEARED]["edge_mm"]
    )


def test_a_shear_code_that_was_taught_the_slide_says_it_in_mm_and_degrees(
    model, images, monkeypatch
):
    with pytest.raises(UserError, match="its shear code was not taught the slide"):
        model.slide(images)
    slides = make_slide_targets(Ranges(move_mm=2.0, twist_deg=10.0))
    z_s = np.array([[1.0, -0.5, 0.25, 7.0], [0, 0, 0, 7], [-1, 1, -1, 7]], np.float32)
    monkeypatch.setattr(trained_model, "read_slides", lambda folder: slides)
    monkeypatch.setattr(model, "codes", lambda images: Codes(np.zeros((3, 5)), z_s))
    slide = model.slide(images)
    assert list(slide) == ["slide_x_mm", "slide_y_mm", "slide_twist_deg"]
    np.testing.assert_allclose(
        np.stack(list(slide.values()), 1), z_s[:, :3] * [2, 2, 10], atol=1e-6
    )


def test_how_many_images_come_at_once_does_not_matter(model, images):
    many = np.concatenate([images] * 12)
    np.testing.assert_allclose(model.unshear(many)[33:], model.unshear(images), atol=1e-6)
    np.testing.assert_allclose(model.unshear(images > 0), model.unshear(images), atol=0)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda images: images[0], r"images of shape .*: this model takes"),
        (lambda images: images[:, ::2, ::2], r"images of shape .*: this model takes"),
        (lambda images: images[:0], "B at least 1"),
        (lambda images: images.astype(float), "images of float64: this model takes uint8"),
        (lambda images: images // 2, "uint8 of 0 and 255 alone"),
    ],
)
def test_what_is_no_image_is_refused_by_name(model, images, change, complaint):
    with pytest.raises(UserError, match=complaint):
        model.unshear(change(images))


def test_models_that_are_none_are_refused_by_name(tmp_path):
    with pytest.raises(UserError, match=r"holds no experiment\.json"):
        load_model(tmp_path)
    with pytest.raises(UserError, match="reads pins of any sensor"):
        load_model("skin").unshear(np.zeros((1, 128, 128), bool))


def read_examples():
    page = (Path(__file__).parents[1] / "docs" / "api.md").read_text()
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def test_the_example_of_a_training_learns():
    """The running statistics follow the batch, so that predictions are near the labels."""
    _, example = read_examples()
    names: dict = {}
    exec(example, names)
    assert float(names["loss"]) < 0.03
    error = np.square(names["predicted"] - names["labels"]).mean()
    assert error < 0.04 < np.var(names["labels"])


@pytest.mark.long
def test_the_example_of_uses_runs(capsys):
    """Run two steps of its trajectories."""
    example, _ = read_examples()
    names: dict = {}
    task = 'ServoTask("disk", starts=1, depth_mm=2.0'
    assert example.count(task) == 1
    outline_lengths = 2 * 0.5 / trace_contour(STIMULI["disk"]).length * 0.999
    exec(example.replace(task, f"{task}, max_outline_lengths={outline_lengths}"), names)
    poses = names["sensor_poses"]
    assert poses.shape == (2, 2, 3) and np.isfinite(poses).all()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["true", "disentangled"]
    result, model = names["result"], names["model"]
    assert result.scores[0].ends == {"took too long": 1} and result.task.stimulus == "disk"
    result.trajectories.end[0] = servo.WALKING
    with pytest.raises(UserError, match="walks around disk are not finished"):
        reconstruct(model, [(result.task, result.trajectories)])


@pytest.mark.parametrize(
    ("task", "methods", "reason"),
    [
        (ServoTask("disk", starts=0), None, "--starts 0"),
        (ServoTask("surface"), None, "no outline that closes"),
        (ServoTask("disk", depth_mm=30.0), None, "--depth 30: use more than 0"),
        (ServoTask("disk"), ("smell",), "perception 'smell' is unknown"),
    ],
)
def test_walks_that_cannot_start_are_refused_at_once(model, task, methods, reason):
    with pytest.raises(UserError, match=reason):
        walk(model, [task], methods)
