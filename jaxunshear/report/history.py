"""The training logs of a run, with one JSON object per validation, read for plotting."""

import json
import warnings
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.networks import TRAINABLE
from jaxunshear.errors import Note
from jaxunshear.files import Json, check_and_remove_checksum
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record

RETRAIN_REMEDY = "delete it, then run the same experiment again, which goes on from the checkpoint"


class History(NamedTuple):
    """V validations of one network; all lists are of length V."""

    epoch: list[float]
    train_seconds: list[float]
    training: dict[str, list[float]]  # losses by name
    validation: dict[str, list[float]]


class Trainings(NamedTuple):
    """The logs and the summaries of a run's trainings, by network."""

    histories: dict[str, History]
    summaries: dict[str, TrainingSummary]


def read_trainings(run_dir: Path) -> Trainings:
    """Read the logs and summaries of the networks that have a log. Raises UserError."""
    trainings = Trainings({}, {})
    for name in TRAINABLE:
        history = read_history(run_dir / name / "log.jsonl")
        if history is not None:
            trainings.histories[name] = history
            summary = run_dir / name / "summary.json"
            if summary.exists():
                record = read_record(summary, TrainingSummary, RETRAIN_REMEDY)
                trainings.summaries[name] = record
    return trainings


def read_lines(path: Path) -> list[Json]:
    """Read the lines of a training log that hold a validation; none if there is no log.

    Damaged lines are left out, with a note.
    """
    try:
        rows = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    validations = []
    for row in rows:
        try:
            line = check_and_remove_checksum(json.loads(row))
        except ValueError:
            continue
        if isinstance(line, dict) and "train_seconds" in line and "epoch" in line:
            validations.append(line)
    if damaged := len(rows) - len(validations):
        text = f"{path} is damaged: {damaged} of its lines are left out"
        warnings.warn(text, Note, stacklevel=2)
    return validations


def read_history(path: Path) -> History | None:
    """Read the training log at `path`; None if it does not exist or has no validation."""
    lines = read_lines(path)
    if not lines:
        return None
    return History(
        [line["epoch"] for line in lines],
        [line["train_seconds"] for line in lines],
        _collect_columns([line.get("train", {}) for line in lines]),
        _collect_columns([line.get("validation", {}) for line in lines]),
    )


def _collect_columns(rows: list[Json]) -> dict[str, list[float]]:
    """Collect the values of each name for which every row has a number."""
    columns = {}
    for name in rows[0]:
        if all(isinstance(row.get(name), int | float) for row in rows):
            columns[name] = [float(row[name]) for row in rows]
    return columns
