"""The summary of a sweep: figures of each cell, and differences from a reference."""

from collections.abc import Mapping, Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxunshear.config.fields import format_value
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import Sweep, get_base, list_fields
from jaxunshear.evaluation import intervals
from jaxunshear.report.frontier_figure import list_efficient
from jaxunshear.results.sweep import (
    CellResult,
    Costs,
    Failure,
    Figure,
    GridAxis,
    Outcome,
    SweepResult,
)
from jaxunshear.sweep.crossed_bootstrap import compute_interval, describe_intervals, resample_means
from jaxunshear.sweep.grid import Cell, format_field_name, list_axis_values, split_change
from jaxunshear.sweep.scores import (
    RowScores,
    format_name,
    get_metric_notes,
    has_same_contacts,
    list_score_names,
    number_contact_poses,
    select_by_shape,
    select_smooth,
    stack_seeds,
)

# tables of a run's results with figures that are no means over contacts
TABLES = ("pin_error", "half_width", "coverage")
TAP_TEST = "taps"  # the test of recorded taps, which are no pairs of the slides
Rows = Mapping[int, RowScores]  # of one cell, by seed; none of them failed
Parts = Mapping[str, np.ndarray]  # contacts (N,) bool by the name of the part


class ScoredErrors(NamedTuple):
    """Errors of one kind of contact in one quantity."""

    values: np.ndarray  # (seeds, N)
    poses: np.ndarray  # (N,), the pose of each contact


def summarise(
    sweep: Sweep,
    cells: Sequence[Cell],
    scores: Mapping[tuple[str, int], RowScores],
    reference: str | None,
) -> SweepResult:
    """Make the content of sweep.json, without command, machines, versions and sources.

    `scores` are by (label of the cell, seed), for all of them.
    """
    axes = []
    for axis in sweep.grid:
        fields = axis[0]
        name = format_field_name(fields, sweep)
        axes.append(GridAxis(name, list_fields(fields), list_axis_values(axis)))
    networks: dict[str, None] = {}
    for cell in cells:
        networks |= dict.fromkeys(cell.experiment.networks)
    reference_rows = {} if reference is None else _select_done(scores, reference, sweep.seeds)
    results = []
    for cell in cells:
        others = {} if cell.label == reference else reference_rows
        outcomes = {seed: scores[cell.label, seed].outcome for seed in sweep.seeds}
        rows = _select_done(scores, cell.label, sweep.seeds)
        results.append(_summarise_cell(cell, rows, outcomes, others))
    summary = SweepResult(
        sweep=sweep.name,
        claim=sweep.claim,
        simulated=sweep.base.paired.is_simulated,
        axes=axes,
        seeds=sweep.seeds,
        networks=list(networks),
        spread=describe_intervals(len(sweep.seeds)),
        reference=reference,
        cells=results,
        base=to_json(get_base(sweep)),
    )
    return summary if sweep.grid else replace(summary, efficient=list_efficient(summary))


def _select_done(
    scores: Mapping[tuple[str, int], RowScores], label: str, seeds: Sequence[int]
) -> dict[int, RowScores]:
    rows = {seed: scores[label, seed] for seed in seeds}
    return {seed: row for seed, row in rows.items() if row.outcome.status == "done"}


def select_reproducible(summary: SweepResult) -> SweepResult:
    """Select what the same sweep on the same machine repeats bit for bit.

    Times, memory and places are left out.
    """
    cells = [replace(cell, costs={}) for cell in summary.cells]
    return replace(
        summary, cells=cells, command="", machines=(), trained_on=(), sources=(), efficient={}
    )


def _summarise_cell(
    cell: Cell, rows: Rows, outcomes: Mapping[int, Outcome], reference: Rows
) -> CellResult:
    settings = {}
    for fields, value in cell.changes:
        for name, part in split_change(fields, value):
            settings[name] = format_value(part)
    failures = [
        Failure(seed, outcome.reason)
        for seed, outcome in outcomes.items()
        if outcome.status != "done"
    ]
    names, costs = [field.name for field in dataclass_fields(Costs)], {}
    for seed, row in rows.items():
        costs[str(seed)] = Costs(**{name: getattr(row.outcome, name) for name in names})
    return CellResult(
        label=cell.label,
        point=cell.point,
        settings=settings,
        seeds=list(rows),
        metric=get_metric_notes(rows),
        metrics=compute_metrics(rows),
        difference=compute_differences(rows, reference),
        ablation=summarise_code_swaps(rows),
        failures=failures,
        costs=costs,
    )


def compute_metrics(rows: Rows) -> dict[str, Figure]:
    """Compute the mean of each metric over seeds and contacts, with its interval.

    Metrics of further tests are called `<test>: <metric>`, likeness on one shape
    `<shape>: ms_ssim/<kind>`, and errors of unambiguous edge angles
    `smooth: pose/<kind>/edge_deg`. Figures of `TABLES` have no interval.
    """
    figures = {}
    for test, name in list_score_names(rows):
        values, poses = stack_seeds(rows, test, name), number_contact_poses(rows, test)
        figures[format_name(test, name)] = _make_figure(rows, values, poses)
        for part, contacts in _select_parts(rows, test, name).items():
            figure = _make_figure(rows, values[:, contacts], poses[contacts])
            figures[format_name(test, name, part)] = figure
    figures |= _compute_recoveries(rows)
    return figures | _average_over_seeds({seed: _list_table(row) for seed, row in rows.items()})


def _select_parts(rows: Rows, test: str, name: str) -> Parts:
    """Select the parts of a test for which the metric `name` is also computed."""
    if name.startswith("ms_ssim/"):
        return select_by_shape(rows, test)
    if name.startswith("pose/") and name.endswith("/edge_deg"):
        return select_smooth(rows, test)
    return {}


def _make_figure(rows: Rows, values: np.ndarray, poses: np.ndarray) -> Figure:
    by_seed = {str(seed): float(mean) for seed, mean in zip(rows, values.mean(axis=1), strict=True)}
    return Figure(float(values.mean()), compute_interval(values, poses), by_seed)


def _list_table(row: RowScores) -> dict[str, float]:
    figures = {}
    for name in TABLES:
        table = getattr(row.outcome.evaluated_results, name) or {}
        for kind, columns in table.items():
            for column, value in columns.items():
                if value is not None:
                    figures[f"{name}/{kind}/{column}"] = value
    return figures


def _compute_recoveries(rows: Rows) -> dict[str, Figure]:
    """Compute the recoveries of all metrics that have one, overall and on each shape.

    They are called `pose_recovery/<kind>/<quantity>`. Only errors on unsheared contacts of a test
    that also has taps and sheared contacts have one.
    """
    figures: dict[str, Figure] = {}
    names = dict.fromkeys(list_score_names(rows))
    for test, name in names:
        table, kind, *quantity = name.split("/")
        if table != "pose" or kind in ("tap", "sheared"):
            continue
        tap, sheared = "/".join(["pose/tap", *quantity]), "/".join(["pose/sheared", *quantity])
        tap_test = next((each for each in (test, TAP_TEST) if (each, tap) in names), None)
        if tap_test is None or (test, sheared) not in names:
            continue
        errors = [
            ScoredErrors(stack_seeds(rows, each, score), number_contact_poses(rows, each))
            for each, score in ((tap_test, tap), (test, sheared), (test, name))
        ]
        parts: dict[str, np.ndarray | slice] = {"": slice(None)}
        if tap_test == test:
            parts |= select_by_shape(rows, test)
        recovery_name = name.replace("pose/", "pose_recovery/", 1)
        for shape, contacts in parts.items():
            part = [ScoredErrors(each.values[:, contacts], each.poses[contacts]) for each in errors]
            if figure := _compute_recovery(list(rows), part):
                figures[format_name(test, recovery_name, shape)] = figure
    return figures


def _compute_recovery(seeds: Sequence[int], errors: Sequence[ScoredErrors]) -> Figure | None:
    """Compute (sheared - unsheared) / (sheared - tap) of mean errors, with its interval.

    `errors` are those on taps, sheared and unsheared contacts. Returns None if the slide does no
    damage. There is no interval if it does none in some of the resamples, as the recovery then has
    no bounds.
    """
    tap, sheared, unsheared = [each.values.mean() for each in errors]
    if sheared <= tap:
        return None
    by_seed: dict[str, float | None] = {}
    means = np.stack([each.values.mean(axis=1) for each in errors], axis=1)
    for seed, row in zip(seeds, means, strict=True):
        recovery = float((row[1] - row[2]) / (row[1] - row[0])) if row[1] > row[0] else None
        by_seed[str(seed)] = recovery
    taps, slides, outputs = [resample_means(each.values, each.poses) for each in errors]
    interval = None
    if np.all(slides > taps):
        interval = intervals.compute_interval((slides - outputs) / (slides - taps))
    return Figure(float((sheared - unsheared) / (sheared - tap)), interval, by_seed)


def compute_differences(rows: Rows, other: Rows) -> dict[str, Figure]:
    """Compute the mean of each metric less that of `other`, with its interval.

    It is over the seeds that both have; empty if there is none, or if the test contacts are not
    the same. Likeness of images of different sizes is not compared.
    """
    common = [seed for seed in rows if seed in other]
    rows, other = {seed: rows[seed] for seed in common}, {seed: other[seed] for seed in common}
    notes, other_notes = get_metric_notes(rows), get_metric_notes(other)
    same_images = all(notes.get(key) == other_notes.get(key) for key in ("ms_ssim", "image_px"))
    figures = {}
    for test, name in list_score_names(rows):
        if ("ms_ssim" in name or name.startswith("swap/")) and not same_images:
            continue
        if (test, name) in list_score_names(other) and has_same_contacts(rows, other, test):
            values = stack_seeds(rows, test, name) - stack_seeds(other, test, name)
            interval = compute_interval(values, number_contact_poses(rows, test))
            figures[format_name(test, name)] = Figure(float(values.mean()), interval)
    return figures


def summarise_code_swaps(rows: Rows) -> dict[str, Figure]:
    """Summarise code swaps as `<cell of the codes>/<metric>`; empty if none were measured."""
    by_seed = {}
    for seed, row in rows.items():
        figures = {}
        for line in row.outcome.ablation or ():
            for name, value in line.items():
                if isinstance(value, int | float) and not isinstance(value, bool):
                    figures[f"{line['name']}/{name}"] = value
        if row.outcome.ablation:
            by_seed[seed] = figures
    return _average_over_seeds(by_seed)


def _average_over_seeds(by_seed: Mapping[int, Mapping[str, float]]) -> dict[str, Figure]:
    """Average the figures that every seed has; they have no interval."""
    averages = {}
    for name in next(iter(by_seed.values()), {}):
        if all(name in figures for figures in by_seed.values()):
            values = {str(seed): figures[name] for seed, figures in by_seed.items()}
            averages[name] = Figure(float(np.mean(list(values.values()))), None, values)
    return averages
