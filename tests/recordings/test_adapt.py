"""Test how a run is adapted to another day by taps alone."""

import json

import made
import numpy as np
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.adapt import fit_pin_motion
from jaxunshear.angles import rotation_2d
from jaxunshear.data.recordings import read_recordings

SHIFT = (3, -2)  # px, (column, row), by which the camera has moved


@pytest.fixture(scope="module")
def monday(tmp_path_factory):
    """Taps and slides of the edge, by a camera that has moved."""
    folder = made.edge(tmp_path_factory.mktemp("monday") / "edge", 40, 30, seed=70)
    for file in folder.rglob("*.png"):
        picture = np.array(Image.open(file))
        Image.fromarray(np.roll(picture, SHIFT[::-1], (0, 1))).save(file)
    return folder


@pytest.fixture(scope="module")
def adapted(pins_run, place, monday, tmp_path_factory):
    from jaxunshear.adapt import adapt

    out = tmp_path_factory.mktemp("adapted") / "monday"
    return out, adapt(pins_run, monday / "tap", out, place / "datasets")


def measure_errors(run, monday):
    model = load_model(run)
    recordings = read_recordings(monday / "shear", model.preprocess)
    frames = list(recordings.iterate_frames(model.view))
    poses = model.pose(np.stack([frame.image for frame in frames]))["unsheared"]
    true = recordings.poses[[frame.row for frame in frames]]
    return {name: np.nanmean(np.abs(poses[name] - true[:, i])) for name, i in COLUMNS.items()}


COLUMNS = {"y_mm": 1, "z_mm": 2}


def test_the_camera_s_shift_is_found(adapted):
    _, moved = adapted
    scale = 128 / made.SIZE  # prepared images have 128 px
    np.testing.assert_allclose(moved.shift_px, np.array(SHIFT) * scale, atol=0.5)


def test_an_adapted_run_reads_what_the_run_does_not(pins_run, adapted, monday):
    before, after = measure_errors(pins_run, monday), measure_errors(adapted[0], monday)
    assert after["y_mm"] < 0.7 * before["y_mm"]


def test_an_adapted_run_keeps_its_widths_or_widens_them(pins_run, adapted):
    own, new = (json.loads((run / "results.json").read_text()) for run in (pins_run, adapted[0]))
    assert new["trained_in"] == pins_run.name
    for kind, widths in own["half_width"].items():
        assert all(new["half_width"][kind][name] >= width for name, width in widths.items())


def test_taps_that_were_learnt_are_no_test(adapted, place, monday, command):
    words = ("--recordings", monday / "tap", "--data", place / "datasets")
    answer = command("evaluate", adapted[0], *words)
    assert answer.code == 2 and "learnt from data that are tested" in answer.err


def test_too_few_taps_are_refused(pins_run, place, tmp_path, command):
    few = made.edge(tmp_path / "few", 8, 1) / "tap"
    words = ("--taps", few, "--out", tmp_path / "out", "--data", place / "datasets")
    answer = command("adapt", pins_run, *words)
    assert answer.code == 2 and "record at least 20" in answer.err
    assert not list(tmp_path.glob("out*"))


def test_simulated_runs_are_refused(monday, tmp_path, command):
    answer = command("adapt", "skin", "--taps", monday / "tap", "--out", tmp_path / "out")
    assert answer.code == 2 and "released weights" in answer.err


def test_a_fitted_motion_is_the_mean_of_each_pin():
    rest = np.random.default_rng(0).uniform(-10, 10, (19, 2))
    noise = np.random.default_rng(1).normal(0, 0.1, (30, 19, 2))
    motions = np.array([0.3, -0.1]) + noise - noise.mean(axis=0)
    motions[:, 0] += 0.5  # one pin by itself
    found = fit_pin_motion(motions, rest)
    np.testing.assert_allclose(found.motion_px, motions.mean(axis=0), atol=1e-12)


def test_pins_that_are_rarely_seen_take_the_motion_of_the_others():
    rest = np.random.default_rng(0).uniform(-10, 10, (19, 2))
    middle = rest[1:].mean(axis=0)
    turned = (rest - middle) @ rotation_2d(1e-3).T + middle - rest
    motions = np.tile(np.array([0.3, -0.1]) + turned, (30, 1, 1))
    motions[9:, 0] = np.nan
    found = fit_pin_motion(motions, rest)
    np.testing.assert_allclose(found.motion_px, motions[0], atol=1e-5)
    np.testing.assert_allclose(found.shift_px, [0.3, -0.1], atol=1e-5)
    assert found.turn_deg == pytest.approx(np.degrees(1e-3), rel=1e-3)
    assert found.left_px < 1e-5
