"""Measures how much of a slide is undone on a task of which no slide was seen.

The run is about several tasks. For each of them a network learns from the slides of the others and
from taps of this one. It is compared with networks that know nothing of the task, or have learnt
from its slides. All have the same PoseNets and test slides.
"""

from pathlib import Path

from jaxunshear.files import Json
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, Results
from jaxunshear.task_run import OTHERS, TAPS_ALONE, score_taps_alone
from jaxunshear.text_table import format_text_table

DATA = Path("datasets")
# folders of the run that networks which unshear are scored in
NETWORKS = {"nothing": OTHERS, "taps alone": TAPS_ALONE, "slides": "trained"}


def bench_taps_alone(run: Path, data: Path = DATA) -> list[Json]:
    """Return rows of each task of a run: errors in mm and deg, and recovery, of each network.

    Raises UserError if the run is not about several tasks.
    """
    score_taps_alone(run, data, "python -m benchmarks taps_alone")
    tested = read_record(run / "results.json", Results, EVALUATE_REMEDY).tests
    rows: list[Json] = []
    for task in tested:
        for known, place in NETWORKS.items():
            file = run / place / task / "results.json"
            results = read_record(file, Results, EVALUATE_REMEDY)
            if not rows or rows[-1]["task"] != task:
                for kind in ("tap", "sheared"):
                    rows.append({"name": f"{task}/{kind}", "task": task, **results.pose_mae[kind]})
            errors, recovery = results.pose_mae["unsheared"], results.pose_recovery["unsheared"]
            recovered = {f"recovery_{name}": value for name, value in recovery.items()}
            rows.append({"name": f"{task}/{known}", "task": task, **errors, **recovered})
    return rows


def format_table(rows: list[Json]) -> str:
    """Format rows as text, with a column for each label of a task."""
    columns = dict.fromkeys(name for row in rows for name in row if name != "task")
    return format_text_table(rows, tuple(columns))
