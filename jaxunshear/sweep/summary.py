"""From the rows of a sweep to one figure a cell, its interval, and its difference from a reference: pure functions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.evaluation import spread
from jaxunshear.report.frontier_figure import efficient
from jaxunshear.settings.experiment import recorded_of
from jaxunshear.settings.fields import show
from jaxunshear.settings.stored import to_json
from jaxunshear.settings.sweep import Sweep, base_of, names_of
from jaxunshear.sweep.bootstrap import interval, resampled, spread_of
from jaxunshear.sweep.rows import Cell, axis_values, name_of

TABLES = ("pin_error", "half_width", "coverage")  # of a run's results: figures that are no means over contacts
# of the paired data: names, how contacts appear, what is made of recorded ones
NOT_CONTACTS = (
    "config",
    "camera",
    "nuisance",
    "preprocess",
    "pairing",
    "pairs",
    "labelled",
    "tap_folder",
    "slide_folder",
)
TAPS = "taps"  # the test of recorded taps, which are no pairs of the slides
COSTS = ("train_seconds", "images_per_second", "ms_per_image", "wall_seconds", "peak_memory_bytes", "device", "host")


class Measured(NamedTuple):
    """A row that has ended: its outcome, and the scores of every test contact where it did not fail.

    `tests` is by test, "" for the main one: arrays (N,) by the names of the scores, which have a slash; `stimulus` and `pose_id`.
    """

    outcome: dict[str, Any]
    tests: Mapping[str, Mapping[str, np.ndarray]]


def summarise(
    sweep: Sweep, cells: Sequence[Cell], measured: Mapping[tuple[str, int], Measured], reference: str | None
) -> dict[str, Any]:
    """sweep.json, but for command and versions. `measured` by (label of the cell, seed), for all of them."""
    done = {
        cell.label: {
            seed: row for seed in sweep.seeds if (row := measured[cell.label, seed]).outcome["status"] == "done"
        }
        for cell in cells
    }
    summary = {
        "sweep": sweep.name,
        "claim": sweep.claim,
        "simulated": recorded_of(sweep.base) is None,
        "axes": [
            {"name": name_of(axis[0], sweep), "fields": names_of(axis[0]), "values": axis_values(axis)}
            for axis in sweep.grid
        ],
        "seeds": sweep.seeds,
        "networks": list(dict.fromkeys(network for cell in cells for network in cell.experiment.networks)),
        "spread": spread_of(len(sweep.seeds)),
        "reference": reference,
        "cells": [_cell(cell, sweep, measured, done, reference) for cell in cells],
        "base": to_json(base_of(sweep)),
    }
    return summary | {"efficient": {} if sweep.grid else efficient(summary)}


def reproducible(summary: dict[str, Any]) -> dict[str, Any]:
    """What must come out equal, bit for bit, from the same sweep on the same machine: all but times, memory and places."""
    cells = [{name: value for name, value in cell.items() if name != "costs"} for cell in summary["cells"]]
    return {
        name: value for name, value in summary.items() if name not in ("command", "machines", "trained_on", "efficient")
    } | {"cells": cells}


def _cell(
    cell: Cell,
    sweep: Sweep,
    measured: Mapping[tuple[str, int], Measured],
    done: Mapping[str, Mapping[int, Measured]],
    reference: str | None,
) -> dict[str, Any]:
    rows = done[cell.label]
    other = done[reference] if reference is not None else {}
    failed = {
        seed: row.outcome for seed in sweep.seeds if (row := measured[cell.label, seed]).outcome["status"] != "done"
    }
    return {
        "label": cell.label,
        "point": cell.point,
        "settings": {name: text for fields, value in cell.changes for name, text in _settings(fields, value)},
        "seeds": list(rows),
        "metric": _metric(rows),
        "metrics": metrics(rows),
        "difference": differences(rows, other) if cell.label != reference else {},
        "ablation": ablation(rows),
        "failures": [{"seed": seed, "reason": outcome["reason"]} for seed, outcome in failed.items()],
        "costs": {
            str(seed): {name: row.outcome[name] for name in COSTS if name in row.outcome} for seed, row in rows.items()
        },
    }


def _settings(fields: Any, value: Any) -> list[tuple[str, str]]:
    values = (value,) if isinstance(fields, str) else value
    return [(name, show(part)) for name, part in zip(names_of(fields), values, strict=True)]


def metrics(rows: Mapping[int, Measured]) -> dict[str, dict[str, Any]]:
    """By metric: `mean` over seeds and contacts, its `interval`, and the mean of every seed; figures of `TABLES` without one.

    Those of further tests are called `<test>: <metric>`, likeness on one shape `<shape>: ms_ssim/<kind>`.
    """
    found = {}
    for test, name in _names(rows):
        values, poses = _stacked(rows, test, name), _poses(rows, test)
        found[_called(test, name)] = _figure(rows, values, poses)
        for shape, inside in _shapes(rows, test).items() if name.startswith("ms_ssim/") else ():
            found[_called(f"{test}, {shape}" if test else shape, name)] = _figure(
                rows, values[:, inside], poses[inside]
            )
    found |= recoveries(rows)
    plain = {
        seed: _flat({table: row.outcome["results"].get(table, {}) for table in TABLES}) for seed, row in rows.items()
    }
    return found | _over_seeds(plain)


def _figure(rows: Mapping[int, Measured], values: np.ndarray, poses: np.ndarray) -> dict[str, Any]:
    """Of values (seeds, N) at poses (N,)."""
    return {
        "mean": float(values.mean()),
        "interval": interval(values, poses),
        "per_seed": {str(seed): float(mean) for seed, mean in zip(rows, values.mean(axis=1), strict=True)},
    }


def recoveries(rows: Mapping[int, Measured]) -> dict[str, dict[str, Any]]:
    """`pose_recovery/<kind>/<quantity>`: (sheared - unsheared) / (sheared - tap) of the mean errors, and its interval; on one shape
    `<shape>: ...`.

    Left out where the slide does no damage; without an interval where it does none in some of the resamples.
    """
    found: dict[str, dict[str, Any]] = {}
    names = _names(rows)
    for test, name in names:
        table, kind, *quantity = name.split("/")
        if table != "pose" or kind in ("tap", "sheared"):
            continue
        tap, sheared = (f"pose/{other}/{'/'.join(quantity)}" for other in ("tap", "sheared"))
        of_taps = next((where for where in (test, TAPS) if (where, tap) in names), None)
        if of_taps is None or (test, sheared) not in names:
            continue
        errors = [
            (_stacked(rows, where, each), _poses(rows, where))
            for where, each in ((of_taps, tap), (test, sheared), (test, name))
        ]
        own = f"pose_recovery/{kind}/{'/'.join(quantity)}"
        figure = _recovery(list(rows), errors)
        found |= {_called(test, own): figure} if figure else {}
        for shape, inside in _shapes(rows, test).items() if of_taps == test else ():
            figure = _recovery(list(rows), [(values[:, inside], poses[inside]) for values, poses in errors])
            found |= {_called(f"{test}, {shape}" if test else shape, own): figure} if figure else {}
    return found


def _recovery(seeds: Sequence[int], errors: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any] | None:
    """Of errors of tap, sheared and unsheared, (seeds, N) at poses (N,) each; None where the slide does no damage."""
    tap, sheared, unsheared = (values.mean() for values, _ in errors)
    if sheared <= tap:
        return None
    redrawn = [resampled(values, poses) for values, poses in errors]
    bounded = bool(np.all(redrawn[1] > redrawn[0]))
    by_seed = zip(*(values.mean(axis=1) for values, _ in errors), strict=True)
    return {
        "mean": float((sheared - unsheared) / (sheared - tap)),
        "interval": spread.interval((redrawn[1] - redrawn[2]) / (redrawn[1] - redrawn[0])) if bounded else None,
        "per_seed": {
            str(seed): float((row[1] - row[2]) / (row[1] - row[0])) if row[1] > row[0] else None
            for seed, row in zip(seeds, by_seed, strict=True)
        },
    }


def differences(rows: Mapping[int, Measured], other: Mapping[int, Measured]) -> dict[str, dict[str, Any]]:
    """By metric that both have: `mean` and `interval` of this less the other, over the seeds that both have.

    Empty where there is no such seed, or the test contacts are not the same. Likeness of images of different sizes is not compared.
    """
    common = [seed for seed in rows if seed in other]
    rows, other = ({seed: cell[seed] for seed in common} for cell in (rows, other))
    found = {}
    one_size = all(_metric(rows).get(name) == _metric(other).get(name) for name in ("ms_ssim", "image_px"))
    for test, name in _names(rows):
        if ("ms_ssim" in name or name.startswith("swap/")) and not one_size:
            continue
        if (test, name) in _names(other) and _same_contacts(rows, other, test):
            values = _stacked(rows, test, name) - _stacked(other, test, name)
            found[_called(test, name)] = {
                "mean": float(values.mean()),
                "interval": interval(values, _poses(rows, test)),
            }
    return found


def ablation(rows: Mapping[int, Measured]) -> dict[str, dict[str, Any]]:
    """`<cell of the codes>/<metric>`: mean over seeds and each seed's; empty where it was not asked for."""
    plain = {
        seed: {
            f"{line['name']}/{name}": value
            for line in row.outcome["ablation"]
            for name, value in line.items()
            if _number(value)
        }
        for seed, row in rows.items()
        if row.outcome["ablation"]
    }
    return _over_seeds(plain)


def _over_seeds(plain: Mapping[int, Mapping[str, float]]) -> dict[str, dict[str, Any]]:
    """Figures that every seed has."""
    first, *more = plain.values() or [{}]
    names = [name for name in first if all(name in others for others in more)]
    return {
        name: {
            "mean": float(np.mean([figures[name] for figures in plain.values()])),
            "interval": None,
            "per_seed": {str(seed): figures[name] for seed, figures in plain.items()},
        }
        for name in names
    }


def _flat(tree: Any, prefix: str = "") -> dict[str, float]:
    """Numbers of nested dictionaries by their path."""
    if _number(tree):
        return {prefix: tree}
    if not isinstance(tree, dict):
        return {}
    return {
        path: value
        for name, entry in tree.items()
        for path, value in _flat(entry, f"{prefix}/{name}" if prefix else name).items()
    }


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _names(rows: Mapping[int, Measured]) -> list[tuple[str, str]]:
    """Tests and names of their scores, those that every row has: one measured by an earlier version may lack some."""
    first, *others = [row.tests for row in rows.values()] or [{}]
    return [
        (test, name)
        for test, scores in first.items()
        for name in scores
        if "/" in name and all(name in tests.get(test, {}) for tests in others)
    ]


def _metric(rows: Mapping[int, Measured]) -> dict[str, Any]:
    """What exactly the evaluation calls MS-SSIM, and other such notes."""
    return next(iter(rows.values())).outcome["results"]["metric"] if rows else {}


def _called(test: str, name: str) -> str:
    return f"{test}: {name}" if test else name


def _stacked(rows: Mapping[int, Measured], test: str, name: str) -> np.ndarray:
    """(seeds, N)"""
    return np.stack([np.asarray(row.tests[test][name], np.float64) for row in rows.values()])


def _shapes(rows: Mapping[int, Measured], test: str) -> dict[str, np.ndarray]:
    """Which contacts (N,) of a test are with which shape."""
    first = next(iter(rows.values()))
    results = first.outcome["results"]
    own = results["tests"].get(test, {}) if test else results["settings"]["paired"]
    names = own.get("stimuli", ())  # of recordings none is known
    stimulus = np.asarray(first.tests[test]["stimulus"])
    return {name: stimulus == index for index, name in enumerate(names) if np.any(stimulus == index)}


def _same_contacts(rows: Mapping[int, Measured], other: Mapping[int, Measured], test: str) -> bool:
    """Whether both were drawn from the same settings, and none was lost that the other has."""
    return _drawn_from(rows, test) == _drawn_from(other, test) and np.array_equal(
        _poses(rows, test), _poses(other, test)
    )


def _drawn_from(rows: Mapping[int, Measured], test: str) -> dict[str, Any]:
    """The settings that decide the contacts of a test."""
    results = next(iter(rows.values())).outcome["results"]
    settings, own = results["settings"], results["tests"].get(test, {}) if test else {}
    paired = {name: own.get(name, value) for name, value in settings["paired"].items() if name not in NOT_CONTACTS}
    return paired | {"sensor": settings["sensor"]}


def _poses(rows: Mapping[int, Measured], test: str) -> np.ndarray:
    """(N,) which pose of which stimulus a contact belongs to."""
    labels = next(iter(rows.values())).tests[test]
    pairs = np.stack([labels["stimulus"], labels["pose_id"]], axis=1).astype(np.int64)
    return pairs[:, 0] * (pairs[:, 1].max() + 1) + pairs[:, 1]
