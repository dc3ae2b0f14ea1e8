"""A sweep's summary as text, for people."""

from jaxunshear.config.registry import POSENET_SHEARED
from jaxunshear.report.frontier_figure import list_comparable
from jaxunshear.results.sweep import CellResult, Figure, SweepResult
from jaxunshear.text_table import format_text_table

DIRECT_KIND = "sheared_learnt"  # as evaluation calls what `posenet_sheared` reads

MAIN_METRICS = (
    "ms_ssim/*",
    "pose/*/edge_mm",
    "pose/*/edge_deg",
    "swap/DS(z_p,z_s)/mse",
)  # *: each network


def format_table(summary: SweepResult) -> str:
    """A line a cell: the main figures with their intervals, seconds of training, memory; then the failures with their reasons,
    and what no other setting beats."""
    cells = summary.cells
    names = select_main_metrics(summary)
    head, rows = ("", "seeds", *names, "training", "memory"), []
    for cell in cells:
        mark = " *" if cell.label == summary.reference else ""
        figures = [_figure(cell.metrics.get(name)) for name in names]
        line = [
            cell.label + mark,
            f"{len(cell.seeds)} of {len(summary.seeds)}",
            *figures,
            *_costs(cell),
        ]
        rows.append(dict(zip(head, line, strict=True)))
    text = [format_text_table(rows, head)]
    text.append(f"brackets: 95 % intervals over {summary.spread['over']}")
    if summary.reference:
        text.append("* what sweep.json has the differences from")
    for cell in cells:
        text += [
            f"failed: {cell.label}, seed {failure.seed}: {failure.reason}"
            for failure in cell.failures
        ]
    if any(cell.failures for cell in cells):
        text.append(
            "the same command leaves failed rows as they are: --retry-failed tries them again"
        )
    return "\n".join(text + _frontiers(summary))


def _frontiers(summary: SweepResult) -> list[str]:
    """What no other setting beats, of a sweep that is a list of settings; then which ones were not ranked."""
    lines = [
        f"{metric} against {cost}: {' < '.join(labels)}"
        for metric, costs in summary.efficient.items()
        for cost, labels in costs.items()
        if len(labels) > 1
    ]
    others = (
        [cell.label for cell in summary.cells if cell.label not in list_comparable(summary)]
        if lines
        else []
    )
    return [
        *lines,
        *([f"not ranked, tested on other contacts: {'; '.join(others)}"] if others else []),
    ]


def select_main_metrics(summary: SweepResult) -> list[str]:
    """The figures that the table has room for, of those that any cell has."""
    there = {name: None for cell in summary.cells for name in cell.metrics}
    patterns: tuple[str, ...] = MAIN_METRICS
    if not any(name.endswith("/edge_mm") for name in there):  # other targets: the first two
        read = [name.rpartition("/")[2] for name in there if name.startswith("pose/")]
        patterns = (
            MAIN_METRICS[0],
            *(f"pose/*/{target}" for target in list(dict.fromkeys(read))[:2]),
        )
    shown = [DIRECT_KIND if network == POSENET_SHEARED else network for network in summary.networks]
    wanted = [pattern.replace("*", network) for pattern in patterns for network in shown]
    return [name for name in dict.fromkeys(wanted) if name in there]


def _figure(figure: Figure | None) -> str:
    if figure is None or figure.interval is None:
        return "-"
    low, high = figure.interval
    return f"{figure.mean:.3g} [{low:.3g}, {high:.3g}]"


def _costs(cell: CellResult) -> list[str]:
    """Seconds of training of all networks, and the largest memory, over seeds."""
    costs = cell.costs.values()
    if not costs:
        return ["-", "-"]
    seconds = sum(sum(cost.train_seconds.values()) for cost in costs) / len(costs)
    return [f"{seconds:.0f} s", f"{max(cost.peak_memory_bytes for cost in costs) / 2**30:.1f} GiB"]
