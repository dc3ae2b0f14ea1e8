"""The picture of a sweep: which panels, which numbers where, and that it can be drawn."""

import io
import itertools
from copy import deepcopy

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from jaxunshear.report.sweep_figures import (
    ERRORS,
    collect_grid_values,
    collect_points,
    find_frontier,
    list_efficient,
    plot_frontier,
    plot_panel,
    plot_sweep,
    select_metrics,
)
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.sweep import SweepResult


def figure(mean: float) -> dict:
    seeds = {"0": mean - 0.02, "1": mean + 0.02}
    return {"mean": mean, "interval": [mean - 0.1, mean + 0.1], "per_seed": seeds}


def cell(point, mean: float | None) -> dict:
    made = {"label": "a cell", "point": point}
    if mean is None:
        return made | {"failures": [{"seed": 0, "reason": "supervised not finite"}]}
    names = ("ms_ssim/disentangled", "pose/disentangled/edge_mm", "swap/DS(z_p,z_s)/mse")
    metrics = {name: figure(mean + n) for n, name in enumerate(names)}
    metrics |= {"ms_ssim/sheared": figure(0.5), "contact/other": figure(mean)}
    ablation = {"DS(z_p,0)/ssim": {"mean": mean, "interval": None, "per_seed": {"0": mean}}}
    return made | {"seeds": [0, 1], "metrics": metrics, "ablation": ablation}


def summary(axes: int, failing: bool = True) -> dict:
    """Cells 0, 1, 2, ... over a grid, the last one failed; and a row beside it."""
    values = (["0.0", "0.1", "1.0"], ["8:120", "64:64"])[:axes]
    points = enumerate(itertools.product(*values))
    cells = [cell(list(point), float(number)) for number, point in points]
    if failing:
        cells[-1] = cell(cells[-1]["point"], None)
    cells.append(cell(None, 77.0))
    grid = []
    for number, value in enumerate(values):
        grid.append({"name": f"axis {number}", "fields": [], "values": value})
    made = {"sweep": "small", "reference": None, "seeds": [0, 1]}
    return made | {"axes": grid, "cells": cells}


def record(made):
    return convert_record(made, SweepResult, "made up", "again")


def test_metrics_that_differ_between_cells_are_shown_in_order():
    assert select_metrics(record(summary(2))) == [
        "ms_ssim/disentangled",
        "pose/disentangled/edge_mm",
        "swap/DS(z_p,z_s)/mse",
        "ablation/DS(z_p,0)/ssim",
    ]


def test_means_lie_where_their_cell_is():
    values = collect_grid_values(record(summary(2)), "ms_ssim/disentangled")
    np.testing.assert_array_equal(values, [[0, 1], [2, 3], [4, np.nan]])


@pytest.mark.parametrize("axes", [1, 2])
def test_it_can_be_drawn_and_the_same_again(axes):
    picture = plot_sweep(record(summary(axes)))
    assert picture is not None and picture == plot_sweep(record(summary(axes)))
    assert np.asarray(Image.open(io.BytesIO(picture)).convert("L")).std() > 10
    assert picture != plot_sweep(record(summary(axes, failing=False)))


def test_no_axis_or_nothing_done_is_no_picture():
    assert plot_sweep(record(summary(0))) is None
    nothing = summary(2)
    for each in nothing["cells"]:
        each |= {"seeds": [], "metrics": {}, "ablation": {}}
    assert plot_sweep(record(nothing)) is None


def list_summary(settings, seeds=("0", "1")):
    """Make a summary from (label, seconds, ms, error) of each cell; likeness is 1 - error."""
    cells = []
    for label, seconds, ms, error in settings:
        metrics = {}
        for name, (_, more) in ERRORS.items():
            metrics[name] = {"mean": 1 - error if more else error, "interval": None}
        cost = {"train_seconds": {"disentangled": seconds}}
        cost |= {"ms_per_image": {"disentangled": {"median": ms, "p95": ms}}}
        cell = {"label": label, "point": None, "settings": {"unshear.size": label}}
        cell |= {"metric": {"ms_ssim": "ms_ssim@4"}, "metrics": metrics}
        cells.append(cell | {"costs": {seed: deepcopy(cost) for seed in seeds}})
    return {"sweep": "frontier", "seeds": [0, 1], "reference": None, "cells": cells}


FOUR = [("small", 10, 2, 0.4), ("middling", 100, 4, 0.3)]
FOUR += [("wasteful", 200, 3, 0.35), ("large", 400, 9, 0.1)]
LIKENESS, EDGE = "ms_ssim/disentangled", "pose/disentangled/edge_mm"


def test_only_what_nothing_beats_is_on_the_frontier():
    assert find_frontier([1, 2, 3, 4], [4, 2, 3, 1]) == [0, 1, 3]
    assert find_frontier([1, 1, 2], [3, 2, 2]) == [1]  # as dear and better; dearer and no better
    assert find_frontier([], []) == []
    generator = np.random.default_rng(0)
    cost, error = generator.random((2, 200))
    on = find_frontier(cost, error)
    beaten = [(cost < cost[i]) & (error < error[i]) for i in range(200)]
    assert sorted(on) == [i for i in range(200) if not beaten[i].any()]


def test_the_frontier_is_named_by_metric_and_cost():
    found = list_efficient(record(list_summary(FOUR)))
    for metric in ERRORS:
        assert found[metric]["train_seconds"] == ["small", "middling", "large"]
        assert found[metric]["ms_per_image"] == ["small", "wasteful", "middling", "large"]


def test_costs_are_means_over_seeds_and_cells_without_figures_are_left_out():
    made = list_summary(FOUR)
    made["cells"][0]["costs"]["1"]["train_seconds"]["disentangled"] = 30
    made["cells"][1]["metrics"] = {}
    made["cells"][2]["costs"] = {}  # it failed
    labels, cost, _ = collect_points(record(made), EDGE, "train_seconds")
    assert labels == ["small", "large"]
    assert cost == pytest.approx([20, 400])


@pytest.mark.parametrize("reference", ["small", None])
def test_a_reference_without_figures_stops_nothing(reference):
    found = list_summary(FOUR[:2])
    found["reference"] = reference
    found["cells"][0] |= {"metrics": {}, "metric": {}}
    assert list_efficient(record(found))[LIKENESS]["train_seconds"] == ["middling"]
    found["cells"][1] |= {"metrics": {}, "metric": {}}
    assert set(list_efficient(record(found))) == set(ERRORS)
    assert plot_frontier(record(found)) is None


def test_a_taught_network_took_the_time_of_its_teacher_too():
    found = list_summary(FOUR[:2])
    before = collect_points(record(found), LIKENESS, "train_seconds").cost
    for costs in found["cells"][1]["costs"].values():
        costs["train_seconds"]["posenet_teacher"] = 30.0
    after = collect_points(record(found), LIKENESS, "train_seconds").cost
    np.testing.assert_allclose(after - before, [0, 30])


def test_likeness_of_other_scales_is_not_compared():
    made = list_summary(FOUR)
    made["cells"][3]["metric"] = {"ms_ssim": "ms_ssim@5"}
    found = collect_points(record(made), LIKENESS, "train_seconds")
    assert found.labels == ["small", "middling", "wasteful"]
    assert len(collect_points(record(made), EDGE, "train_seconds").labels) == 4
    found = collect_points(record(made | {"reference": "large"}), LIKENESS, "train_seconds")
    assert found.labels == ["large"]


@pytest.mark.parametrize(
    "changed", ["paired.slides", "paired.ranges.move_mm", "paired.camera.mm_across", "sensor"]
)
def test_cells_with_another_test_than_the_reference_are_not_ranked(changed):
    made = list_summary(FOUR)
    made["cells"][3]["settings"][changed] = "another"
    efficient = list_efficient(record(made))
    others = list_efficient(record(made | {"reference": "large"}))
    for metric in ERRORS:
        assert efficient[metric]["train_seconds"] == ["small", "middling"]
        assert efficient[metric]["ms_per_image"] == ["small", "wasteful", "middling"]
        assert others[metric]["train_seconds"] == ["large"]


def test_images_of_another_size_are_ranked_by_their_errors_in_mm():
    made = list_summary(FOUR)
    made["cells"][3]["settings"]["paired.preprocess.size"] = "256"
    assert list_efficient(record(made)) == list_efficient(record(list_summary(FOUR)))


def test_what_is_not_ranked_is_drawn_hollow_and_not_joined():
    made = list_summary(FOUR)
    made["cells"][3]["settings"]["paired.slides"] = "8"
    axes = Figure().subplots()
    labels = {label: label for label, *_ in FOUR}
    plot_panel(axes, record(made), EDGE, "train_seconds", labels)
    assert axes.lines[0].get_xdata().tolist() == [10, 100]
    patches = {text.get_text(): text.get_bbox_patch() for text in axes.texts}
    colours = {label: to_hex(patch.get_facecolor()) for label, patch in patches.items()}
    assert colours["large"] == "#ffffff" and len(colours) == 4
    assert "#ffffff" not in [colours[label] for label in ("small", "middling", "wasteful")]


def test_a_picture_is_drawn_where_there_is_something_to_draw():
    assert plot_frontier(record(list_summary(FOUR))).startswith(b"\x89PNG")
    assert plot_frontier(record(list_summary(FOUR[:1]))) is None


@pytest.mark.parametrize(("setting", "ms"), [("train.epochs", [5, 5]), ("unshear.widths", [3, 9])])
def test_cells_of_one_network_take_equally_long_for_an_image(setting, ms):
    """Neither does training decide, as other widths and sizes do."""
    made = list_summary(FOUR)
    for cell in made["cells"]:
        cell["settings"] = {}
    made["cells"][3]["settings"] = {setting: "8"}
    made["cells"][2]["settings"] = {"unshear.size": "16"}
    found = collect_points(record(made), EDGE, "ms_per_image")
    assert found.cost.tolist() == pytest.approx([ms[0], ms[0], 3, ms[1]])
