"""Runs side by side: made-up runs whose scores are known, so every difference and interval has a value of its own."""

import json
import re
import shutil
from dataclasses import asdict
from functools import partial

import jax
import numpy as np
import pytest

from jaxunshear.compare.contacts import contacts, unsheared_by
from jaxunshear.compare.figures import figures
from jaxunshear.compare.runs import OWN, Run, notes, read_runs, settings_apart
from jaxunshear.evaluation.evaluate import every_score
from jaxunshear.model import unshearnet
from jaxunshear.model.unshearing import unshear
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import Outcome
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.networks import UnshearNet
from jaxunshear.settings.stored import to_json
from jaxunshear.storage import write_json
from jaxunshear.sweep.scores import Measured
from jaxunshear.training import checkpoint
from jaxunshear.training.loop import run_once
from tests.report.conftest import Reader, made_up_gathered, make_run

GAIN = "pose/disentangled/edge_mm"


def rewritten(folder, settings=(), scores=None):
    """A run with other settings, by dotted name, and other scores."""
    path = folder / "results.json"
    results = json.loads(path.read_text())
    for name, value in dict(settings).items():
        place = results["settings"]
        *groups, last = name.split(".")
        for group in groups:
            place = place[group]
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
    (folder / "scores.npz").write_bytes(every_score(made_up_gathered()))
    with np.load(folder / "scores.npz") as file:
        return folder, dict(file)


@pytest.fixture
def pair(finished, tmp_path):
    """Two runs on the same contacts: the second reads the edge better by what depends on the contact."""
    source, scores = finished
    first, second = (shutil.copytree(source, tmp_path / name) for name in ("first", "second"))
    gain = 0.3 + 0.2 * np.sin(np.arange(len(scores[GAIN])))
    rewritten(second, {"train.learning_rate": 0.01}, scores | {GAIN: scores[GAIN] - gain})
    return first, second, gain


def means(values, poses):
    """Of values in each of a thousand draws of poses, each with all its contacts."""
    named, group = np.unique(poses, axis=0, return_inverse=True)
    drawn = np.random.default_rng(0).multinomial(len(named), np.full(len(named), 1 / len(named)), size=1000)
    return np.array([np.repeat(values, draw[group.reshape(-1)]).mean() for draw in drawn])


def named(folders):
    return {figure.name: figure for figure in figures(read_runs(folders))}


def test_a_difference_is_of_pairs(pair, finished):
    first, second, gain = pair
    scores = finished[1]
    found, poses = named((first, second)), np.stack([scores["stimulus"], scores["pose_id"]], axis=1)
    less = found[GAIN].less[1]
    assert less.mean == pytest.approx(-gain.mean(), rel=1e-5)
    assert less.interval == pytest.approx(np.quantile(means(-gain, poses), [0.025, 0.975]), rel=1e-5)
    assert found[GAIN].verdict(1) == "better" and found[GAIN].less[0] is None
    apart = [figure.interval[1] - figure.interval[0] for figure in found[GAIN].of]
    assert less.interval[1] - less.interval[0] < 0.5 * min(apart)  # what is common to both cancels


def test_recoveries_differ_draw_by_draw(pair, finished):
    first, second, gain = pair
    scores = finished[1]
    poses = np.stack([scores["stimulus"], scores["pose_id"]], axis=1)
    tap, sheared, ours = (means(scores[f"pose/{k}/edge_mm"], poses) for k in ("tap", "sheared", "disentangled"))
    expected = means(gain, poses) / (sheared - tap)  # (s - (u - g)) / (s - t) less (s - u) / (s - t)
    less = named((first, second))["pose_recovery/disentangled/edge_mm"].less[1]
    assert less.interval == pytest.approx(np.quantile(expected, [0.025, 0.975]), rel=1e-4)
    assert less.mean > 0 and len(ours) == 1000


def test_a_run_does_not_differ_from_its_copy(finished, tmp_path):
    copy = shutil.copytree(finished[0], tmp_path / "copy")
    found = named((finished[0], copy))
    paired = [figure.less[1] for figure in found.values() if figure.less[1]]
    assert len(paired) > 30 and all(less.mean == 0 and less.interval in ([0, 0], None) for less in paired)
    assert not settings_apart(read_runs((finished[0], copy)))


def test_the_page_and_the_lines(pair, command, tmp_path):
    first, second, _ = pair
    before = {path: path.read_bytes() for folder in (first, second) for path in folder.rglob("*") if path.is_file()}
    answer = command("compare", first, second, "--out", tmp_path / "out", "--json", tmp_path / "rows.json")
    assert answer.code == 0, answer.err
    assert (
        len(answer.out.splitlines()) <= 10 and answer.out.splitlines()[-1] == f"page: {tmp_path}/out/first-second.html"
    )
    assert "settings that differ: train.learning_rate" in answer.out
    html = (tmp_path / "out" / "first-second.html").read_text()
    reader = Reader()
    reader.feed(html)
    text = " ".join(" ".join(reader.text).split())
    assert not reader.open and all(address.startswith("data:image/") for address in reader.addresses)
    assert "says nothing of another training" in text and "jaxunshear sweep" in text
    assert "train.learning_rate 0.001 0.01" in text and "no images of second: " in text  # it has no checkpoints
    assert len(re.findall("data:image/png", html)) == 3 * 3  # of each shape: input, first run, tap
    measured = json.loads((tmp_path / "rows.json").read_text())
    (row,) = [r for r in measured["rows"] if r["name"] == GAIN and r["run"] == str(second)]
    assert row["difference"] < 0 and f"{row['difference']:.4f}" in text
    assert measured["settings"] == {"train.learning_rate": {str(first): "0.001", str(second): "0.01"}}
    now = {path: path.read_bytes() for folder in (first, second) for path in folder.rglob("*") if path.is_file()}
    assert now == before
    assert command("compare", first, second, "--out", tmp_path / "out").code == 0
    assert (tmp_path / "out" / "first-second.html").read_text() == html


def test_other_contacts_are_not_paired(pair):
    first, second, _ = pair
    rewritten(second, {"paired.seed": 7})
    (said,) = notes(read_runs((first, second)))
    assert said == "second was scored on another test set than first: no differences are given"
    found = named((first, second))
    assert found[GAIN].of[1].interval and not any(figure.less[1] for figure in found.values())


def test_likeness_of_pins_and_of_images_is_not_compared(pair):
    first, second, _ = pair
    rewritten(second, {"unshear.input": "pins"})
    found = named((first, second))
    assert found[GAIN].less[1] and not found["ms_ssim/disentangled"].less[1] and found["ms_ssim/disentangled"].of[1]


def test_another_runs_network_is_given_the_references_images(tmp_path):
    plain = Experiment(name="small", claim="none", networks=("disentangled",))
    folder, net = tmp_path / "second", UnshearNet(size=32, widths=(4, 4), pose_channels=3, shear_channels=3)
    variables = jax.jit(partial(unshearnet.init, net), compiler_options=run_once())(key=jax.random.key(0))
    variables |= {"params": jax.tree.map(lambda x: 10 * x, variables["params"])}
    network = folder / "disentangled"
    checkpoint.write_settings(network, {"kind": "unshear", "net": asdict(net), "targets": []})
    checkpoint.save(network, 1, {"average": variables}, {"best_step": 1, "history": []})
    write_json(network / "summary.json", {"steps": 1})
    (folder / "experiment.json").write_text(json.dumps(to_json(plain)))
    results = Results(settings=to_json(plain), metric={}, pin_error={}, ms_ssim={"disentangled": {}})
    measured = Measured(
        Outcome(status="done", reason=None, results=results), {"": {"stimulus": np.zeros(3), "pose_id": np.arange(3)}}
    )
    run = Run("second", folder, measured, {}, {}, None)
    sheared = (np.random.default_rng(0).random((3, 32, 32)) < 0.3).astype(np.uint8) * np.uint8(255)
    expected = unshear(net, variables, sheared[..., None].astype(np.float32) / 255)
    found = unsheared_by(run, run._replace(name="first"), sheared)
    assert np.abs(found - 255 * np.clip(np.asarray(expected)[..., 0], 0, 1)).max() < 1 and found.std() > 5


def test_of_runs_over_pins_the_contacts_are_shown_that_all_kept(pair):
    for folder in pair[:2]:
        rewritten(folder, {"unshear.input": "pins"})
    with np.load(pair[1] / "montage.npz") as file:
        held = dict(file)
    shown = contacts(read_runs(pair[:2]))
    assert len(shown.said) == len(held["tap"]) and np.array_equal(*shown.unsheared) and not shown.notes
    np.savez(pair[1] / "montage.npz", **held | {"sheared": held["sheared"][:, ::-1]})  # of other contacts
    shown = contacts(read_runs(pair[:2]))
    assert len(shown.said) == 3 and shown.unsheared[1] is None and "kept images of other contacts" in shown.notes[0]


def test_runs_about_different_networks_are_compared_by_their_own(pair, finished):
    first, second, _ = pair
    scores = {name: score for name, score in finished[1].items() if "disentangled" not in name}
    rewritten(second, {"networks": ["entangled", "posenet"]}, scores)
    results = json.loads((second / "results.json").read_text())
    del results["ms_ssim"]["disentangled"]
    write_json(second / "results.json", results)
    less = named((first, second))[f"pose/{OWN}/edge_mm"].less[1]
    gap = finished[1]["pose/entangled/edge_mm"] - finished[1][GAIN]
    assert less.mean == pytest.approx(gap.mean(), rel=1e-5)
    assert notes(read_runs((first, second))) == ["second has no disentangled"]


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
        answer = command("compare", *words, *([] if "--out" in words else ["--out", tmp_path / "out"]))
        assert (answer.code, answer.err.count("\n")) == (2, 1) and reason in answer.err, answer.err
    assert not (tmp_path / "out").exists() and not (first / "new").exists()
