"""The summary of a sweep: figures of each cell, differences from a reference, and a table."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import replace

import numpy as np

from jaxunshear.config.fields import format_value
from jaxunshear.config.networks import POSENET_SHEARED
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import Sweep, get_base, list_fields
from jaxunshear.evaluation.intervals import compute_recovery, compute_recovery_interval
from jaxunshear.evaluation.score import DIRECT_KIND
from jaxunshear.report.sweep_figures import list_comparable, list_efficient
from jaxunshear.results.sweep import (
    CellResult,
    Costs,
    Failure,
    Figure,
    GridAxis,
    SweepResult,
)
from jaxunshear.sweep.grid import Cell, format_field_name, format_value_label, split_change
from jaxunshear.sweep.scores import (
    RowScores,
    compute_interval,
    describe_intervals,
    format_name,
    get_metric_notes,
    has_same_contacts,
    number_contact_poses,
    resample_means,
    select_by_shape,
    select_smooth,
    stack_scores,
)
from jaxunshear.text_table import format_text_table

# tables of a run's results with figures that are no means over contacts
TABLES = ("pin_error", "half_width", "coverage")
# of the table; * stands for each network
MAIN_METRICS = ("ms_ssim/*", "pose/*/edge_mm", "pose/*/edge_deg", "swap/DS(z_p,z_s)/mse")
TAP_TEST = "taps"  # the test of recorded taps, which are no pairs of the slides
Rows = Mapping[int, RowScores]  # of one cell, by seed; none of them failed
# contacts (N,) bool by the name of the part
ALL_CONTACTS: Mapping[str, np.ndarray | slice] = {"": slice(None)}


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
    for fields, values in sweep.grid:
        labels = dict.fromkeys(format_value_label(fields, value) for value in values)
        axes.append(GridAxis(format_field_name(fields, sweep), list_fields(fields), tuple(labels)))
    networks: dict[str, None] = {}
    for cell in cells:
        networks |= dict.fromkeys(cell.experiment.networks)
    rows: dict[str | None, dict[int, RowScores]] = {}
    for (label, seed), row in scores.items():
        rows.setdefault(label, {})[seed] = row
    results = []
    for cell in cells:
        others = {} if reference in (None, cell.label) else _select_done(rows[reference])
        results.append(_summarise_cell(cell, rows[cell.label], others))
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


def _select_done(rows: Rows) -> Rows:
    return {seed: row for seed, row in rows.items() if row.outcome.status == "done"}


def _summarise_cell(cell: Cell, ended: Rows, reference: Rows) -> CellResult:
    settings = {}
    for fields, value in cell.changes:
        for name, part in split_change(fields, value):
            settings[name] = format_value(part)
    rows, names = _select_done(ended), [field.name for field in dataclass_fields(Costs)]
    costs = {}
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
        failures=[
            Failure(seed, row.outcome.reason) for seed, row in ended.items() if seed not in rows
        ],
        costs=costs,
    )


def compute_metrics(rows: Rows) -> dict[str, Figure]:
    """Compute the mean of each metric over seeds and contacts, with its interval.

    Metrics of further tests are called `<test>: <metric>`, likeness on one shape
    `<shape>: ms_ssim/<kind>`, and errors of unambiguous edge angles
    `smooth: pose/<kind>/edge_deg`. Figures of `TABLES` have no interval.
    """
    figures = {}
    for (test, name), values in stack_scores(rows).items():
        poses, parts = number_contact_poses(rows, test), dict(ALL_CONTACTS)
        if name.startswith("ms_ssim/"):
            parts |= select_by_shape(rows, test)
        elif name.startswith("pose/") and name.endswith("/edge_deg"):
            parts |= select_smooth(rows, test)
        for part, contacts in parts.items():
            figure = _make_figure(rows, values[:, contacts], poses[contacts])
            figures[format_name(test, name, part)] = figure
    figures |= _compute_recoveries(rows)
    return figures | _average_over_seeds({seed: _list_table(row) for seed, row in rows.items()})


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
    stacks = stack_scores(rows)
    for test, name in stacks:
        table, kind, *quantity = name.split("/")
        if table != "pose" or kind in ("tap", "sheared"):
            continue
        tap, sheared = "/".join(["pose/tap", *quantity]), "/".join(["pose/sheared", *quantity])
        tap_test = next((each for each in (test, TAP_TEST) if (each, tap) in stacks), None)
        if tap_test is None or (test, sheared) not in stacks:
            continue
        scores = ((test, name), (test, sheared), (tap_test, tap))
        poses = [number_contact_poses(rows, each) for each, _ in scores]
        parts = dict(ALL_CONTACTS)
        if tap_test == test:
            parts |= select_by_shape(rows, test)
        recovery_name = name.replace("pose/", "pose_recovery/", 1)
        for shape, contacts in parts.items():
            errors = [stacks[each][:, contacts] for each in scores]
            if figure := _compute_recovery(rows, errors, [each[contacts] for each in poses]):
                figures[format_name(test, recovery_name, shape)] = figure
    return figures


def _compute_recovery(
    seeds: Iterable[int], errors: Sequence[np.ndarray], poses: Sequence[np.ndarray]
) -> Figure | None:
    """Compute the recovery of mean errors on unsheared and sheared contacts, and on taps.

    `errors` (seeds, N) and `poses` (N,) are of the three kinds of contact.
    """
    mean = compute_recovery(*(float(each.mean()) for each in errors))
    if mean is None:
        return None
    by_seed = np.stack([each.mean(axis=1) for each in errors], axis=1).tolist()
    recoveries = {
        str(seed): compute_recovery(*row) for seed, row in zip(seeds, by_seed, strict=True)
    }
    return Figure(mean, compute_recovery_interval(*map(resample_means, errors, poses)), recoveries)


def compute_differences(rows: Rows, other: Rows) -> dict[str, Figure]:
    """Compute the mean of each metric less that of `other`, with its interval.

    It is over the seeds that both have; empty if there is none, or if the test contacts are not
    the same. Likeness of images of different sizes is not compared.
    """
    common = [seed for seed in rows if seed in other]
    rows, other = {seed: rows[seed] for seed in common}, {seed: other[seed] for seed in common}
    notes, other_notes = get_metric_notes(rows), get_metric_notes(other)
    same_images = all(notes.get(key) == other_notes.get(key) for key in ("ms_ssim", "image_px"))
    stacks, figures = stack_scores(other), {}
    for (test, name), values in stack_scores(rows).items():
        if ("ms_ssim" in name or name.startswith("swap/")) and not same_images:
            continue
        if (test, name) in stacks and has_same_contacts(rows, other, test):
            differences = values - stacks[test, name]
            interval = compute_interval(differences, number_contact_poses(rows, test))
            figures[format_name(test, name)] = Figure(float(differences.mean()), interval)
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
    averages = {}
    for name in next(iter(by_seed.values()), {}):
        if all(name in figures for figures in by_seed.values()):
            values = {str(seed): figures[name] for seed, figures in by_seed.items()}
            averages[name] = Figure(float(np.mean(list(values.values()))), None, values)
    return averages


def format_table(summary: SweepResult) -> str:
    """Format a line per cell: main figures, time and memory; then failures and frontiers."""
    cells = summary.cells
    names = select_main_metrics(summary)
    head, rows = ("", "seeds", *names, "training", "memory"), []
    for cell in cells:
        label = cell.label + (" *" if cell.label == summary.reference else "")
        seeds = f"{len(cell.seeds)} of {len(summary.seeds)}"
        figures = [_format_figure(cell.metrics.get(name)) for name in names]
        line = [label, seeds, *figures, *_format_costs(cell)]
        rows.append(dict(zip(head, line, strict=True)))
    text = [format_text_table(rows, head)]
    text.append(f"brackets: 95 % intervals over {summary.spread['over']}")
    if summary.reference:
        text.append("* what sweep.json has the differences from")
    for cell in cells:
        for failure in cell.failures:
            text.append(f"failed: {cell.label}, seed {failure.seed}: {failure.reason}")
    if any(cell.failures for cell in cells):
        text.append(
            "the same command leaves failed rows as they are: --retry-failed tries them again"
        )
    return "\n".join(text + _describe_frontiers(summary))


def _describe_frontiers(summary: SweepResult) -> list[str]:
    lines = []
    for metric, costs in summary.efficient.items():
        for cost, labels in costs.items():
            if len(labels) > 1:
                lines.append(f"{metric} against {cost}: {' < '.join(labels)}")
    if lines:
        comparable = list_comparable(summary)
        others = [cell.label for cell in summary.cells if cell.label not in comparable]
        if others:
            lines.append(f"not ranked, tested on other contacts: {'; '.join(others)}")
    return lines


def select_main_metrics(summary: SweepResult) -> list[str]:
    """Select the metrics of any cell that the table has room for."""
    metrics = {name: None for cell in summary.cells for name in cell.metrics}
    patterns: tuple[str, ...] = MAIN_METRICS
    if not any(name.endswith("/edge_mm") for name in metrics):  # other targets: the first two
        targets = [name.rpartition("/")[2] for name in metrics if name.startswith("pose/")]
        first_targets = list(dict.fromkeys(targets))[:2]
        patterns = (MAIN_METRICS[0], *(f"pose/*/{target}" for target in first_targets))
    kinds = [DIRECT_KIND if network == POSENET_SHEARED else network for network in summary.networks]
    names = [pattern.replace("*", kind) for pattern in patterns for kind in kinds]
    return [name for name in dict.fromkeys(names) if name in metrics]


def _format_figure(figure: Figure | None) -> str:
    if figure is None or figure.interval is None:
        return "-"
    return "{:.3g} [{:.3g}, {:.3g}]".format(figure.mean, *figure.interval)


def _format_costs(cell: CellResult) -> list[str]:
    costs = cell.costs.values()
    if not costs:
        return ["-", "-"]
    seconds = sum(sum(cost.train_seconds.values()) for cost in costs) / len(costs)
    return [f"{seconds:.0f} s", f"{max(cost.peak_memory_bytes for cost in costs) / 2**30:.1f} GiB"]
