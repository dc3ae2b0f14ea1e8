"""From the rows of a sweep to one figure a cell, its interval, and its difference from a reference: pure functions."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import replace

import numpy as np

from jaxunshear.evaluation import bootstrap
from jaxunshear.report.frontier_figure import list_efficient
from jaxunshear.results.sweep import CellResult, Costs, Failure, Figure, GridAxis, SweepResult
from jaxunshear.settings.experiment import get_recorded
from jaxunshear.settings.fields import format_value
from jaxunshear.settings.serialization import to_json
from jaxunshear.settings.sweep import Sweep, get_base, list_fields
from jaxunshear.sweep.bootstrap import interval, resampled, spread_of
from jaxunshear.sweep.rows import Cell, axis_values, name_of, parts_of
from jaxunshear.sweep.scores import (
    Measured,
    called,
    metric_of,
    names_in,
    poses_of,
    same_contacts,
    shapes_of,
    smooth_of,
    stacked,
)

TABLES = (
    "pin_error",
    "half_width",
    "coverage",
)  # of a run's results: figures that are no means over contacts
TAPS = "taps"  # the test of recorded taps, which are no pairs of the slides


def summarise(
    sweep: Sweep,
    cells: Sequence[Cell],
    measured: Mapping[tuple[str, int], Measured],
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
            GridAxis(name_of(axis[0], sweep), list_fields(axis[0]), axis_values(axis))
            for axis in sweep.grid
        ],
        seeds=sweep.seeds,
        networks=list(
            dict.fromkeys(network for cell in cells for network in cell.experiment.networks)
        ),
        spread=spread_of(len(sweep.seeds)),
        reference=reference,
        cells=[_cell(cell, sweep, measured, done, reference) for cell in cells],
        base=to_json(get_base(sweep)),
    )
    return summary if sweep.grid else replace(summary, efficient=list_efficient(summary))


def reproducible(summary: SweepResult) -> SweepResult:
    """What must come out equal, bit for bit, from the same sweep on the same machine: all but times, memory and places."""
    cells = [replace(cell, costs={}) for cell in summary.cells]
    return replace(
        summary, cells=cells, command="", machines=(), trained_on=(), sources=(), efficient={}
    )


def _cell(
    cell: Cell,
    sweep: Sweep,
    measured: Mapping[tuple[str, int], Measured],
    done: Mapping[str, Mapping[int, Measured]],
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
            for name, part in parts_of(fields, value)
        },
        seeds=list(rows),
        metric=metric_of(rows),
        metrics=metrics(rows),
        difference=differences(rows, other) if cell.label != reference else {},
        ablation=ablation(rows),
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


def metrics(rows: Mapping[int, Measured]) -> dict[str, Figure]:
    """By metric: `mean` over seeds and contacts, its `interval`, and the mean of every seed; figures of `TABLES` without one.

    Those of further tests are called `<test>: <metric>`, likeness on one shape `<shape>: ms_ssim/<kind>`, edge angles where the
    nearest edge has one direction `smooth: pose/<kind>/edge_deg`.
    """
    found = {}
    for test, name in names_in(rows):
        values, poses = stacked(rows, test, name), poses_of(rows, test)
        found[called(test, name)] = _figure(rows, values, poses)
        for shape, inside in parts_in(rows, test, name).items():
            found[called(test, name, shape)] = _figure(rows, values[:, inside], poses[inside])
    found |= recoveries(rows)
    plain = {
        seed: {
            f"{name}/{kind}/{column}": value
            for name in TABLES
            for kind, columns in (getattr(row.outcome.evaluated, name) or {}).items()
            for column, value in columns.items()
            if value is not None
        }
        for seed, row in rows.items()
    }
    return found | _over_seeds(plain)


def parts_in(rows: Mapping[int, Measured], test: str, name: str) -> dict[str, np.ndarray]:
    """Give the parts of a test (N,) that the metric `name` is also given of."""
    if name.startswith("ms_ssim/"):
        return shapes_of(rows, test)
    return smooth_of(rows, test) if name.startswith("pose/") and name.endswith("/edge_deg") else {}


def _figure(rows: Mapping[int, Measured], values: np.ndarray, poses: np.ndarray) -> Figure:
    """Of values (seeds, N) at poses (N,)."""
    by_seed = {str(seed): float(mean) for seed, mean in zip(rows, values.mean(axis=1), strict=True)}
    return Figure(float(values.mean()), interval(values, poses), by_seed)


def recoveries(rows: Mapping[int, Measured]) -> dict[str, Figure]:
    """`pose_recovery/<kind>/<quantity>`: (sheared - unsheared) / (sheared - tap) of the mean errors, and its interval; on one shape
    `<shape>: ...`.

    Left out where the slide does no damage; without an interval where it does none in some of the resamples.
    """
    found: dict[str, Figure] = {}
    names = dict.fromkeys(names_in(rows))
    for test, name in names:
        errors = recovery_errors(rows, names, test, name)
        if errors is None:
            continue
        own = name.replace("pose/", "pose_recovery/", 1)
        figure = _recovery(list(rows), [(values, poses) for _, values, poses in errors])
        found |= {called(test, own): figure} if figure else {}
        for shape, inside in shapes_of(rows, test).items() if errors[0][0] == test else ():
            figure = _recovery(
                list(rows), [(values[:, inside], poses[inside]) for _, values, poses in errors]
            )
            found |= {called(test, own, shape): figure} if figure else {}
    return found


def recovery_errors(
    rows: Mapping[int, Measured], names: Container[tuple[str, str]], test: str, name: str
) -> list[tuple[str, np.ndarray, np.ndarray]] | None:
    """Of tap, sheared and the kind that `pose/<kind>/<quantity>` names: the test, errors (seeds, N), and their poses (N,). None where one
    of them is not among `names`, or the name is of no kind that is unsheared."""
    table, kind, *quantity = name.split("/")
    if table != "pose" or kind in ("tap", "sheared"):
        return None
    tap, sheared = (f"pose/{other}/{'/'.join(quantity)}" for other in ("tap", "sheared"))
    of_taps = next((where for where in (test, TAPS) if (where, tap) in names), None)
    if of_taps is None or (test, sheared) not in names:
        return None
    return [
        (where, stacked(rows, where, each), poses_of(rows, where))
        for where, each in ((of_taps, tap), (test, sheared), (test, name))
    ]


def _recovery(
    seeds: Sequence[int], errors: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Figure | None:
    """Of errors of tap, sheared and unsheared, (seeds, N) at poses (N,) each; None where the slide does no damage."""
    tap, sheared, unsheared = (values.mean() for values, _ in errors)
    if sheared <= tap:
        return None
    redrawn = redrawn_recovery(errors)
    by_seed = zip(*(values.mean(axis=1) for values, _ in errors), strict=True)
    return Figure(
        float((sheared - unsheared) / (sheared - tap)),
        None if redrawn is None else bootstrap.compute_interval(redrawn),
        {
            str(seed): float((row[1] - row[2]) / (row[1] - row[0])) if row[1] > row[0] else None
            for seed, row in zip(seeds, by_seed, strict=True)
        },
    )


def redrawn_recovery(errors: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray | None:
    """The recovery in each of the resamples; None where the slide does no damage in some of them, as it then has no bounds."""
    tap, sheared, unsheared = (resampled(values, poses) for values, poses in errors)
    return (sheared - unsheared) / (sheared - tap) if np.all(sheared > tap) else None


def differences(rows: Mapping[int, Measured], other: Mapping[int, Measured]) -> dict[str, Figure]:
    """By metric that both have: `mean` and `interval` of this less the other, over the seeds that both have.

    Empty where there is no such seed, or the test contacts are not the same. Likeness of images of different sizes is not compared.
    """
    common = [seed for seed in rows if seed in other]
    rows, other = ({seed: cell[seed] for seed in common} for cell in (rows, other))
    found = {}
    one_size = all(
        metric_of(rows).get(name) == metric_of(other).get(name) for name in ("ms_ssim", "image_px")
    )
    for test, name in names_in(rows):
        if ("ms_ssim" in name or name.startswith("swap/")) and not one_size:
            continue
        if (test, name) in names_in(other) and same_contacts(rows, other, test):
            values = stacked(rows, test, name) - stacked(other, test, name)
            found[called(test, name)] = Figure(
                float(values.mean()), interval(values, poses_of(rows, test))
            )
    return found


def ablation(rows: Mapping[int, Measured]) -> dict[str, Figure]:
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
