"""Comparison of made-up runs with known scores, differences and intervals."""

import json
import re
import shutil

import numpy as np
import pytest

from jaxunshear.compare import compare_scores, compare_settings, note_obstacles, read_runs
from jaxunshear.evaluation.evaluate import collect_scores
from jaxunshear.files import write_json
from jaxunshear.progress import format_duration
from tests.report.conftest import Reader, made_up_gathered, make_run

GAIN = "pose/disentangled/edge_mm"


def rewritten(folder, settings=(), scores=None):
    """A run with other settings, by dotted name, and other scores."""
    path = folder / "results.json"
    results = json.loads(path.read_text())
    for name, value in dict(settings).items():
        group, _, last = name.rpartition(".")
        place = results["settings"][group] if group else results["settings"]
        place[last] = value
    write_json(path, results)
    if scores is not None:
        np.savez(folder / "scores.npz", **scores)
    return folder


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A run, its scores and its poses."""
    folder = tmp_path_factory.mktemp("compared") / "first"
    folder.mkdir()
    make_run(folder)
    np.savez(folder / "scores.npz", **collect_scores(made_up_gathered()))
    with np.load(folder / "scores.npz") as file:
        return folder, dict(file)


@pytest.fixture
def pair(finished, tmp_path):
    """Two runs on the same contacts; the second has smaller errors, by contact."""
    source, scores = finished
    first, second = (shutil.copytree(source, tmp_path / name) for name in ("first", "second"))
    gain = 0.3 + 0.2 * np.sin(np.arange(len(scores[GAIN])))
    rewritten(second, {"train.learning_rate": 0.01}, scores | {GAIN: scores[GAIN] - gain})
    return first, second, gain


def means(values, poses):
    """Of values in each of a thousand draws of poses, each with all its contacts."""
    named, group = np.unique(poses, axis=0, return_inverse=True)
    shares = np.full(len(named), 1 / len(named))
    drawn = np.random.default_rng(0).multinomial(len(named), shares, size=1000)
    return np.array([np.repeat(values, draw[group.reshape(-1)]).mean() for draw in drawn])


def contents(*folders):
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    return {path: path.read_bytes() for path in files}


def named(folders):
    return {score.name: score for score in compare_scores(read_runs(folders))}


def test_a_difference_is_of_pairs(pair, finished):
    first, second, gain = pair
    scores = finished[1]
    found, poses = named((first, second)), np.stack([scores["stimulus"], scores["pose_id"]], axis=1)
    change = found[GAIN].changes[1]
    assert change.mean == pytest.approx(-gain.mean(), rel=1e-5)
    expected = np.quantile(means(-gain, poses), [0.025, 0.975])
    assert change.interval == pytest.approx(expected, rel=1e-5)
    assert found[GAIN].changes[0] is None
    apart = [value.interval[1] - value.interval[0] for value in found[GAIN].values]
    shared = change.interval[1] - change.interval[0]
    assert shared < 0.5 * min(apart)  # what is common to both cancels


def test_a_run_does_not_differ_from_its_copy(finished, tmp_path):
    copy = shutil.copytree(finished[0], tmp_path / "copy")
    found = named((finished[0], copy))
    paired = [score.changes[1] for score in found.values() if score.changes[1]]
    assert len(paired) > 30
    assert all(change.mean == 0 and change.interval in ([0, 0], None) for change in paired)
    assert not compare_settings(read_runs((finished[0], copy)))


def test_the_page_and_the_text(pair, command, tmp_path):
    first, second, _ = pair
    before = contents(first, second)
    answer = command("compare", first, second, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert len(answer.out.splitlines()) <= 14
    assert answer.out.splitlines()[-1] == f"page: {tmp_path}/out/first-second.html"
    assert "settings that differ: train.learning_rate 0.001 | 0.01" in answer.out
    assert re.search(
        f"training of disentangled +{format_duration(168)} +{format_duration(168)}", answer.out
    )
    html = (tmp_path / "out" / "first-second.html").read_text()
    reader = Reader()
    reader.feed(html)
    text = " ".join(" ".join(reader.text).split())
    assert not reader.open and not reader.addresses
    assert "do not cover other trainings" in text and "jaxunshear sweep" in text
    assert "train.learning_rate 0.001 0.01" in text and "training of disentangled" in text
    change = named((first, second))[GAIN].changes[1]
    assert f"{change.mean:+.3g} [{change.interval[0]:.3g}, {change.interval[1]:.3g}]" in text
    assert contents(first, second) == before
    assert command("compare", first, second, "--out", tmp_path / "out").code == 0
    assert (tmp_path / "out" / "first-second.html").read_text() == html


def test_other_contacts_are_not_paired(pair):
    first, second, _ = pair
    rewritten(second, {"paired.seed": 7})
    (note,) = note_obstacles(read_runs((first, second)))
    assert note == "second was scored on another test set than first: no differences are given"
    found = named((first, second))
    assert found[GAIN].values[1].interval and not any(score.changes[1] for score in found.values())


def test_likeness_of_pins_and_of_images_is_not_compared(pair):
    first, second, _ = pair
    rewritten(second, {"unshear.input": "pins"})
    found = named((first, second))
    likeness = found["ms_ssim/disentangled"]
    assert found[GAIN].changes[1] and not likeness.changes[1] and likeness.values[1]


def test_runs_about_different_networks_stand_side_by_side(pair, finished, command, tmp_path):
    first, second, _ = pair
    scores = {name: score for name, score in finished[1].items() if "disentangled" not in name}
    rewritten(second, {"networks": ["entangled", "posenet"]}, scores)
    results = json.loads((second / "results.json").read_text())
    del results["ms_ssim"]["disentangled"]
    write_json(second / "results.json", results)
    assert note_obstacles(read_runs((first, second))) == ["second has no disentangled"]
    answer = command("compare", first, second, "--out", tmp_path / "out")
    assert GAIN in answer.out and GAIN.replace("disentangled", "entangled") in answer.out


def test_what_cannot_be_compared_is_refused_in_one_line(pair, command, tmp_path):
    first, second, _ = pair
    (tmp_path / "link").symlink_to(first)
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    (unfinished / "experiment.json").write_text("{}")
    damaged = shutil.copytree(second, tmp_path / "damaged")
    (damaged / "scores.npz").write_bytes(b"PK")
    for words, reason in (
        ((first,), "two runs or more"),
        ((first, tmp_path / "link"), "the same run"),
        ((first, second, second), "the same run"),
        ((first, unfinished), "is not finished"),
        ((first, tmp_path / "nowhere"), "holds no results.json"),
        ((first, damaged), "is damaged"),
        ((first, second, "--out", first / "new"), "lies in"),
    ):
        if reason == "lies in":
            (first / "experiment.json").write_text('{"unshear": {}}')
        out = () if "--out" in words else ("--out", tmp_path / "out")
        answer = command("compare", *words, *out)
        assert (answer.code, answer.err.count("\n")) == (2, 1) and reason in answer.err, answer.err
    assert not (tmp_path / "out").exists() and not (first / "new").exists()
