"""How trainings went, from their logs: `python -m docs.make_curves runs/sweeps/appendix_b` writes docs/results/appendix_b_curves.json and
.png, for a sweep or a single run: sizes of kernels (root mean square of their weights) and validation loss over steps."""

import json
import shlex
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.files import add_checksum, write_text
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.serialization import to_builtins
from jaxunshear.style import DPI, LABEL, STYLE

RESULTS = Path(__file__).parent / "results"
NETWORK, RANK = "disentangled", "supervised"
OUTERMOST = ("First", "Last")  # layers of one channel: not drawn
LINES = ("#1f6feb", "#d9822b", "#2a9d6f", "#b3554d", "#8250df", "#7c8b3d")


def curves(folder: Path) -> list[dict[str, Any]]:
    """A line per training: label, seed, and by step the terms of training and validation, each kernel's size, and `inner`."""
    rows = sorted(folder.glob("rows/*/"))
    made = [(row, json.loads((row / "task.json").read_text())) for row in rows] or [
        (folder, {"label": "", "seed": 0})
    ]
    found = []
    for place, task in made:
        log = [
            json.loads(line) for line in (place / NETWORK / "log.jsonl").read_text().splitlines()
        ]
        kept = {
            "label": task["label"],
            "seed": task["seed"],
            "step": [line["step"] for line in log],
        }
        for group in ("train", "validation", "kernels"):
            kept[group] = {
                name: [_short(line[group][name]) for line in log] for name in log[0][group]
            }
        kept["inner"] = [_short(size) for size in _inner(kept["kernels"])]
        found.append(kept)
    return found


def _inner(kernels: dict[str, list[float]]) -> list[float]:
    """The mean size of the kernels between the outermost layers, by step."""
    between = [
        sizes for name, sizes in kernels.items() if not any(part in name for part in OUTERMOST)
    ]
    return [fmean(sizes) for sizes in zip(*between, strict=True)]


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Sizes and losses over steps, a colour a label, a line a seed."""
    labels = list(dict.fromkeys(row["label"] for row in rows))
    with rc_context(STYLE):
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        sizes, losses = figure.subplots(1, 2)
        for row in rows:
            place = labels.index(row["label"])
            first = next(other for other in rows if other["label"] == row["label"]) is row
            style: dict[str, Any] = {
                "color": LINES[place % len(LINES)],
                "label": row["label"] if first else None,
            }
            sizes.plot(row["step"], row["inner"], **style)
            losses.plot(row["step"], row["validation"][RANK], **style)
        sizes.set(
            xlabel="steps",
            yscale="log",
            title="inner kernels, root mean square (0.02 at the start)",
        )
        losses.set(
            xlabel="steps",
            yscale="log",
            title="validation loss: mean squared difference to the tap",
        )
        for axes in (sizes, losses):
            axes.locator_params(axis="x", nbins=6)
        if len(labels) > 1:
            figure.legend(loc="outside lower center", ncols=3, fontsize=LABEL)
        figure.savefig(path, dpi=DPI, metadata={"Software": ""})


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.5g}")


if __name__ == "__main__":
    run = Path(sys.argv[1])
    rows = curves(run)
    made = describe_provenance(shlex.join(["python", "-m", "docs.make_curves", *sys.argv[1:]]))
    held = add_checksum(to_builtins(made | {"network": NETWORK, "rows": rows}))
    write_text(RESULTS / f"{run.name}_curves.json", json.dumps(held) + "\n")
    picture(rows, RESULTS / f"{run.name}_curves.png")
