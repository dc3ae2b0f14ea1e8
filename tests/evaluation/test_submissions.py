"""`score`: results of other programs on recorded slides."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxunshear.evaluation.submissions import score_submission
from jaxunshear.files import format_csv, write_npz

sys.path.insert(0, str(Path(__file__).parents[1] / "recordings"))
import made

COUNT = 12


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Taps, and slides to their poses; the last slide ends where no tap is."""
    folder = tmp_path_factory.mktemp("score") / "edge"
    pose, move = made.contacts(COUNT, True, 0)
    made.write(folder / "tap", pose, np.zeros_like(move))
    pose[-1, 1] += 1
    made.write(folder / "shear", pose, move)
    return folder


@pytest.fixture(scope="module")
def poses():
    """Of the slides, in the order of their images."""
    pose, _ = made.contacts(COUNT, True, 0)
    pose[-1, 1] += 1
    return pose


def by_name(submission):
    return {row["name"]: row for row in submission.rows}


def test_taps_in_the_place_of_slides_are_without_fault(recording, tmp_path):
    shutil.copytree(recording / "tap" / "images", tmp_path / "theirs")
    (tmp_path / "theirs" / "image_1.png").write_bytes(b"broken")
    (tmp_path / "theirs" / "image_2.png").rename(tmp_path / "theirs" / "other.png")
    submission = score_submission(tmp_path / "theirs", recording)
    rows = by_name(submission)
    assert list(rows) == ["ms_ssim@4.submitted", "ssim.submitted", "mse.submitted"]
    assert submission.scored == COUNT - 3 == rows["mse.submitted"]["slides"]
    assert {reason: count for reason, count in submission.left_out.items() if count} == {
        "not of a slide that is scored": 1,
        "slides without a result": 1,
        "no tap at the slide's pose": 1,
        "not readable": 1,
    }
    assert rows["mse.submitted"]["value"] == 0 < rows["mse.submitted"]["sheared"]
    assert rows["ssim.submitted"]["value_interval"] == pytest.approx([1, 1])
    low, high = rows["ssim.submitted"]["difference_interval"]
    assert 0 < low <= rows["ssim.submitted"]["difference"] <= high


def test_slides_as_recorded_gain_nothing(recording, tmp_path):
    submission = score_submission(recording / "shear", recording)
    for row in submission.rows:
        assert row["value"] == row["sheared"] and row["difference"] == 0


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_poses_are_compared_with_their_labels(recording, poses, tmp_path, ending):
    names = [f"images/image_{i + 1}.png" for i in range(COUNT)]
    y, turn = poses[:, 1] + 0.5, poses[:, 5] + 360 - 2
    y[3] = np.nan
    file = tmp_path / f"theirs.{ending}"
    if ending == "npz":
        write_npz(file, {"name": np.array(names), "y_mm": y, "Rz_deg": turn})
    else:
        cells = zip(names, y, turn, strict=True)
        table = [
            {"name": n, "y_mm": a if a == a else "", "Rz_deg": b, "w": "x"} for n, a, b in cells
        ]
        file.write_text(format_csv(table))
    submission = score_submission(file, recording)
    rows = by_name(submission)
    assert submission.left_out["no value"] == 1 and submission.scored == COUNT - 1
    assert rows["pose_mae.submitted.y_mm"]["value"] == pytest.approx(0.5, abs=1e-5)
    assert rows["pose_mae.submitted.Rz_deg"]["value"] == pytest.approx(2, abs=1e-4)
    assert rows["pose_mae.submitted.y_mm"]["median_label"] > 0.5


def test_the_command_prints_a_table_and_writes_rows(recording, poses, tmp_path, command):
    table = [{"name": f"image_{i + 1}", "y_mm": y} for i, y in enumerate(poses[:4, 1])]
    (tmp_path / "few.csv").write_text(format_csv(table))
    json_file = tmp_path / "score.json"
    answer = command("score", tmp_path / "few.csv", "--recordings", recording, "--json", json_file)
    assert answer.code == 1  # most slides have no result
    assert "pose_mae.submitted.y_mm" in answer.out
    assert f"left out {COUNT - 4}: slides without a result" in answer.out
    assert json.loads(json_file.read_text())["rows"][0]["value"] == 0


def test_what_cannot_be_scored_is_refused_in_one_line(recording, tmp_path, command):
    tables = {
        "a.csv": ("name,y_mm\nother.png,1\n", "scored: 1 not of a slide that is scored, 12 "),
        "b.csv": ("file,y_mm\nimage_1.png,1\n", "no column of file names: add one called name"),
        "c.csv": ("name,colour\nimage_1.png,1\n", "no column that is called as a label: use x_mm"),
        "d.csv": ("name,y_mm\nimage_1,1\nimage_1.png,2\n", "has two results"),
        "e.npz": ("no archive", "cannot be read as npz"),
    }
    for name, (text, line) in tables.items():
        (tmp_path / name).write_text(text)
        answer = command("score", tmp_path / name, "--recordings", recording)
        assert answer.code == 2 and line in answer.err and answer.err.count("\n") == 1, name
    for words, line in (
        ((tmp_path / "none", "--recordings", recording), "none does not exist"),
        ((recording / "tap", "--recordings", recording / "tap"), "holds no slide with a label"),
        ((recording / "shear", "--recordings", recording / "shear"), "a tap was recorded"),
    ):
        answer = command("score", *words)
        assert answer.code == 2 and line in answer.err and answer.err.count("\n") == 1
