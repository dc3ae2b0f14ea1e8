"""The page of recorded runs with made-up scores: images, pins, only taps or only slides."""

import functools
import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from jaxunshear.config.data import Recorded
from jaxunshear.config.targets import make_label_targets
from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.evaluate import collect_montage
from jaxunshear.evaluation.measurements import round_values
from jaxunshear.evaluation.recorded_evaluation import convert_montage_labels
from jaxunshear.evaluation.recorded_results import (
    RecordedScores,
    RecordedTest,
    build_recorded_results,
)
from jaxunshear.evaluation.score import CELL_METRICS, CELLS
from jaxunshear.files import to_builtins
from jaxunshear.fit import BASE_EXPERIMENT
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results
from jaxunshear.run import print_summary

COUNT, KEPT = 24, 12
ERRORS = {"partner": 0.9, "sheared": 4.0, "sheared_learnt": 1.5, "disentangled": 1.75}
SCALE = {"y_mm": 0.1, "z_mm": 0.04, "Rz_deg": 2.0}
LIKENESS = {"sheared": 0.683, "disentangled": 0.979}
FOLDER = "day <script>alert(1)</script>"
LEARNT = "learnt from slides directly"
BOTH = ("disentangled", "posenet", "posenet_sheared")


def poses(generator, count):
    pose = np.zeros((count, 6))
    for column, span in {1: (-6, 6), 2: (3, 5), 5: (-180, 180)}.items():
        pose[:, column] = generator.uniform(*span, count)
    return pose


def gathered(networks, pairing, over, shown):
    """Slides that were scored, or taps."""
    generator = np.random.default_rng(1)
    spread = lambda mean, size: np.abs(mean + size * generator.normal(size=COUNT))  # noqa: E731
    kinds = ERRORS if "disentangled" in networks else {"sheared_learnt": ERRORS["sheared_learnt"]}
    scores = {}
    for kind, error in (kinds if shown else {"tap": 1.0}).items():
        for name, scale in SCALE.items():
            scores[f"pose/{kind}/{name}"] = spread(error * scale, 0.1 * scale)
    if shown and pairing:
        scores |= {f"ms_ssim/{kind}": spread(mean, 0.001) for kind, mean in LIKENESS.items()}
        cells = ("DC(z_p)", "DS(z_p,z_s)") if over else CELLS
        for cell, metric in itertools.product(cells, CELL_METRICS):
            scores[f"swap/{cell}/{metric}"] = spread(0.2, 0.05)
        worse = {name: 0.25 * scale + np.zeros(COUNT) for name, scale in SCALE.items()}
        worse |= {"z_mm": np.linspace(-0.01, 0.01, COUNT), "Rz_deg": -worse["Rz_deg"]}
        scores |= {f"difference/sheared_learnt/{name}": each for name, each in worse.items()}
        if over:
            scores |= {"pins/disentangled": spread(0.061, 1e-4), "pins/sheared": spread(1.05, 1e-4)}
    number = np.arange(COUNT)
    labels = {
        "pose": poses(generator, COUNT),
        "move": generator.uniform(-3, 3, (COUNT, 6)),
        "pose_id": number,
        "stimulus": np.zeros(COUNT, int),
        "number": number,
        "sure": np.ones(COUNT, int),
    }
    drawn = generator.integers(0, 255, (3, KEPT, 128, 128)).astype(np.uint8)
    images = dict(zip(("tap", "sheared", "disentangled"), drawn, strict=True))
    pins = dict.fromkeys(("canonical_pins", "sheared_pins"), np.full((KEPT, 331, 2), np.nan))
    return ContactScores(scores, labels, np.arange(KEPT), images, pins)


def make_run(folder, networks=BOTH, pairing="rendered", over=False):
    """A finished run in `folder`; returns its results."""
    settings = Recorded(FOLDER, FOLDER, "12ab", pairing=pairing or "rendered")
    experiment = replace(
        BASE_EXPERIMENT,
        name="laboratory",
        paired=settings,
        networks=networks,
        unshear=replace(BASE_EXPERIMENT.unshear, input="pins" if over else "images"),
    )
    slides = gathered(networks, pairing, over, True) if "posenet_sheared" in networks else None
    taps = gathered(networks, pairing, over, False) if "posenet" in networks else None
    splits = {"train": 400, "validation": 51, "test": COUNT}
    none = dict.fromkeys(splits, 0)
    counts = {
        "contacts": 955,
        "dropped": 2,
        "unsure": 7,
        "taps": splits if taps else none,
        "slides": splits if slides else none,
        "written": splits,
        "dropped_frames": [f"{FOLDER}/frame_7.png: all black", "frame_9.png: cannot be read"],
    }
    stored = SimpleNamespace(
        size=128,
        settings=settings,
        metadata={"counts": counts, "pins": {"sure": 0.9927}, "notes": ["labels <b>lack</b> Rx"]},
    )
    gap = np.full((COUNT, 6), 0.42)
    reader = SimpleNamespace(length=lambda split: COUNT, take=lambda *_: {"gap": gap})
    targets = make_label_targets((), poses(np.random.default_rng(2), 200))
    readers = (reader if slides else None, reader if taps else None)
    test = RecordedTest(*readers, bool(slides and pairing), "same session")
    scores = RecordedScores(slides, taps)
    results = to_builtins(build_recorded_results(experiment, stored, targets, scores, test))
    results |= {
        "ms_per_image": {"posenet": {"median": 0.04, "p95": 0.12}},
        "time_s": {"posenet": 341.0, "evaluate": 20.0},
        "machine": {"processor": "none", "cores": 2, "device": "cpu: cpu"},
        "versions": {"python": "3.11.7"},
        "command": f"jaxunshear run experiments/recorded.py --recordings '{FOLDER}'",
    }
    results = round_values(results)
    (folder / "results.json").write_text(json.dumps(results))
    if slides and pairing:
        montage = collect_montage(("recorded",), convert_montage_labels(slides))
        np.savez(folder / "montage.npz", **montage)
    (folder / "posenet").mkdir()
    line = {"epoch": 1, "train_seconds": 3.0, "train": {"pose": 0.2}}
    line["validation"] = {"pose": 0.1, "y_mm": 0.3}
    (folder / "posenet" / "log.jsonl").write_text(json.dumps(line) + "\n")
    return results


class Report(NamedTuple):
    folder: Path
    results: dict
    text: str


@pytest.fixture(scope="module")
def report(tmp_path_factory, read_report):
    """`report(pairing="nearest")` is the report of a run with these settings, written once."""

    @functools.cache
    def report(**settings):
        folder = tmp_path_factory.mktemp("run")
        return Report(folder, make_run(folder, **settings), read_report(folder))

    return report


def test_of_taps_and_slides_all_is_reported(report):
    _, results, text = report()
    for kind, row in results["pose_mae"].items():
        for name, value in row.items():
            assert f"{value:.{3 if name.endswith('_mm') else 2}f}" in text, (kind, name)
    for value in results["pose_recovery"]["unsheared"].values():
        assert f"{value:.2f}" in text
    sheared, unsheared = results["pose_mae"]["sheared"], results["pose_mae"]["unsheared"]
    for words in (
        "kept out of training: 24 taps and 24 slides (same session, random split).",
        f"{sheared['y_mm']:.2f} \u2192 {unsheared['y_mm']:.2f} mm",
        f"taps: {results['pose_mae']['tap']['z_mm']:.2f}, learnt from slides directly",
        "Likeness to the partner (ms_ssim@4)",
        "0.68 \u2192 0.98",
        "6 min 01 s",
        "one answer to every contact",
        f"{results['baselines']['pose_chance']['Rz_deg']:.2f}",
        "a recovery of 0.91 in x and 0.89 in yaw",
        "unsheared against partner",
        "sheared \u2192 unsheared, by z",
        "posenet 0.04 ms",
    ):
        assert words in text, words
    assert not any(words in text for words in ("tap (truth)", "Contact quality", "shapes"))


def test_a_network_is_held_against_learning_from_slides_directly(report):
    text = report().text
    for subject, verdict in (
        ("mm of y: PoseNet that learnt slides +0.", "worse"),
        ("mm of z: PoseNet that learnt slides", "not distinguishable"),
        ("deg of Rz: PoseNet that learnt slides -0.", "better"),
    ):
        sentence = text.split(subject)[1]
        assert sentence.partition(")")[0].endswith(f"({verdict}"), subject


def test_the_recordings_are_reported(report):
    text = report(pairing="nearest").text.split("The recordings")[1]
    for words in (
        *("taps 400 51 24", "slides 400 51 24", "955, 2 of them left out", "99.3%"),
        *("in 7 they are not", "frame_9.png: cannot be read", "labels <b>lack</b> Rx"),
        *("y -5.9", "Rz over the full circle", "whose pose is nearest"),
        "test 24 0.42 (0.42) 0.42 (0.42) 0.42 (0.42)",
    ):
        assert words in text, words


def test_half_widths_say_which_contacts_they_are_for(tmp_path, read_report):
    results = make_run(tmp_path)
    results["half_width"] = {"unsheared": {"z_mm": 0.12}}
    results["coverage"] = {"unsheared": {"z_mm": 0.961}}
    text = read_report(tmp_path, results).split("How far an answer may be off")[1]
    assert "0.12 (96.1%)" in text and "validation contacts of the same session" in text
    assert "On other recordings of a public edge" in text and "82 % of z" in text


def test_a_run_of_an_earlier_version_was_tested_on_its_own_session(tmp_path, read_report):
    results = make_run(tmp_path)
    for split, words in ((None, "random split"), ("block", "block of poses")):
        results |= {"test_data": None}
        results["settings"]["paired"].pop("split")
        results["settings"]["paired"] |= {"split": split} if split else {}
        text = read_report(tmp_path, results)
        assert f"all figures are of test (same session, {words})" in text
        results["settings"]["paired"]["split"] = split


def test_names_are_escaped(report):
    html = (report().folder / "report.html").read_text()
    assert "<script" not in html and "lack</b>" not in html
    name = "&lt;script&gt;alert(1)&lt;/script&gt;"
    assert html.count(name) >= 4  # folder, frame, command, settings


@pytest.mark.parametrize(
    "settings", [{}, {"pairing": "nearest"}, {"pairing": "pose_id", "over": True}]
)
def test_the_papers_columns_are_of_its_own_quantities(report, settings):
    folder, _, text = report(**settings)
    assert "class=real" not in (folder / "report.html").read_text() and "tinted" not in text
    assert "22.20" not in text and "0.93 0.9" not in text


@pytest.mark.parametrize("pairing", ["pose_id", "file"])
def test_the_papers_likeness_stands_beside_that_to_recorded_taps(report, pairing):
    text = report(pairing=pairing).text
    shown = ("tinted columns", "overall paper", "MSE paper", "tap (truth)")
    assert all(words in text for words in shown) and "22.20" not in text


def test_pins_are_reported_by_name_and_in_px_alone(report):
    text = report(over=True).text
    part = text.split("Where the pins are")[1].split("The recordings")[0]
    assert "slides, unsheared (disentangled) 0.06" in part and "1.05" in part
    assert "mm" not in part and "missed" not in part
    for words in ("the images are these pins, drawn", "of drawn pins", "The two decoders"):
        assert words in text


def test_pins_found_in_images_are_counted(tmp_path, report, read_report):
    results = make_run(tmp_path)
    title = "Where the pins are"
    assert title not in report().text  # none was followed for sure
    found = {"rms_px": 0.5, "rms_mm": None, "missed_per_image": 1.5, "extra_per_image": 2.5}
    results["pin_error"] = {"tap": found, "disentangled": found, "true_slide": {"rms_px": 1.0}}
    part = read_report(tmp_path, results).split(title)[1].split("The recordings")[0]
    assert "partner 0.50 1.5 2.5" in part and "mm rms" not in part


@pytest.mark.parametrize(
    ("network", "kind", "note", "absent"),
    [
        ("posenet", "tap", "taps", ("slides 400", "How alike", "Where the pins")),
        ("posenet_sheared", "sheared_learnt", LEARNT, ("taps 400", "less other networks")),
    ],
)
def test_of_one_kind_alone_poses_are_reported(report, network, kind, note, absent):
    _, results, text = report(networks=(network,), pairing="")
    assert f"{results['pose_mae'][kind]['z_mm']:.2f} mm {note}" in text
    tested, lesson = {"tap": ("taps", "taps")}.get(kind, ("slides", "labelled slides"))
    assert f"out of training: 24 {tested} (same session, random split)." in text
    assert f"that has only learned from {lesson}." in text
    for words in ("Recovery", "What it does", "How slides are paired", *absent):
        assert words not in text, words


def test_a_harmless_slide_leaves_no_recovery(tmp_path, read_report):
    results = make_run(tmp_path)
    for table in (results["pose_recovery"], results["spread"]["pose_recovery"]):
        for kind in ("disentangled", "unsheared"):
            table[kind]["y_mm"] = None
    assert "y none, as slides do no harm; z 0." in read_report(tmp_path, results)


def test_a_slide_of_unknown_length_is_shown_without_it(tmp_path, read_report):
    make_run(tmp_path)
    shown = dict(np.load(tmp_path / "montage.npz"))
    np.savez(tmp_path / "montage.npz", **shown | {"move": np.full_like(shown["move"], np.nan)})
    text = read_report(tmp_path)
    assert "nan" not in text.split("What it does")[1].split("alike")[0] and "recorded z " in text


def test_the_terminal_is_reported_in_a_few_lines(tmp_path, capsys):
    results = make_run(tmp_path)
    print_summary(convert_record(results, Results, "it", "again"), tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 12
    assert lines[0].split() == ["error", *SCALE]
    rows = {line.split()[0]: line.split()[1:] for line in lines}
    for row, table in (("unsheared", "pose_mae"), ("recovery", "pose_recovery")):
        values = results[table]["unsheared"].values()
        assert rows[row] == [f"{value:.3g}" for value in values]
    tested = "test, same session, random split: 24 taps, 24 slides"
    assert lines[-3] == f"{tested}; left out: 0 taps and 0 slides were not understood"
    assert "0.683 sheared, 0.979 unsheared" in lines[-2]
    assert lines[-1] == f"results: {tmp_path / 'results.json'}"
