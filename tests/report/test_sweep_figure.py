"""The picture of a sweep: which panels, which numbers where, and that it can be drawn."""

import io
import itertools

import numpy as np
import pytest
from PIL import Image

from jaxunshear.report.sweep_figure import collect_grid_values, plot_sweep, select_metrics
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
    cells = [
        cell(list(point), float(number)) for number, point in enumerate(itertools.product(*values))
    ]
    if failing:
        cells[-1] = cell(cells[-1]["point"], None)
    return {
        "sweep": "small",
        "reference": None,
        "seeds": [0, 1],
        "axes": [
            {"name": f"axis {number}", "fields": [], "values": value}
            for number, value in enumerate(values)
        ],
        "cells": [*cells, cell(None, 77.0)],
    }


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
