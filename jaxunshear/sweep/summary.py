"""From the rows of a sweep to one figure a cell, its interval, and its difference from a reference: pure functions."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import replace

import numpy as np

from jaxunshear.config.experiment import get_recorded
from jaxunshear.config.fields import format_value
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import Sweep, get_base, list_fields
from jaxunshear.evaluation import bootstrap
from jaxunshear.report.frontier_figure import list_efficient
from jaxunshear.results.sweep import CellResult, Costs, Failure, Figure, GridAxis, SweepResult
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

TABLES = (
    "pin_error",
    "half_width",
    "coverage",
)  # of a run's results: figures that are no means over contacts
TAP_TEST = "taps"  # the test of recorded taps, which are no pairs of the slides


def summarise(
    sweep: Sweep,
    cells: Sequence[Cell],
    measured: Mapping[tuple[str, int], RowScores],
    reference: str | None,
) -> SweepResult:
    """sweep.json, but for command, machines, versions and sources. `measured` by (label of the cell, seed), for all of them."""
    done = {
        cell.label: {
            seed: row
            for seed in sweep.seeds
            if (row := measured[cell.label, seed]).outcome.status == "done"
        }
        for cell in cells
    }
    summary = SweepResult(
        sweep=sweep.name,
        claim=sweep.claim,
        simulated=get_recorded(sweep.base) is None,
        axes=[
            GridAxis(
                format_field_name(axis[0], sweep), list_fields(axis[0]), list_axis_values(axis)
            )
            for axis in sweep.grid
        ],
        seeds=sweep.seeds,
        networks=list(
            dict.fromkeys(network for cell in cells for network in cell.experiment.networks)
        ),
        spread=describe_intervals(len(sweep.seeds)),
        reference=reference,
        cells=[_cell(cell, sweep, measured, done, reference) for cell in cells],
        base=to_json(get_base(sweep)),
    )
    return summary if sweep.grid else replace(summary, efficient=list_efficient(summary))


def select_reproducible(summary: SweepResult) -> SweepResult:
    """What must come out equal, bit for bit, from the same sweep on the same machine: all but times, memory and places."""
    cells = [replace(cell, costs={}) for cell in summary.cells]
    return replace(
        summary, cells=cells, command="", machines=(), trained_on=(), sources=(), efficient={}
    )


def _cell(
    cell: Cell,
    sweep: Sweep,
    measured: Mapping[tuple[str, int], RowScores],
    done: Mapping[str, Mapping[int, RowScores]],
    reference: str | None,
) -> CellResult:
    rows = done[cell.label]
    other = done[reference] if reference is not None else {}
    ended = {seed: measured[cell.label, seed].outcome for seed in sweep.seeds}
    return CellResult(
        label=cell.label,
        point=cell.point,
        settings={
            name: format_value(part)
            for fields, value in cell.changes
            for name, part in split_change(fields, value)
        },
        seeds=list(rows),
        metric=get_metric_notes(rows),
        metrics=compute_metrics(rows),
        difference=compute_differences(rows, other) if cell.label != reference else {},
        ablation=summarise_code_swaps(rows),
        failures=[
            Failure(seed, outcome.reason)
            for seed, outcome in ended.items()
            if outcome.status != "done"
        ],
        costs={
            str(seed): Costs(
                **{each.name: getattr(row.outcome, each.name) for each in dataclass_fields(Costs)}
            )
            for seed, row in rows.items()
        },
    )


def compute_metrics(rows: Mapping[int, RowScores]) -> dict[str, Figure]:
    """By metric: `mean` over seeds and contacts, its `compute_interval`, and the mean of every seed; figures of `TABLES` without one.

    Those of further tests are called `<test>: <metric>`, likeness on one shape `<shape>: ms_ssim/<kind>`, edge angles where the
    nearest edge has one direction `smooth: pose/<kind>/edge_deg`.
    """
    found = {}
    for test, name in list_score_names(rows):
        values, poses = stack_seeds(rows, test, name), number_contact_poses(rows, test)
        found[format_name(test, name)] = _figure(rows, values, poses)
        for shape, inside in select_parts(rows, test, name).items():
            found[format_name(test, name, shape)] = _figure(rows, values[:, inside], poses[inside])
    found |= compute_recoveries(rows)
    plain = {
        seed: {
            f"{name}/{kind}/{column}": value
            for name in TABLES
            for kind, columns in (getattr(row.outcome.evaluated_results, name) or {}).items()
            for column, value in columns.items()
            if value is not None
        }
        for seed, row in rows.items()
    }
    return found | _over_seeds(plain)


def select_parts(rows: Mapping[int, RowScores], test: str, name: str) -> dict[str, np.ndarray]:
    """Give the parts of a test (N,) that the metric `name` is also given of."""
    if name.startswith("ms_ssim/"):
        return select_by_shape(rows, test)
    return (
        select_smooth(rows, test) if name.startswith("pose/") and name.endswith("/edge_deg") else {}
    )


def _figure(rows: Mapping[int, RowScores], values: np.ndarray, poses: np.ndarray) -> Figure:
    """Of values (seeds, N) at poses (N,)."""
    by_seed = {str(seed): float(mean) for seed, mean in zip(rows, values.mean(axis=1), strict=True)}
    return Figure(float(values.mean()), compute_interval(values, poses), by_seed)


def compute_recoveries(rows: Mapping[int, RowScores]) -> dict[str, Figure]:
    """`pose_recovery/<kind>/<quantity>`: (sheared - unsheared) / (sheared - tap) of the mean errors, and its interval; on one shape
    `<shape>: ...`.

    Left out where the slide does no damage; without an interval where it does none in some of the resamples.
    """
    found: dict[str, Figure] = {}
    names = dict.fromkeys(list_score_names(rows))
    for test, name in names:
        errors = collect_recovery_errors(rows, names, test, name)
        if errors is None:
            continue
        own = name.replace("pose/", "pose_recovery/", 1)
        figure = _recovery(list(rows), [(values, poses) for _, values, poses in errors])
        found |= {format_name(test, own): figure} if figure else {}
        for shape, inside in select_by_shape(rows, test).items() if errors[0][0] == test else ():
            figure = _recovery(
                list(rows), [(values[:, inside], poses[inside]) for _, values, poses in errors]
            )
            found |= {format_name(test, own, shape): figure} if figure else {}
    return found


def collect_recovery_errors(
    rows: Mapping[int, RowScores], names: Container[tuple[str, str]], test: str, name: str
) -> list[tuple[str, np.ndarray, np.ndarray]] | None:
    """Of tap, sheared and the kind that `pose/<kind>/<quantity>` names: the test, errors (seeds, N), and their poses (N,). None where one
    of them is not among `names`, or the name is of no kind that is unsheared."""
    table, kind, *quantity = name.split("/")
    if table != "pose" or kind in ("tap", "sheared"):
        return None
    tap, sheared = (f"pose/{other}/{'/'.join(quantity)}" for other in ("tap", "sheared"))
    of_taps = next((where for where in (test, TAP_TEST) if (where, tap) in names), None)
    if of_taps is None or (test, sheared) not in names:
        return None
    return [
        (where, stack_seeds(rows, where, each), number_contact_poses(rows, where))
        for where, each in ((of_taps, tap), (test, sheared), (test, name))
    ]


def _recovery(
    seeds: Sequence[int], errors: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Figure | None:
    """Of errors of tap, sheared and unsheared, (seeds, N) at poses (N,) each; None where the slide does no damage."""
    tap, sheared, unsheared = (values.mean() for values, _ in errors)
    if sheared <= tap:
        return None
    redrawn = resample_recovery(errors)
    by_seed = zip(*(values.mean(axis=1) for values, _ in errors), strict=True)
    return Figure(
        float((sheared - unsheared) / (sheared - tap)),
        None if redrawn is None else bootstrap.compute_interval(redrawn),
        {
            str(seed): float((row[1] - row[2]) / (row[1] - row[0])) if row[1] > row[0] else None
            for seed, row in zip(seeds, by_seed, strict=True)
        },
    )


def resample_recovery(errors: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray | None:
    """The recovery in each of the resamples; None where the slide does no damage in some of them, as it then has no bounds."""
    tap, sheared, unsheared = (resample_means(values, poses) for values, poses in errors)
    return (sheared - unsheared) / (sheared - tap) if np.all(sheared > tap) else None


def compute_differences(
    rows: Mapping[int, RowScores], other: Mapping[int, RowScores]
) -> dict[str, Figure]:
    """By metric that both have: `mean` and `compute_interval` of this less the other, over the seeds that both have.

    Empty where there is no such seed, or the test contacts are not the same. Likeness of images of different sizes is not compared.
    """
    common = [seed for seed in rows if seed in other]
    rows, other = ({seed: cell[seed] for seed in common} for cell in (rows, other))
    found = {}
    one_size = all(
        get_metric_notes(rows).get(name) == get_metric_notes(other).get(name)
        for name in ("ms_ssim", "image_px")
    )
    for test, name in list_score_names(rows):
        if ("ms_ssim" in name or name.startswith("swap/")) and not one_size:
            continue
        if (test, name) in list_score_names(other) and has_same_contacts(rows, other, test):
            values = stack_seeds(rows, test, name) - stack_seeds(other, test, name)
            found[format_name(test, name)] = Figure(
                float(values.mean()), compute_interval(values, number_contact_poses(rows, test))
            )
    return found


def summarise_code_swaps(rows: Mapping[int, RowScores]) -> dict[str, Figure]:
    """`<cell of the codes>/<metric>`: mean over seeds and each seed's; empty where it was not asked for."""
    plain = {
        seed: {
            f"{line['name']}/{name}": value
            for line in row.outcome.ablation
            for name, value in line.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
        for seed, row in rows.items()
        if row.outcome.ablation
    }
    return _over_seeds(plain)


def _over_seeds(plain: Mapping[int, Mapping[str, float]]) -> dict[str, Figure]:
    """Figures that every seed has."""
    first, *more = plain.values() or [{}]
    names = [name for name in first if all(name in others for others in more)]
    return {
        name: Figure(
            float(np.mean([figures[name] for figures in plain.values()])),
            None,
            {str(seed): figures[name] for seed, figures in plain.items()},
        )
        for name in names
    }
