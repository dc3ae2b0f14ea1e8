"""Test networks of simulation on recordings.

Their answers are brought into the labels' frame by taps alone, then scored.
"""

import csv
import dataclasses
import json

import made
import numpy as np
import pytest

from jaxunshear import load_model
from jaxunshear.config import targets
from jaxunshear.config.data import PairedData, Ranges, Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Preprocess
from jaxunshear.data.recorded_contacts import read_test_contacts
from jaxunshear.errors import UserError
from jaxunshear.evaluation import sim_to_real
from jaxunshear.evaluation.recorded_results import format_table
from jaxunshear.evaluation.sim_to_real import (
    UNSHEARED_RAW_OFFSET,
    align_to_labels,
    choose_scored_labels,
    score_transfer,
)
from jaxunshear.files import to_builtins
from jaxunshear.inference.forward import AS_RECORDED, UNSHEARED
from jaxunshear.inference.readers import Predictions, make_frame_transforms
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.touch import Touch
from jaxunshear.simulator.pin_layout import compute_pin_lattice
from tests.helpers.commands import succeed
from tests.helpers.models import write_pin_weights

RNG = np.random.default_rng(0)


def poses(count):
    found = np.zeros((count, 6))
    found[:, 1], found[:, 2] = RNG.uniform(-3, 3, count), RNG.uniform(3, 5, count)
    found[:, 5] = RNG.uniform(-180, 180, count)
    return found


@pytest.mark.parametrize("sign", [1, -1])
def test_sign_and_offset_are_found_in_taps(sign):
    labels = poses(200)
    noise = RNG.normal(0, 0.05, (3, 200))
    readings = {
        "edge_mm": sign * (labels[:, 1] - 1.4) + noise[0],
        "depth_mm": labels[:, 2] - 2 + noise[1],
        "edge_deg": (sign * (labels[:, 5] - 170) + 20 * noise[2] + 180) % 360 - 180,
    }
    readings["edge_mm"][3] = np.nan  # a tap that could not be read
    assert choose_scored_labels(readings, labels) == ("y_mm", "z_mm", "Rz_deg")
    found = {name: align_to_labels(name, readings, labels) for name in ("y_mm", "z_mm", "Rz_deg")}
    assert (found["y_mm"].sign, found["Rz_deg"].sign, found["z_mm"].sign) == (sign, sign, 1)
    for name, offset, within in (("y_mm", 1.4, 0.03), ("z_mm", 2, 0.03), ("Rz_deg", 170, 0.5)):
        assert found[name].offset == pytest.approx(offset, abs=within)


def test_labels_of_no_edge_and_images_of_no_sensor_are_refused():
    labels = poses(50)
    labels[:, 0] = RNG.uniform(-3, 3, 50)
    with pytest.raises(UserError, match="not of a straight edge"):
        choose_scored_labels({"edge_mm": labels[:, 1]}, labels)
    with pytest.raises(UserError, match="not of a straight edge"):
        choose_scored_labels({"edge_mm": labels[:, 1]}, np.zeros((50, 6)))
    with pytest.raises(UserError, match="no tap could be read"):
        align_to_labels("y_mm", {"edge_mm": np.full(50, np.nan)}, labels)


@pytest.mark.parametrize("degrees", [-12.0, 0.0, 20.0])
def test_a_turned_and_smaller_lattice_moves_as_the_known_one(degrees):
    known = 64 + 6 * compute_pin_lattice(TACTIP_127) / TACTIP_127.pin_spacing_mm
    angle = np.radians(degrees)
    # rows turn by +degrees
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    here = 50 + 0.8 * (known - 64) @ turn
    motion = RNG.normal(size=(2, *known.shape))
    there, back, by = make_frame_transforms(here, known)
    np.testing.assert_allclose(there(here + 0.8 * motion @ turn), known + motion, atol=1e-9)
    np.testing.assert_allclose(back(known + motion), here + 0.8 * motion @ turn, atol=1e-9)
    # an edge that a network sees at 0 lies at `degrees` in the image
    assert by == pytest.approx(degrees, abs=1e-9)


def test_errors_recovery_and_counts_are_those_of_what_was_read(tmp_path):
    """Score a stand-in for a network.

    It returns the true pose of taps, a worse one of slides, and half of that error once unsheared,
    which moves all edges.
    """
    folder = made.edge(tmp_path / "edge", 60, 40)
    preprocess = Preprocess(size=made.SIZE)
    contacts = read_test_contacts(Recorded(str(folder), str(folder), preprocess=preprocess))

    def batches(size):
        """Yield the poses (B, 6) of taps, then of slides, and the error of their poses.

        A last batch is filled up with its last pose.
        """
        for slid in (False, True):
            here = contacts.pose[contacts.is_slide == slid]
            for start in range(0, len(here), size):
                yield here[np.minimum(np.arange(start, start + size), len(here) - 1)], float(slid)

    asked = batches(sim_to_real.BATCH)

    def predict(images):
        assert len(images) == sim_to_real.BATCH
        pose, off = next(asked)

        def read(error, moved=0.0):
            angle = -(pose[:, 5] + 10 * error) + 40
            return {
                "edge_mm": -(pose[:, 1] + error + moved),
                "depth_mm": pose[:, 2] + 7,
                "edge_deg": 180 - (180 - angle) % 360,
            }

        def pins(error):
            turn = np.radians(pose[:, 5])
            shown = np.stack([pose[:, 1] + error, pose[:, 2], np.cos(turn), np.sin(turn)], -1)
            return np.repeat(shown[:, :, None], 2, axis=2)

        poses = {AS_RECORDED: read(off), UNSHEARED: read(off / 2, moved=0.3)}
        both = {AS_RECORDED: pins(off), UNSHEARED: pins(off / 2)}
        touch = Touch(*np.full((len(Touch._fields), len(pose)), 0.5))
        return Predictions(
            None, poses, both, np.full(len(pose), ""), np.ones(len(pose)), lambda: touch
        )

    experiment = Experiment("small", "none", paired=PairedData(preprocess=preprocess))
    network = TrainedModel(tmp_path / "weights", experiment)
    network.predict = predict
    results = score_transfer(experiment, network.folder, folder, "a command", network)
    assert next(asked, None) is None
    mae = results.pose_mae
    assert mae["tap"] == pytest.approx({"y_mm": 0, "z_mm": 0, "Rz_deg": 0}, abs=1e-3)
    assert mae["sheared"] == pytest.approx({"y_mm": 1, "z_mm": 0, "Rz_deg": 10}, abs=1e-3)
    assert mae["unsheared"] == pytest.approx({"y_mm": 0.5, "z_mm": 0, "Rz_deg": 5}, abs=1e-3)
    assert mae[UNSHEARED_RAW_OFFSET] == pytest.approx(
        {"y_mm": 0.8, "z_mm": 0, "Rz_deg": 5}, abs=1e-3
    )
    assert results.pose_recovery["unsheared"]["y_mm"] == pytest.approx(0.5)
    reader = results.readers["pins"]
    errors = [reader[way]["y_mm"] for way in ("tap", "sheared", "unsheared")]
    assert errors == pytest.approx([0, 1, 0.5], abs=0.05)
    assert max(reader["unsheared"][name] for name in ("z_mm", "Rz_deg")) < 0.5
    assert "ridge on pins" in format_table(results)
    counts = results.counts
    assert counts.known_taps + counts.test_taps == 60
    assert (counts.test_poses, counts.test_unsure) == (40, 0)
    json.dumps(to_builtins(results))


def test_too_few_taps_are_refused_by_name(tmp_path):
    folder = made.edge(tmp_path / "edge", 10, 40)
    with pytest.raises(UserError, match="10 labelled taps"):
        score_transfer(Experiment("small", "none"), tmp_path, folder, "a command")


TARGETS = targets.make_range_targets(("edge_mm", "edge_deg:circle", "depth_mm"), Ranges())


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    return write_pin_weights(folder, TARGETS, made.rest_px(), made.SIZE)


def test_images_are_judged_by_the_camera_s_own_frame(weights, tmp_path):
    """The zoom of the simulated camera does not matter."""
    folder = made.write(tmp_path / "edge", *made.contacts(24, True, 0))
    model, other = load_model(weights, like=folder), load_model(weights, like=folder)
    paired = other.experiment.paired
    camera = dataclasses.replace(paired.camera, mm_across=2 * paired.camera.mm_across)
    paired = dataclasses.replace(paired, camera=camera)
    other.experiment = dataclasses.replace(other.experiment, paired=paired)
    assert other.lattice.rest.std() < 0.6 * model.lattice.rest.std()
    assert other.appearance == model.appearance


def test_images_one_by_one_are_read_as_in_their_folder(command, weights, tmp_path):
    folder = made.write(tmp_path / "edge", *made.contacts(30, True, 0))
    full = succeed(command, "unshear", folder, "--model", weights, "--out", tmp_path / "full")
    assert "30 images unsheared, 0 left out" in full.out and "simulated contacts alone" in full.out
    rows = (tmp_path / "full" / "poses.csv").read_text().splitlines()
    one = folder / "images" / "image_7.png"
    alone = command("unshear", one, "--model", weights, "--out", tmp_path / "alone")
    assert alone.code == 2 and "--like" in alone.err and alone.err.count("\n") == 1
    assert not (tmp_path / "alone").exists()
    alone = succeed(
        command, "unshear", one, "--model", weights, "--out", tmp_path / "alone", "--like", folder
    )
    read = next(row for row in rows if row.startswith("images/image_7.png")).split(",")[2:5]
    assert (tmp_path / "alone" / "poses.csv").read_text().splitlines()[1].split(",")[2:5] == read
    nothing = command("pose", one, "--model", weights, "--like", tmp_path / "nowhere")
    assert nothing.code == 2 and "nowhere" in nothing.err


def test_a_stream_reads_what_unshear_reads(command, weights, tmp_path):
    folder = made.write(tmp_path / "edge", *made.contacts(30, True, 0))
    assert command("unshear", folder, "--model", weights, "--out", tmp_path / "out").code == 0
    succeed(command, "stream", folder, "--model", weights, "--lines", tmp_path / "lines")
    lines = [json.loads(line) for line in (tmp_path / "lines").read_text().splitlines()]
    head, *rows = (
        line.split(",") for line in (tmp_path / "out" / "poses.csv").read_text().splitlines()
    )
    for line, row in zip(lines, rows, strict=True):
        assert line["pose"]["edge_mm"] == pytest.approx(float(row[head.index("edge_mm")]), abs=1e-3)


def test_simulated_weights_give_no_pose_without_identities(command, weights, tmp_path):
    """Three of 30 frames are left out and the rest is a success; all of them are none."""
    like = made.write(tmp_path / "edge", *made.contacts(30, True, 0))
    words = ("--model", weights, "--like", like)
    for count, code in ((3, 0), (30, 1)):
        folder = made.write(tmp_path / f"hidden{count}", *made.contacts(30, True, 0))
        made.hide_pins(folder, list(range(1, count + 1)))
        answer = command("unshear", folder, *words, "--out", tmp_path / f"out{count}")
        assert answer.code == code, answer.err
        assert f"{30 - count} images unsheared, {count} left out" in answer.out
        assert len(list((tmp_path / f"out{count}").rglob("*.png"))) == 30 - count
        answer = command("pose", folder, *words)
        assert answer.code == code and f"{count} left out" in answer.err
        rows = list(csv.DictReader(answer.out.splitlines()))
        left_out = [True] * count + [False] * (30 - count)
        assert [row["unsheared_edge_mm"] == "" for row in rows] == left_out
        answer = command("stream", folder, *words)
        assert answer.code == code and f"{30 - count} frames used, {count} skipped" in answer.err
        lines = map(json.loads, answer.out.splitlines())
        assert ["pose" not in line for line in lines] == left_out


def test_images_of_other_things_have_no_pose_in_python_unless_forced(weights, tmp_path):
    like = made.write(tmp_path / "edge", *made.contacts(30, True, 0))
    noise = np.where(RNG.random((2, made.SIZE, made.SIZE)) < 0.2, 255, 0).astype(np.uint8)
    for forced in (False, True):  # no pins: whoever is forced knows no more
        model = load_model(weights, like, force=forced)
        assert np.isnan(model.unshear(noise)).all() and np.isnan(model.codes(noise).pose).all()


def test_folders_of_another_sensor_are_refused_by_name(command, weights, tmp_path):
    contacts = made.contacts(24, False, 0)
    other = made.write(tmp_path / "other", *contacts, sensor=TACTIP_331, size=128)
    answer = command("pose", other, "--model", weights)
    assert answer.code == 2 and "pins" in answer.err and answer.err.count("\n") == 1
