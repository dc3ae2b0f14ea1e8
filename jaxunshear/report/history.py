"""The training logs of a run, read for drawing: one JSON object a line, written at each validation."""

import json
import warnings
from pathlib import Path
from typing import NamedTuple

from jaxunshear.errors import Note
from jaxunshear.files import Json, check_and_remove_checksum


class History(NamedTuple):
    """V validations of one network; all lists are of length V."""

    epoch: list[float]
    train_seconds: list[float]
    training: dict[str, list[float]]  # losses by name
    validation: dict[str, list[float]]


def read_lines(path: Path) -> list[Json]:
    """Of a training log, those that hold a validation; none where there is no log yet. A line that is damaged is
    left out, and a note says so."""
    try:
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    rows, lines = text.splitlines(), []
    for line in rows:
        try:
            lines.append(check_and_remove_checksum(json.loads(line)))
        except ValueError:
            continue
    kept = [
        line
        for line in lines
        if isinstance(line, dict) and "train_seconds" in line and "epoch" in line
    ]
    if len(kept) < len(rows):
        warnings.warn(
            f"{path} is damaged: {len(rows) - len(kept)} of its lines are left out",
            Note,
            stacklevel=2,
        )
    return kept


def read_history(path: Path) -> History | None:
    """None where there is no log, or nothing in it yet."""
    lines = read_lines(path)
    if not lines:
        return None
    return History(
        [line["epoch"] for line in lines],
        [line["train_seconds"] for line in lines],
        _columns([line.get("train", {}) for line in lines]),
        _columns([line.get("validation", {}) for line in lines]),
    )


def _columns(rows: list[Json]) -> dict[str, list[float]]:
    """Those names that every row has."""
    names = [
        name for name in rows[0] if all(isinstance(row.get(name), int | float) for row in rows)
    ]
    return {name: [float(row[name]) for row in rows] for name in names}
