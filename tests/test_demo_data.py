"""A simulated recording that is written as a laboratory's lies."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxunshear import demo_data
from jaxunshear.calibration.labels import make_paths as make_labelled_paths
from jaxunshear.calibration.labels import read_motions
from jaxunshear.config.sensor import TACTIP_331_FITTED, Preprocess
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.demo_data import SENSORS, convert_labels, sample_labels, write_demo_data
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import make_scenes


@pytest.fixture
def quick(monkeypatch):
    """Few contacts, whose pins move with the slide; none is solved, and one fails."""
    few = {"MIN_CONTACTS": 6, "UNTOUCHED": 2, "CAMERA_FRAMES": 3, "CAMERA_PX": 96}
    for name, value in few.items():
        monkeypatch.setattr(demo_data, name, value)

    def simulate(sensor, stimuli, scenes, progress):
        pins = np.repeat(compute_pin_tips(sensor)[None], len(scenes), axis=0)
        pins[..., :2] += 0.1 * scenes.move[:, None, :2]
        progress.advance(len(scenes))
        return SimpleNamespace(pins=pins, converged=np.arange(len(scenes)) != 4)

    monkeypatch.setattr(demo_data, "simulate", simulate)
    monkeypatch.setattr(demo_data, "count_dome_steps", lambda sensor: 10)
    monkeypatch.setattr(demo_data, "load_dome", lambda sensor, stage: stage.advance(10))


def test_the_same_seed_gives_a_recording_of_the_same_bits(quick, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        (tmp_path / name).mkdir()
        write_demo_data(tmp_path / name, 6, seed)
    files = [
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*.*")}
        for root in (tmp_path / "a", tmp_path / "b", tmp_path / "c")
    ]
    assert len(files[0]) == 3 * (5 + 1 + 6 + 1 + 3 + 1 + 2)  # one tap is left out
    assert files[0] == files[1] and files[0].keys() == files[2].keys()
    assert not {a for a in files[0] if files[0][a] == files[2][a]}


def test_it_is_read_with_its_labels(quick, tmp_path):
    write_demo_data(tmp_path / "demo", 6)
    for pins in ("331_pins", "127_pins", "165_markers"):
        parts = {}
        for kind in ("edge/tap", "edge/shear", "camera", "untouched"):
            parts[kind] = read_recordings(tmp_path / "demo" / pins / kind, Preprocess(size=128))
            assert not parts[kind].notes
        taps, slides = parts["edge/tap"], parts["edge/shear"]
        assert len(taps) == 5 and len(slides) == 6
        assert np.ptp(slides.poses, axis=0).astype(bool).tolist() == [0, 1, 1, 0, 0, 1]
        assert not taps.moves.any() and slides.moves[:, [0, 1, 5]].all()
        np.testing.assert_array_equal(np.delete(slides.poses, 4, axis=0), taps.poses)
        assert read_image(parts["camera"].files[0]).shape == (96, 96)
        assert parts["untouched"].poses is None


def test_labels_mean_what_calibration_takes_them_for():
    labels = sample_labels(SENSORS[0], 50, 3)
    pose, move = convert_labels(labels)
    simulated = make_paths(make_scenes(("edge",), np.zeros(100, int), pose, move)).points
    motions = read_motions(labels.pose, labels.move)
    labelled = make_labelled_paths(motions, TACTIP_331_FITTED, 0.0, side=1, friction=0.4).points
    turns = (labelled[..., 2] - simulated[..., 2]) / 360
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    columns = [0, 1, 3]
    np.testing.assert_allclose(labelled[..., columns], simulated[..., columns], atol=1e-9)


def test_what_cannot_be_is_refused_and_leaves_nothing(quick, tmp_path, command, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    for words, line in (
        ((tmp_path / "full",), "is not empty: name a new folder"),
        ((tmp_path / "full" / "mine.txt",), "is a file: name a folder"),
        ((tmp_path / "new", "--contacts", "3"), "--contacts 3: use 6 or more"),
        ((tmp_path / "new", "--seed", "-1"), "--seed -1: use 0 to"),
    ):
        answer = command("demo-data", *words)
        assert answer.code == 2 and line in answer.err and answer.err.count("\n") == 1
    monkeypatch.setattr(demo_data, "_convert_to_bytes", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_demo_data(tmp_path / "new", 6)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_the_next_commands_are_named(quick, tmp_path, command):
    answer = command("demo-data", tmp_path / "demo", "--contacts", "6")
    assert answer.code == 0
    assert f"jaxunshear doctor {tmp_path / 'demo'}/331_pins/edge" in answer.out


def test_one_line_of_progress_counts_domes_and_contacts(quick, tmp_path, capsys):
    write_demo_data(tmp_path / "demo", 6)
    (line,) = capsys.readouterr().err.splitlines()
    steps = 3 * (2 * 6 * (1 + demo_data.RENDER_STEPS) + 10 * demo_data.HARMONIC_STEPS)
    assert line.startswith(f"simulate: {steps:g}/{steps:g} steps, ")
