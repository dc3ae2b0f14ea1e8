"""Test a laboratory's day from the command line: from folder to report.

Networks are scored on contacts that they were not trained on, and put to use.
"""

import contextlib
import csv
import errno
import io
import json
import shutil
import sys
from pathlib import Path

import made
import numpy as np
import pytest

from jaxunshear import load_model
from jaxunshear.cli import main
from jaxunshear.config.load import load_experiment
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recorded_contacts import compute_digest
from jaxunshear.data.recordings import read_recordings
from jaxunshear.files import write_json
from jaxunshear.training.checkpoint import read_slides
from tests.golden import make_runs
from tests.helpers.commands import succeed

sys.path.insert(0, str(Path(__file__).parent))
from conftest import ROOT, SHORT

TARGETS = ["y_mm", "z_mm", "Rz_deg"]
FRAME_FIELDS = ("schema", "frame", "name", "time_s", "confidence", "ms")  # of each line
EXPERIMENT = ROOT / "experiments" / "recorded.py"


@pytest.fixture(scope="module")
def slides(tmp_path_factory):
    """40 slides that the run has not seen."""
    return made.edge(tmp_path_factory.mktemp("unseen") / "edge", 20, 40, seed=52) / "shear"


def call_main(*argv):
    """Call a command that succeeds, outside a test; return its output and its messages."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in argv])
    assert code == 0, err.getvalue()
    return out.getvalue(), err.getvalue()


def rows_of(file):
    return {row["name"]: row["value"] for row in json.loads(Path(file).read_text())["rows"]}


def read_csv(text):
    return {row["name"]: row for row in csv.DictReader(text.splitlines())}


def test_a_run_gives_errors_under_the_names_that_other_tools_rely_on(pins_run):
    results = json.loads((pins_run / "results.json").read_text())
    assert results["simulated"] is False and results["test_data"] == "same session"
    for way in ("tap", "sheared", "unsheared", "sheared_learnt"):
        assert list(results["pose_mae"][way]) == TARGETS
    assert list(results["pose_recovery"]["unsheared"]) == TARGETS
    assert results["pose_mae"]["unsheared"] == results["pose_mae"]["disentangled"]
    assert results["pairing"]["way"] == "rendered"
    for table in ("half_width", "coverage"):
        assert {"tap", "sheared", "unsheared"} <= results[table].keys()
    assert all(0.7 < share <= 1 for share in results["coverage"]["unsheared"].values())
    short, _, long = results["pose_by_slide"].values()
    assert short["pose_mae"]["sheared"]["y_mm"] < long["pose_mae"]["sheared"]["y_mm"]
    assert (pins_run / "report.html").stat().st_size > 10_000


def test_golden_figures_of_a_run_over_recordings(pins_run, place):
    make_runs.hold("run over recorded pins", make_runs.collect_run(pins_run, place / "datasets"))


def test_the_network_has_learnt(pins_run):
    results = json.loads((pins_run / "results.json").read_text())
    chance, error = results["baselines"]["pose_chance"], results["pose_mae"]
    assert error["tap"]["Rz_deg"] < 0.35 * chance["Rz_deg"]
    assert error["tap"]["y_mm"] < 0.5 * chance["y_mm"]
    assert error["unsheared"]["Rz_deg"] < error["sheared"]["Rz_deg"]


UNIDENTIFIED = {"tap": [3, 11, 20], "shear": [1, 2, 17, 30, 40]}


def score(pins_run, place, folder, hide):
    """Score the run on recordings whose `UNIDENTIFIED` images have no pins, or are not there."""
    other = made.edge(folder / "edge", 40, 40, seed=50)
    for kind, numbers in UNIDENTIFIED.items():
        if hide:
            made.hide_pins(other / kind / "csv_train", numbers)
        for number in () if hide else numbers:
            (other / kind / "csv_train" / "images" / f"image_{number}.png").unlink()
    words = ("--data", place / "datasets", "--json", folder / "o.json")
    out, _ = call_main("evaluate", pins_run, "--recordings", other, *words)
    return out, json.loads((folder / "o.json").read_text())


@pytest.fixture(scope="module")
def scored(pins_run, place, tmp_path_factory):
    """What `evaluate` prints and writes of recordings that the run has not seen."""
    return score(pins_run, place, tmp_path_factory.mktemp("scored"), hide=False)


def test_a_finished_run_is_scored_on_other_recordings(pins_run, scored):
    out, measured = scored
    rows = {row["name"]: row["value"] for row in measured["rows"]}
    assert measured["test_data"] == "other recordings"
    # the pins of one more slide are not identified anyhow
    assert "test, other recordings: 37 taps, 34 slides" in out
    assert "95 % half-widths of the run's own session, tried on other recordings:" in out
    mae = json.loads((pins_run / "results.json").read_text())["pose_mae"]
    for way in ("tap", "sheared", "unsheared", "sheared_learnt"):
        for target in TARGETS:
            found = rows[f"pose_mae.{way}.{target}"]
            assert 0.4 * mae[way][target] < found < 2.5 * mae[way][target]
        assert 0.5 < rows[f"coverage.{way}.y_mm"] <= 1
    assert "recovery" in out and "% within" in out
    assert "37 taps, 34 slides; left out: 0 taps and 1 slides" in out


def test_contacts_whose_pins_are_not_identified_enter_no_mean_error(
    pins_run, place, scored, tmp_path
):
    hidden, without = score(pins_run, place, tmp_path, hide=True), scored
    for out, _ in (hidden, without):
        assert "37 taps, 34 slides" in out
        assert ("3 taps and 6 slides were not understood" in out) == (out == hidden[0])
    errors = [
        {row["name"]: row["value"] for row in measured["rows"] if row["name"].startswith("pose")}
        for _, measured in (hidden, without)
    ]
    assert len(errors[0]) >= 12 and errors[0] == pytest.approx(errors[1], rel=1e-4)


@pytest.fixture(scope="module")
def posed(pins_run, slides, tmp_path_factory):
    """What `pose` prints, says and writes of the slides."""
    file = tmp_path_factory.mktemp("posed") / "pose.json"
    out, err = call_main("pose", slides, "--model", pins_run, "--json", file)
    return read_csv(out), err, rows_of(file)


@pytest.fixture(scope="module")
def some_hidden(slides, tmp_path_factory):
    """The 40 slides, 20 of them with pins painted out, and which these are."""
    folder = shutil.copytree(slides, tmp_path_factory.mktemp("hidden") / "shear")
    numbers = list(range(1, 41, 2))
    made.hide_pins(folder / "csv_train", numbers)
    return folder, {f"csv_train/images/image_{number}.png" for number in numbers}


def test_images_without_identities_have_no_pose(command, pins_run, slides, some_hidden, tmp_path):
    """Check that they are in no table, in no picture and not in the mean errors.

    They are counted, and half of them are no success.
    """
    folder, hidden = some_hidden
    whole = command("unshear", slides, "--model", pins_run, "--out", tmp_path / "whole")
    assert whole.code == 0, whole.err
    assert "40 images unsheared, 0 left out" in whole.out and "mean error" in whole.out
    words = ("--model", pins_run, "--out", tmp_path / "out", "--json", tmp_path / "u.json")
    answer = command("unshear", folder, *words)
    assert answer.code == 1, answer.err
    assert "20 images unsheared, 20 left out" in answer.out
    assert "left out 20: its pins cannot be identified for sure" in answer.out
    known, rows = (read_csv((tmp_path / out / "poses.csv").read_text()) for out in ("whole", "out"))
    assert rows.keys() == known.keys()
    assert {name for name, row in rows.items() if row["left_out"]} == hidden
    assert len(list((tmp_path / "out").rglob("*.png"))) == 20
    for name, row in rows.items():
        shown = {} if name in hidden else known[name]
        assert [row[target] for target in TARGETS] == [shown.get(name, "") for name in TARGETS]
        assert row["image"] == ("" if name in hidden else name) and row["recorded_pose_y_mm"]
    read = [row for row in rows.values() if row["y_mm"]]
    off = [abs(float(row["y_mm"]) - float(row["recorded_pose_y_mm"])) for row in read]
    measured = rows_of(tmp_path / "u.json")
    assert measured["pose_mae.unsheared.y_mm"] == pytest.approx(np.mean(off), abs=2e-3)
    assert (measured["unshear.images"], measured["unshear.left_out"]) == (20, 20)


def test_pose_and_stream_leave_them_out_likewise(command, pins_run, slides, some_hidden, tmp_path):
    folder, hidden = some_hidden
    answer = command("pose", folder, "--model", pins_run, "--json", tmp_path / "pose.json")
    assert answer.code == 1 and "poses of 20 images, 20 left out" in answer.err
    assert "left out 20: its pins cannot be identified for sure" in answer.err
    rows = read_csv(answer.out)
    for name, row in rows.items():
        cells = [cell for cell in row if cell.startswith(("as_recorded", "unsheared", "learnt"))]
        assert [bool(row[cell]) for cell in cells] == [name not in hidden] * 9
    measured = rows_of(tmp_path / "pose.json")
    assert measured["pose.left_out"] == 20
    assert not [row for row in measured if row.startswith(tuple(hidden))]

    answer = command("stream", folder, "--model", pins_run, "--json", tmp_path / "stream.json")
    assert answer.code == 1 and "20 frames used, 20 skipped" in answer.err
    assert "mean error against the labels: y_mm" in answer.err
    for line in map(json.loads, answer.out.splitlines()):
        if line["name"] in hidden:
            assert line.keys() == {*FRAME_FIELDS, "error"}
            assert line["confidence"] == 0
            assert line["error"] == "its pins cannot be identified for sure"
        else:
            pose = float(rows[line["name"]]["unsheared_y_mm"])
            assert line["pose"]["y_mm"] == pytest.approx(pose, abs=1e-3)
            assert line.keys() == {*FRAME_FIELDS, "touch", "pose", "half_width", "label_error"}
            for field in ("pose", "half_width", "label_error"):
                assert line[field].keys() == set(TARGETS)
    mae = json.loads((tmp_path / "stream.json").read_text())["pose_mae"]
    assert mae["y_mm"] == pytest.approx(measured["pose_mae.unsheared.y_mm"], abs=1e-3)


def test_python_gives_what_the_commands_give_and_nan_of_them(pins_run, some_hidden, posed):
    folder, hidden = some_hidden
    model, recordings = load_model(pins_run), read_recordings(folder, Preprocess(size=made.SIZE))
    frames = [(name, image) for _, name, image in recordings.iterate_frames(model.view)]
    known = np.array([name not in hidden for name, _ in frames])
    images = np.stack([image for _, image in frames])
    codes, pose = model.codes(images), model.pose(images)
    assert codes.pose.shape[1] == 16 and codes.shear.shape[1] == 4
    has_slides = bool(read_slides(pins_run / "disentangled"))
    for answer in (
        *(model.unshear(images), codes.pose, codes.shear),
        *(
            values
            for way in ("as_recorded", "learnt", "unsheared")
            for values in pose[way].values()
        ),
        *(model.slide(images).values() if has_slides else ()),
    ):
        values = answer.reshape(len(known), -1)
        assert np.isfinite(values[known]).all() and np.isnan(values[~known]).all()
    printed = np.array([float(posed[0][name]["unsheared_y_mm"]) for name, _ in frames])
    np.testing.assert_allclose(pose["unsheared"]["y_mm"][known], printed[known], atol=1e-3)


def test_taps_alone_and_slides_alone_are_scored_as_far_as_they_go(
    command, pins_run, place, tmp_path
):
    for slid, there, lacking in ((False, "tap", "sheared"), (True, "unsheared", "tap")):
        folder = made.write(tmp_path / there, *made.contacts(12, slid, 9), "newer")
        words = ("--data", place / "datasets", "--json", tmp_path / "o.json")
        answer = command("evaluate", pins_run, "--recordings", folder, *words)
        assert answer.code == 0, answer.err
        rows = [row.split(".") for row in rows_of(tmp_path / "o.json")]
        ways = {row[1] for row in rows if row[0] == "pose_mae"}
        assert there in ways and lacking not in ways


def test_what_a_run_learnt_from_is_not_taken_for_unseen(command, pins_run, place, recording):
    for known in (recording, recording / "shear"):
        words = ("evaluate", pins_run, "--recordings", known, "--data", place / "datasets")
        answer = command(*words)
        assert answer.code == 2 and "shares its files" in answer.err
        assert answer.err.count("\n") == 1


def test_a_copy_of_earlier_data_is_not_unseen(command, pins_run, place, tmp_path):
    """Its network's model.json lists it, whatever the run's own recordings are."""
    other = made.edge(tmp_path / "other", 20, 20, seed=51)
    run = shutil.copytree(pins_run, tmp_path / "run")
    file = run / "disentangled" / "model.json"
    known = {"data": [compute_digest((str(other),)), "0123456789abcdef"]}
    write_json(file, json.loads(file.read_text()) | known)
    answer = command("evaluate", run, "--recordings", other, "--data", place / "datasets")
    assert answer.code == 2 and "disentangled learnt from data that are tested" in answer.err


def test_poses_have_the_labels_names_and_their_errors_are_printed(posed):
    rows, said, measured = posed
    assert len(rows) == 40
    off = [
        abs(float(row["unsheared_y_mm"]) - float(row["recorded_pose_y_mm"]))
        for row in rows.values()
    ]
    assert measured["pose_mae.unsheared.y_mm"] == pytest.approx(np.mean(off), abs=2e-3)
    assert all(row.keys() >= {f"unsheared_{target}" for target in TARGETS} for row in rows.values())
    assert "mean error against the labels, unsheared" in said
    assert "learnt from recordings of one sensor of 127 pins" in said


def test_a_full_disk_ends_a_stream_in_one_line(command, pins_run, slides, tmp_path, monkeypatch):
    def write(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("jaxunshear.apps.robot.stream._write_line", write)
    words = ("--model", pins_run, "--lines", tmp_path / "lines")
    full = command("stream", slides, *words)
    assert full.code == 2 and "lines: the disk is full" in full.err.splitlines()[-1]


def test_what_walks_in_the_simulator_is_refused_by_name(command, pins_run):
    for words in (("servo", "--model"), ("geometry", "--model"), ("reconstruct",)):
        answer = command(*words, pins_run)
        assert answer.code == 2 and answer.err.count("\n") == 1
        assert "learnt from recordings" in answer.err


def test_weights_are_released_and_used_without_the_recordings(
    command, pins_run, recording, slides, posed, tmp_path
):
    answer = command("release", pins_run, "--out", tmp_path / "ours")
    assert answer.code == 0, answer.err
    card = (tmp_path / "ours" / "README.md").read_text()
    assert "127 pins" in card and str(recording) not in card
    assert str(recording) not in (tmp_path / "ours" / "experiment.json").read_text()
    released = read_csv(command("pose", slides, "--model", tmp_path / "ours").out)
    first, second = (
        [float(row["unsheared_y_mm"]) for row in rows.values()] for rows in (posed[0], released)
    )
    np.testing.assert_allclose(first, second, atol=0.05)  # kernels are stored as float16


@pytest.mark.long
def test_a_direct_posenet_that_convolves_serves_at_every_door(
    command, recording, slides, place, tmp_path
):
    """It also learns from rendered taps; nothing else reads its settings."""
    places = ("--out", tmp_path / "runs", "--data", place / "datasets")
    short = (*SHORT[:2], "--train_pins.epochs", "3", *SHORT[4:-2], "--paired.validation", "0.2")
    asked = ("--pins.direct_conv_channels", "4,6", "--paired.direct_taps", "rendered")
    words = ("--name", "direct", "--networks", "posenet_sheared", *short, *asked)
    succeed(command, "run", EXPERIMENT, "--recordings", recording, *places, *words)
    run = tmp_path / "runs" / "direct"
    kept = json.loads((run / "posenet_sheared" / "model.json").read_text())
    assert kept["net"]["conv_channels"] == [4, 6] and kept["net"]["direct_conv_channels"] == []
    assert kept["origin"]["direct_taps"] == "rendered" and (run / "renderer").is_dir()
    last = json.loads((run / "posenet_sheared" / "log.jsonl").read_text().splitlines()[-1])
    assert last["train"]["rendered_pose"] > 0 and "rendered_pose" not in last["validation"]
    assert "also learns from rendered taps" in (run / "report.html").read_text()
    other = made.edge(tmp_path / "other", 20, 20, seed=53)
    succeed(command, "evaluate", run, "--recordings", other, "--data", place / "datasets")
    assert command("release", run, "--out", tmp_path / "ours").code == 0
    both = [command("pose", slides, "--model", model) for model in (run, tmp_path / "ours")]
    assert [answer.code for answer in both] == [0, 0], both[0].err
    first, second = (
        [float(row["learnt_y_mm"]) for row in csv.DictReader(answer.out.splitlines())]
        for answer in both
    )
    np.testing.assert_allclose(first, second, atol=0.05)  # kernels are stored as float16
    assert np.ptp(first) > 0.1
    succeed(command, "stream", slides, "--model", run, "--lines", tmp_path / "lines")
    succeed(command, "export", run, "--out", tmp_path / "direct.onnx")


@pytest.mark.long
def test_fit_writes_an_experiment_that_runs_again(command, recording, place, tmp_path):
    """Here with slides that have no label, whose poses are read."""
    folders = ("--taps", recording / "tap", "--slides", recording / "shear")
    places = ("--out", tmp_path / "runs", "--data", place / "datasets")
    few = (
        "--paired.labelled",
        "0.4",
        "--paired.unlabelled",
        "pseudo_label",
        "--pins.rotated_share",
        "0.5",
    )
    epochs, networks = ("--train_pins.epochs", "8"), ("--networks", "disentangled,posenet")
    short = (*SHORT[:2], *epochs, *SHORT[4:], *networks)
    answer = command(
        "fit", *folders, *places, "--name", "ours", *short, *few, "--paired.pairing", "nearest"
    )
    assert answer.code == 0, answer.err
    experiment = load_experiment(tmp_path / "runs" / "ours.py")
    assert (experiment.paired.pairing, experiment.unshear.input) == ("nearest", "pins")
    assert experiment.train_pins.epochs == 8
    file = tmp_path / "runs" / "ours.py"
    answer = command("fit", *folders, *places, "--name", "ours", *short)
    assert answer.code == 2 and answer.err.count("\n") == 1
    assert f"{file} is there, and is not what" in answer.err
    assert load_experiment(file) == experiment
    answer = succeed(command, "run", file, *places)
    ours = tmp_path / "runs" / "ours"
    results = json.loads((ours / "results.json").read_text())
    assert results["pairing"]["gaps"]["train"]["y_mm"]["median"] > 0
    error = results["pose_mae"]
    assert error["unsheared"]["Rz_deg"] < 0.8 * error["sheared"]["Rz_deg"]
    reader = json.loads((ours / "posenet_sheared" / "model.json").read_text())
    unshears = json.loads((ours / "disentangled" / "model.json").read_text())
    assert reader["net"]["rotated_share"] == 0.5 and reader["origin"]["labelled"] == 0.4
    assert (
        unshears["origin"]["unlabelled"] == "pseudo_label" and "unlabelled" not in reader["origin"]
    )
    reported = (ours / "report.html").read_text()
    assert "Labels of 40% of the training slides teach" in reported
    assert "posenet_sheared</code> reads off them" in reported


@pytest.mark.long
def test_images_take_the_same_road(command, recording, place, tmp_path):
    small = [f"--{name}.size=32" for name in ("paired.preprocess", "unshear", "posenet")]
    small += ["--unshear.widths=4,4", "--unshear.pose_channels=4", "--unshear.shear_channels=4"]
    small += ["--posenet.widths=4,4,4,4,4", "--posenet.hidden=8", "--train.epochs=0.2"]
    small += ["--train_posenet.epochs=0.5", "--train_pins.epochs=1", "--train_pins.min_steps=1"]
    places = ("--out", tmp_path / "runs", "--data", place / "datasets")
    words = ("run", EXPERIMENT, "--recordings", recording, "--name", "images", *places)
    answer = command(*words, *small)
    assert answer.code == 0, answer.err
    results = json.loads((tmp_path / "runs" / "images" / "results.json").read_text())
    assert list(results["pose_mae"]["unsheared"]) == TARGETS
    assert results["metric"]["input"] == "images"
    assert command("ablate", tmp_path / "runs" / "images", "--data", place / "datasets").code == 0
    words = ("--model", tmp_path / "runs" / "images", "--out", tmp_path / "out")
    refused = command("unshear", recording / "shear", *words)
    assert refused.code == 2 and "--force" in refused.err  # 32 px are too few to know pins by
    succeed(command, "unshear", recording / "shear", *words, "--force")


@pytest.mark.long
@pytest.mark.parametrize(("slid", "network"), [(False, "posenet"), (True, "posenet_sheared")])
def test_taps_alone_or_slides_alone_teach_what_they_can(command, place, tmp_path, slid, network):
    folder = made.write(tmp_path / "surface", *made.contacts(60, slid, 4), "newer")
    places = ("--out", tmp_path / "runs", "--data", tmp_path / "d")
    words = ("run", EXPERIMENT, "--recordings", folder, "--name", network, *places)
    short = (*SHORT[:2], "--train_pins.epochs", "2", *SHORT[4:], "--targets", "y_mm,Rz_deg")
    succeed(command, *words, *short)
    results = json.loads((tmp_path / "runs" / network / "results.json").read_text())
    # a sweep over seeds reads these
    with np.load(tmp_path / "runs" / network / "scores.npz") as scores:
        assert f"pose/{'sheared_learnt' if slid else 'tap'}/y_mm" in scores
    assert list(results["pose_mae"]) == (["sheared_learnt"] if slid else ["tap"])
    assert list(next(iter(results["pose_mae"].values()))) == ["y_mm", "Rz_deg"]
    if slid:
        succeed(command, *words, *short, "--targets", "y_mm,slide_x_mm", "--name", "joint")
        results = json.loads((tmp_path / "runs" / "joint" / "results.json").read_text())
        assert list(results["pose_mae"]["sheared_learnt"]) == ["y_mm", "slide_x_mm"]
        reported = command("pose", folder, "--model", tmp_path / "runs" / "joint")
        assert reported.code == 0 and "slide_x_mm" in reported.out
        assert "mean error against the labels, learnt" in reported.err


REFUSED = [
    ("", "name your recordings: add --recordings DIR"),
    ("--recordings nowhere", "nowhere is no folder of recordings"),
    ("--targets q_mm", "target 'q_mm' is unknown"),
    ("--targets y_mm,slide_x_mm", "a tap has no slide_x_mm: name --networks posenet_sheared alone"),
    ("--targets y_mm:circle", "only an angle goes round a circle"),
    (
        "--paired.pairing guess",
        "is unknown: use one of rendered, nearest, pose_id, file, simulated",
    ),
    ("--paired.split session", "is unknown: use one of random, block, folder"),
    ("--paired.split folder", "no folder of taps has the name of the split 'test'"),
    ("--paired.labelled 0", "a share above 0"),
    ("--paired.unlabelled guessed", "is unknown: use one of left_out, pseudo_label"),
    (
        "--paired.unlabelled pseudo_label --paired.pairing pose_id",
        "give no partner for pairing pose_id",
    ),
    ("--pins.rotated_share 0.5", "changes none of the networks"),
    (
        "--pins.rotated_share 0.5 --unshear.input pins --networks disentangled,posenet",
        "changes none of the networks",
    ),
    ("--train.rotated_below 9", "changes none of the networks"),
    (
        "--paired.pairing simulated --paired.labelled 0.5",
        "simulated takes no recorded slide to learn from",
    ),
    ("--paired.pairing simulated --unshear.input pins", "yours, tactip127, has 127"),
    ("--networks unet --unshear.input pins", "unet does not read pins"),
    ("--pins.direct_conv_channels 4", "changes none of the networks"),
    (
        "--pins.direct_conv_channels 4 --pins.rotated_share 0.5 --unshear.input pins",
        "leave pins.rotated_share at 0",
    ),
    ("--paired.direct_taps rendered", "rendered is for networks over pins: use recorded"),
    ("--paired.direct_taps recorded --networks posenet", "changes none of the networks"),
    ("--paired.direct_taps recorded --paired.pairing simulated", "and direct_taps at none"),
    ("--unseen flower", "is a test of simulated touches"),
]


@pytest.mark.parametrize(("words", "complaint"), REFUSED)
def test_what_cannot_work_is_refused_in_one_line(command, recording, tmp_path, words, complaint):
    named = () if not words or "--recordings" in words else ("--recordings", recording)
    answer = command("run", EXPERIMENT, "--out", tmp_path / "runs", *named, *words.split())
    assert answer.code == 2 and complaint in answer.err and answer.err.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_a_simulated_experiment_takes_no_recordings(command, recording):
    answer = command("run", ROOT / "experiments" / "tiny.py", "--recordings", recording)
    assert answer.code == 2 and "is about simulated touches" in answer.err
