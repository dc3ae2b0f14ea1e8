"""Summarises a run of benchmarks/gpu.sh: `python -m benchmarks.gpu_summary runs/gpu`.

FOLDER/summary.json has commit, machine, versions, GPU and driver, a row for each step, and what two
trainings side by side gain. FOLDER/steps.tsv has a line for each step that ended: name, seconds and
exit code; of steps that were repeated, the last line counts.
"""

import csv
import subprocess
import sys
from functools import partial
from pathlib import Path

from jaxunshear.cli.program import write_measurement
from jaxunshear.files import Json, read_object
from jaxunshear.text_table import format_text_table

STEPS, SUMMARY = "steps.tsv", "summary.json"
COLUMNS = ("name", "s", "exit_code")
CUDA = ("cuda12", "cuda13")
PACKAGES = ("torch", *(f"jax-{cuda}-{part}" for cuda in CUDA for part in ("plugin", "pjrt")))
FIELDS = {"name": "name", "driver": "driver_version", "memory": "memory.total"}
QUERY = ("nvidia-smi", f"--query-gpu={','.join(FIELDS.values())}", "--format=csv,noheader")
SEEDS = (0, 1)
format_table = partial(format_text_table, columns=COLUMNS)


def summarise(folder: Path) -> Json:
    """Summarise the steps in `folder`: rows, the GPU, and ratios of two seeds."""
    rows = read_steps(folder)
    return {"rows": rows, "gpu": read_gpu(), "side_by_side": compare_seeds(folder, rows)}


def read_steps(folder: Path) -> list[Json]:
    """Read a row for each step: name, seconds and exit code."""
    with (folder / STEPS).open() as file:
        steps = {name: (int(s), int(code)) for name, s, code in csv.reader(file, delimiter="\t")}
    return [{"name": name, "s": s, "exit_code": code} for name, (s, code) in steps.items()]


def read_gpu() -> Json:
    """Read name, driver and memory of the first GPU; nothing if there is none."""
    try:
        text = subprocess.run(QUERY, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return {}
    return dict(zip(FIELDS, text.splitlines()[0].split(", "), strict=True))


def compare_seeds(folder: Path, rows: list[Json]) -> Json:
    """Divide the time of two seeds one after the other by their time side by side.

    `commands` are wall clock with start, compilation and evaluation; of `trainings` the sum of two
    is divided by the longer one. Returns nothing before all have ended.
    """
    seconds = {row["name"]: row["s"] for row in rows if not row["exit_code"]}
    if not {"seeds_by_1", "seeds_by_2"} <= seconds.keys():
        return {}
    alone, together = (
        [_read_train_seconds(folder / f"seed_by_{workers}_{seed}.json") for seed in SEEDS]
        for workers in (1, 2)
    )
    return {
        "commands": seconds["seeds_by_1"] / seconds["seeds_by_2"],
        "trainings": sum(alone) / max(together),
    }


def _read_train_seconds(file: Path) -> float:
    (cell,) = read_object(file)["cells"]
    (costs,) = cell["costs"].values()  # by seed
    return sum(costs["train_seconds"].values())


def main(folder: Path) -> None:
    """Write the summary of a folder, and print it."""
    summary = summarise(folder)
    write_measurement(folder / SUMMARY, "benchmarks/gpu.sh", summary, PACKAGES)
    print(format_table(summary["rows"]))
    for name, ratio in summary["side_by_side"].items():
        print(f"{name} of two seeds, one after the other over side by side: {ratio:.2f}")
    print(folder / SUMMARY)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
