"""Draws how trainings went, from their logs: `python -m docs.make_curves runs/sweeps/appendix_b`.

It writes docs/results/appendix_b_curves.json and .png, for a sweep or a single run: sizes of
kernels (root mean square of their weights) and validation loss over steps.
"""

import json
import shlex
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from docs.keep import keep_picture, write_result
from docs.provenance import RESULTS
from jaxunshear.files import add_checksum, to_builtins
from jaxunshear.results.provenance import describe_provenance
from jaxunshear.style import DPI, LABEL, STYLE

NETWORK, LOSS = "disentangled", "supervised"
OUTERMOST = ("First", "Last")  # layers of one channel: not drawn
COLOURS = ("#1f6feb", "#d9822b", "#2a9d6f", "#b3554d", "#8250df", "#7c8b3d")


def read_curves(folder: Path) -> list[dict[str, Any]]:
    """Read the curves of each training: label, seed, and by step kernel sizes and losses."""
    rows = sorted(folder.glob("rows/*/"))
    tasks = [(row, json.loads((row / "task.json").read_text())) for row in rows]
    if not tasks:
        tasks = [(folder, {"label": "", "seed": 0})]
    curves = []
    for row, task in tasks:
        lines = (row / NETWORK / "log.jsonl").read_text().splitlines()
        log = [json.loads(line) for line in lines]
        curves.append(
            {
                "label": task["label"],
                "seed": task["seed"],
                "step": [line["step"] for line in log],
                "validation": {LOSS: [_round(line["validation"][LOSS]) for line in log]},
                "inner": [_round(_compute_inner_size(line["kernels"])) for line in log],
            }
        )
    return curves


def _compute_inner_size(kernels: dict[str, float]) -> float:
    """Compute the mean size of the kernels between the outermost layers."""
    return fmean(size for layer, size in kernels.items() if not _is_outermost(layer))


def _is_outermost(layer: str) -> bool:
    return any(part in layer for part in OUTERMOST)


def plot_curves(curves: list[dict[str, Any]], path: Path) -> None:
    """Plot sizes and losses over steps, with a colour for each label and a line for each seed."""
    labels = list(dict.fromkeys(curve["label"] for curve in curves))
    with rc_context(STYLE):
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        size_axes, loss_axes = figure.subplots(1, 2)
        labelled: set[str] = set()
        for curve in curves:
            label = curve["label"]
            style: dict[str, Any] = {
                "color": COLOURS[labels.index(label) % len(COLOURS)],
                "label": None if label in labelled else label,
            }
            labelled.add(label)
            size_axes.plot(curve["step"], curve["inner"], **style)
            loss_axes.plot(curve["step"], curve["validation"][LOSS], **style)
        _set_up(size_axes, "inner kernels, root mean square (0.02 at the start)")
        _set_up(loss_axes, "validation loss: mean squared difference to the tap")
        if len(labels) > 1:
            figure.legend(loc="outside lower center", ncols=3, fontsize=LABEL)
        figure.savefig(path, dpi=DPI, metadata={"Software": ""})


def _set_up(axes: Axes, title: str) -> None:
    axes.set(xlabel="steps", yscale="log", title=title)
    axes.locator_params(axis="x", nbins=6)


def _round(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.5g}")


if __name__ == "__main__":
    run = Path(sys.argv[1])
    curves = read_curves(run)
    command = shlex.join(["python", "-m", "docs.make_curves", *sys.argv[1:]])
    result = describe_provenance(command) | {"network": NETWORK, "rows": curves}
    name = f"{run.name}_curves"
    write_result(RESULTS / f"{name}.json", add_checksum(to_builtins(result)))
    plot_curves(curves, RESULTS / f"{name}.png")
    keep_picture(name, RESULTS / f"{name}.png")
