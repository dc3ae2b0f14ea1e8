"""What is on the frontier, on points laid out by hand."""

from copy import deepcopy

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from jaxunshear.report.frontier_figure import (
    ERRORS,
    collect_points,
    find_frontier,
    list_efficient,
    plot_frontier,
    plot_panel,
)
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.sweep import SweepResult


def summary(settings, seeds=("0", "1")):
    """Make a summary from (label, seconds, ms, error) of each cell; likeness is 1 - error."""
    cells = []
    for label, seconds, ms, error in settings:
        metrics = {}
        for name, (_, more) in ERRORS.items():
            metrics[name] = {"mean": 1 - error if more else error, "interval": None}
        cost = {
            "train_seconds": {"disentangled": seconds},
            "ms_per_image": {"disentangled": {"median": ms, "p95": ms}},
        }
        cell = {"label": label, "point": None, "settings": {"unshear.size": label}}
        cell |= {"metric": {"ms_ssim": "ms_ssim@4"}, "metrics": metrics}
        cells.append(cell | {"costs": {seed: deepcopy(cost) for seed in seeds}})
    return {"sweep": "frontier", "seeds": [0, 1], "reference": None, "cells": cells}


def record(made):
    return convert_record(made, SweepResult, "made up", "again")


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
    found = list_efficient(record(summary(FOUR)))
    for metric in ERRORS:
        assert found[metric]["train_seconds"] == ["small", "middling", "large"]
        assert found[metric]["ms_per_image"] == ["small", "wasteful", "middling", "large"]


def test_costs_are_means_over_seeds_and_cells_without_figures_are_left_out():
    made = summary(FOUR)
    made["cells"][0]["costs"]["1"]["train_seconds"]["disentangled"] = 30
    made["cells"][1]["metrics"] = {}
    made["cells"][2]["costs"] = {}  # it failed
    labels, cost, _ = collect_points(record(made), EDGE, "train_seconds")
    assert labels == ["small", "large"]
    assert cost == pytest.approx([20, 400])


@pytest.mark.parametrize("reference", ["small", None])
def test_a_reference_without_figures_stops_nothing(reference):
    found = summary(FOUR[:2])
    found["reference"] = reference
    found["cells"][0] |= {"metrics": {}, "metric": {}}
    assert list_efficient(record(found))[LIKENESS]["train_seconds"] == ["middling"]
    found["cells"][1] |= {"metrics": {}, "metric": {}}
    assert (
        set(list_efficient(record(found))) == set(ERRORS) and plot_frontier(record(found)) is None
    )


def test_a_taught_network_took_the_time_of_its_teacher_too():
    found = summary(FOUR[:2])
    before = collect_points(record(found), LIKENESS, "train_seconds")[1]
    for costs in found["cells"][1]["costs"].values():
        costs["train_seconds"]["posenet_teacher"] = 30.0
    np.testing.assert_allclose(
        collect_points(record(found), LIKENESS, "train_seconds")[1] - before, [0, 30]
    )


def test_likeness_of_other_scales_is_not_compared():
    made = summary(FOUR)
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
    made = summary(FOUR)
    made["cells"][3]["settings"][changed] = "another"
    efficient = list_efficient(record(made))
    others = list_efficient(record(made | {"reference": "large"}))
    for metric in ERRORS:
        assert efficient[metric]["train_seconds"] == ["small", "middling"]
        assert efficient[metric]["ms_per_image"] == ["small", "wasteful", "middling"]
        assert others[metric]["train_seconds"] == ["large"]


def test_images_of_another_size_are_ranked_by_their_errors_in_mm():
    made = summary(FOUR)
    made["cells"][3]["settings"]["paired.preprocess.size"] = "256"
    assert list_efficient(record(made)) == list_efficient(record(summary(FOUR)))


def test_what_is_not_ranked_is_drawn_hollow_and_not_joined():
    made = summary(FOUR)
    made["cells"][3]["settings"]["paired.slides"] = "8"
    axes = Figure().subplots()
    labels = {label: label for label, *_ in FOUR}
    plot_panel(axes, record(made), EDGE, "train_seconds", labels)
    assert axes.lines[0].get_xdata().tolist() == [10, 100]
    colours = {
        text.get_text(): to_hex(text.get_bbox_patch().get_facecolor()) for text in axes.texts
    }
    assert colours["large"] == "#ffffff" and len(colours) == 4
    assert "#ffffff" not in [colours[label] for label in ("small", "middling", "wasteful")]


def test_a_picture_is_drawn_where_there_is_something_to_draw():
    assert plot_frontier(record(summary(FOUR))).startswith(b"\x89PNG")
    assert plot_frontier(record(summary(FOUR[:1]))) is None


@pytest.mark.parametrize(("setting", "ms"), [("train.epochs", [5, 5]), ("unshear.widths", [3, 9])])
def test_cells_of_one_network_take_equally_long_for_an_image(setting, ms):
    """Neither does training decide, as other widths and sizes do."""
    made = summary(FOUR)
    for cell in made["cells"]:
        cell["settings"] = {}
    made["cells"][3]["settings"] = {setting: "8"}
    made["cells"][2]["settings"] = {"unshear.size": "16"}
    found = collect_points(record(made), EDGE, "ms_per_image")
    assert found.cost.tolist() == pytest.approx([ms[0], ms[0], 3, ms[1]])
