"""The summary of a sweep as a text table."""

from jaxunshear.config.networks import POSENET_SHEARED
from jaxunshear.report.frontier_figure import list_comparable
from jaxunshear.results.sweep import CellResult, Figure, SweepResult
from jaxunshear.text_table import format_text_table

DIRECT_KIND = "sheared_learnt"  # the evaluation's name for predictions of `posenet_sheared`

# * stands for each network
MAIN_METRICS = ("ms_ssim/*", "pose/*/edge_mm", "pose/*/edge_deg", "swap/DS(z_p,z_s)/mse")


def format_table(summary: SweepResult) -> str:
    """Format a line per cell, then the failures with their reasons, then the frontiers.

    A line has the main figures with their intervals, seconds of training, and memory.
    """
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
    low, high = figure.interval
    return f"{figure.mean:.3g} [{low:.3g}, {high:.3g}]"


def _format_costs(cell: CellResult) -> list[str]:
    costs = cell.costs.values()
    if not costs:
        return ["-", "-"]
    seconds = sum(sum(cost.train_seconds.values()) for cost in costs) / len(costs)
    return [f"{seconds:.0f} s", f"{max(cost.peak_memory_bytes for cost in costs) / 2**30:.1f} GiB"]
