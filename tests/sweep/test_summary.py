"""The summary of rows whose scores are known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sweep import Sweep
from jaxunshear.files import to_builtins
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.sweep import Failure, Figure, Outcome, SweepResult
from jaxunshear.sweep.grid import find_reference, list_cells
from jaxunshear.sweep.scores import RowScores, compute_interval
from jaxunshear.sweep.summary import (
    compute_differences,
    compute_metrics,
    format_table,
    summarise,
    summarise_code_swaps,
)

SWEEP = Sweep(
    name="small",
    claim="none",
    base=Experiment(name="small", claim="none", networks=("disentangled",)),
    grid=(("train.losses.patch", (0.0, 0.1, 1.0)),),
    seeds=(0, 1),
)
POSES = np.arange(12) // 2
LABELS = {"stimulus": POSES % 3, "pose_id": POSES}
GROUPS = 6 * (POSES % 3) + POSES  # in the order of stimuli, then poses
NAME = "ms_ssim/disentangled"


def done(values: np.ndarray, **more) -> RowScores:
    outcome = {
        "status": "done",
        "reason": None,
        "results": {
            "metric": {"ms_ssim": "ms_ssim@4"},
            "settings": {
                "paired": {
                    "stimuli": ["disk", "clover", "teardrop"],
                    "tap_depth_jitter_mm": 0.0,
                    "ranges": {"depth_max_mm": 6.0},
                    "preprocess": {"size": 128},
                },
                "sensor": {"skin_mm": 1.0},
            },
            "tests": {"unseen": {"stimuli": ["flower", "leaf"], "tap_depth_jitter_mm": 0.0}},
            "pin_error": {"disentangled": {"rms_px": float(values[0]), "rms_mm": None}},
        },
        "ablation": [{"name": "DS(z_p,0)", "ssim": float(values[1]), "ssim interval": [0, 1]}],
        "train_seconds": {"disentangled": 50.0},
        "images_per_second": {"disentangled": 100.0},
        "ms_per_image": {"disentangled": {"median": 5.0, "p95": 6.0}},
        "wall_seconds": 99.0,
        "peak_memory_bytes": 2**30,
        "device": "cpu",
        "host": "here",
    }
    unseen = {NAME: 2 * values[:4], "stimulus": np.zeros(4, int), "pose_id": np.arange(4)}
    record = convert_record(outcome | more, Outcome, "row.json", "again")
    return RowScores(record, {"": {NAME: values} | LABELS, "unseen": unseen})


def failed(reason: str) -> RowScores:
    return RowScores(Outcome(status="failed", reason=reason), {})


def test_scores_that_only_a_newer_version_measured_are_left_out():
    old, new = done(random(0)), done(random(1))
    new.tests[""]["ms_ssim/unet"] = random(2)
    new.tests["depth_1mm"] = new.tests["unseen"]
    assert set(compute_metrics({0: new, 1: old})) == set(compute_metrics({0: old, 1: new}))
    assert not any("unet" in name or "depth" in name for name in compute_metrics({0: new, 1: old}))


def random(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random(12)


@pytest.fixture
def summary():
    cells = list_cells(SWEEP)
    rows = {}
    for number, cell in enumerate(cells):
        rows |= {(cell.label, seed): done(random(10 * number + seed)) for seed in (0, 1)}
    rows[cells[2].label, 1] = failed("killed by signal 9")
    return summarise(SWEEP, cells, rows, find_reference(SWEEP, cells))


def test_likeness_is_reported_for_every_shape_too(summary):
    found = summary.cells[0].metrics
    both = np.stack([random(0), random(1)])
    assert found[f"clover: {NAME}"].mean == pytest.approx(both[:, POSES % 3 == 1].mean())
    low, high = found[f"clover: {NAME}"].interval
    assert low < found[f"clover: {NAME}"].mean < high
    assert f"unseen, flower: {NAME}" in found
    assert f"unseen, leaf: {NAME}" not in found  # no contact with it


def test_recovery_is_of_the_means_with_an_interval_of_its_own():
    generator = np.random.default_rng(0)
    errors = {
        kind: generator.uniform(0.9, 1.1, (5, 12)) * size
        for kind, size in (("tap", 1), ("sheared", 5), ("unet", 2))
    }

    def recovered(errors):
        rows = {}
        for seed in range(5):
            scores = {f"pose/{kind}/x_mm": values[seed] for kind, values in errors.items()}
            rows[seed] = done(random(0))._replace(tests={"": scores | LABELS})
        return compute_metrics(rows)

    figure = recovered(errors)["pose_recovery/unet/x_mm"]
    tap, sheared, unet = (values.mean() for values in errors.values())
    assert figure.mean == pytest.approx((sheared - unet) / (sheared - tap))
    low, high = figure.interval
    assert low < figure.mean < high and high - low < 0.1
    assert set(figure.per_seed) == {"0", "1", "2", "3", "4"}
    tap, sheared, unet = (values[:, POSES % 3 == 1].mean() for values in errors.values())
    clover = recovered(errors)["clover: pose_recovery/unet/x_mm"]
    assert clover.mean == pytest.approx((sheared - unet) / (sheared - tap))
    assert "pose_recovery/sheared/x_mm" not in recovered(errors)
    harmless = errors | {"sheared": errors["tap"] / 2}  # no damage to undo
    assert "pose_recovery/unet/x_mm" not in recovered(harmless)


def test_edge_angles_are_also_given_where_the_edge_has_one_direction():
    name, smooth = "pose/tap/edge_deg", np.arange(12) < 7
    rows = {seed: done(random(0)) for seed in (0, 1)}
    errors = {seed: np.random.default_rng(seed).uniform(0, 9, 12) for seed in rows}

    def found(labels):
        return compute_metrics(
            {s: row._replace(tests={"": {name: errors[s]} | labels}) for s, row in rows.items()}
        )

    both = np.stack([errors[0], errors[1]])
    marked = found(LABELS | {"smooth": smooth})
    assert marked[f"smooth: {name}"].mean == pytest.approx(both[:, :7].mean())
    assert marked[name] == found(LABELS)[name] and f"smooth: {name}" not in found(LABELS)


def test_means_are_over_seeds_and_contacts_and_each_seed_is_reported(summary):
    figure = summary.cells[0].metrics[NAME]
    both = np.stack([random(0), random(1)])
    assert figure.mean == pytest.approx(both.mean())
    assert figure.per_seed == pytest.approx({"0": both[0].mean(), "1": both[1].mean()})
    assert figure.interval == compute_interval(both, GROUPS)
    unseen = summary.cells[0].metrics[f"unseen: {NAME}"]
    assert unseen.mean == pytest.approx(2 * both[:, :4].mean())
    assert unseen.interval == compute_interval(2 * both[:, :4], np.arange(4))
    plain = summary.cells[0].metrics["pin_error/disentangled/rms_px"]
    assert plain == Figure(both[:, 0].mean(), None, {"0": both[0, 0], "1": both[1, 0]})
    assert "pin_error/disentangled/rms_mm" not in summary.cells[0].metrics
    spoilt = summary.cells[0].ablation
    assert list(spoilt) == ["DS(z_p,0)/ssim"]
    assert spoilt["DS(z_p,0)/ssim"].mean == pytest.approx(both[:, 1].mean())


def test_differences_are_paired_over_the_seeds_that_both_have(summary):
    assert summary.reference == "patch=0.1" and summary.cells[1].difference == {}
    both = np.stack([random(0) - random(10), random(1) - random(11)])
    one = (random(20) - random(10))[None]
    for cell, pairs in ((summary.cells[0], both), (summary.cells[2], one)):
        expected = Figure(pytest.approx(pairs.mean()), compute_interval(pairs, GROUPS))
        assert cell.difference[NAME] == expected


def test_noise_that_two_cells_share_does_not_widen_their_difference():
    rows = {seed: done(random(seed)) for seed in (0, 1)}
    other = {seed: done(random(seed) - 0.5) for seed in (0, 1)}
    found = compute_differences(rows, other)[NAME]
    assert found.interval == pytest.approx([0.5, 0.5])


def test_other_test_contacts_have_no_difference():
    elsewhere = done(random(0))
    elsewhere.tests[""]["pose_id"] = POSES + 1
    assert list(compute_differences({0: done(random(0))}, {0: elsewhere})) == [f"unseen: {NAME}"]
    assert compute_differences({0: done(random(0))}, {1: done(random(0))}) == {}


def test_contacts_of_the_same_labels_drawn_from_other_settings_have_no_difference():
    for part, change in (
        ("paired", {"ranges": {"depth_max_mm": 3.0}}),
        ("sensor", {"skin_mm": 2.0}),
    ):
        elsewhere = done(random(1))
        elsewhere.outcome.results.settings[part].update(change)
        assert compute_differences({0: done(random(0))}, {0: elsewhere}) == {}


def test_a_further_test_is_compared_by_its_own_settings():
    jittered, others = done(random(1)), done(random(1))
    jittered.outcome.results.settings["paired"]["tap_depth_jitter_mm"] = 1.0  # of the main test
    unseen = others.outcome.results.tests
    unseen["unseen"] = replace(unseen["unseen"], stimuli=["leaf", "flower"])
    assert list(compute_differences({0: done(random(0))}, {0: jittered})) == [f"unseen: {NAME}"]
    assert list(compute_differences({0: done(random(0))}, {0: others})) == [NAME]


@pytest.mark.parametrize(
    "metric", [{"ms_ssim": "ms_ssim@5"}, {"ms_ssim": "ms_ssim@4", "image_px": 160}]
)
def test_poses_read_from_images_of_another_size_are_compared_and_their_likeness_is_not(metric):
    smaller, larger = done(random(0)), done(random(1))
    larger.outcome.results.metric.update(metric)
    larger.outcome.results.settings["paired"]["preprocess"] = {"size": 160}
    for row in (smaller, larger):
        row.tests[""] |= {"swap/DC(z_p)/mse": random(2), "pose/disentangled/x_mm": random(3)}
    assert list(compute_differences({0: smaller}, {0: larger})) == ["pose/disentangled/x_mm"]


def test_a_failure_is_reported_with_its_reason_and_the_other_seed_counts(summary):
    cell = summary.cells[2]
    assert cell.seeds == [0] and cell.failures == [Failure(1, "killed by signal 9")]
    assert cell.metrics[NAME].mean == pytest.approx(random(20).mean())
    assert list(cell.costs) == ["0"] and cell.costs["0"].peak_memory_bytes == 2**30


@pytest.mark.parametrize("rows", [(), ((), (("train.epochs", 2),))])
def test_nothing_done_is_a_summary_too(rows):
    sweep = replace(SWEEP, grid=(), rows=rows) if rows else SWEEP
    cells = list_cells(sweep)
    nothing = {(cell.label, seed): failed("no") for cell in cells for seed in (0, 1)}
    found = summarise(sweep, cells, nothing, find_reference(sweep, cells))
    assert all(cell.metrics == cell.difference == cell.ablation == {} for cell in found.cells)
    assert format_table(found).count("failed: ") == 2 * len(cells)


def test_it_is_json(summary):
    again = json.loads(json.dumps(to_builtins(summary)))
    assert again["axes"] == [
        {"name": "patch", "fields": ["train.losses.patch"], "values": ["0.0", "0.1", "1.0"]}
    ]
    assert again["networks"] == ["disentangled"] and again["base"]["networks"] == ["disentangled"]
    record = convert_record(again, SweepResult, "sweep.json", "again")
    assert record.cells[0].metrics == summary.cells[0].metrics


def test_a_seed_without_the_ablation_and_a_figure_that_one_seed_lacks_are_left_out():
    rows = {0: done(random(0)), 1: done(random(1), ablation=None)}
    assert list(summarise_code_swaps(rows)["DS(z_p,0)/ssim"].per_seed) == ["0"]
    lacking = done(random(1))
    lacking.outcome.results.pin_error["disentangled"]["rms_px"] = None
    assert "pin_error/disentangled/rms_px" not in compute_metrics({0: done(random(0)), 1: lacking})


def test_the_table_shows_figures_reference_and_failures(summary):
    lines = format_table(summary).splitlines()
    assert lines[0].split() == ["seeds", NAME, "training", "memory"]
    assert lines[2].startswith("patch=0.1 *") and "50 s" in lines[2] and "1.0 GiB" in lines[2]
    assert "1 of 2" in lines[3] and lines[-2] == "failed: patch=1.0, seed 1: killed by signal 9"
    assert lines[-1].endswith("--retry-failed tries them again")
    low, high = compute_interval(np.stack([random(0), random(1)]), GROUPS)
    assert f"[{low:.3g}, {high:.3g}]" in lines[1]
    assert "*" not in format_table(replace(summary, reference=None)).splitlines()[2]
    # nothing failed is nothing to try again
    assert "--retry-failed" not in format_table(replace(summary, cells=summary.cells[:2]))


def test_the_table_gives_which_settings_were_not_ranked_and_ranks_the_others():
    rows = ((), (("train.epochs", 9.0),), (("paired.slides", 8),))
    sweep = replace(SWEEP, grid=(), rows=rows, labels=("base", "longer", "more slides"), seeds=(0,))
    cells = list_cells(sweep)
    measured = {}
    for number, cell in enumerate(cells):
        seconds = {"disentangled": 10.0 + number}
        row = done(np.full(12, 0.5 + number / 10), train_seconds=seconds)
        measured[cell.label, 0] = row
    found = summarise(sweep, cells, measured, find_reference(sweep, cells))
    lines = format_table(found).splitlines()
    assert f"{NAME} against train_seconds: base < longer" in lines
    assert lines[-1] == "not ranked, tested on other contacts: more slides"


def test_intervals_say_what_they_are_over(summary):
    """One seed knows nothing of other trainings."""
    over, brackets = "training seeds and test poses", "brackets: 95 % intervals over"
    assert summary.spread["over"] == over and "seeds" in summary.spread["what"]
    assert f"{brackets} {over}" in format_table(summary).splitlines()
    sweep = replace(SWEEP, grid=(), rows=((),), labels=("base",), seeds=(0,))
    cells = list_cells(sweep)
    one = summarise(sweep, cells, {(cells[0].label, 0): done(random(0))}, None)
    over = "test poses of one training"
    assert one.spread["over"] == over and "seeds" not in one.spread["what"]
    assert f"{brackets} {over}" in format_table(one).splitlines()


def test_cells_of_different_networks():
    sweep = replace(SWEEP, grid=(("networks", (("disentangled",), ("unet",))),), seeds=(0,))
    cells = list_cells(sweep)
    assert [cell.label for cell in cells] == ["networks=disentangled", "networks=unet"]
    other = done(random(1))
    other = other._replace(tests={"": {"ms_ssim/unet": random(1)} | LABELS})
    rows = {(cells[0].label, 0): done(random(0)), (cells[1].label, 0): other}
    found = summarise(sweep, cells, rows, cells[0].label)
    assert found.networks == ["disentangled", "unet"]
    assert not any(name.startswith("ms_ssim") for name in found.cells[1].difference)
    assert "-" in format_table(found).splitlines()[1].split()
