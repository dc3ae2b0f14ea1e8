"""Files of results: a record is a frozen dataclass, and its file has the fields as JSON.

>>> results = read_record(Path("runs/demo/results.json"), Results, EVALUATE_REMEDY)
>>> results.pose_mae["disentangled"]["edge_mm"]
"""

import re
import warnings
from pathlib import Path
from typing import TypeVar

import msgspec

from jaxunshear.errors import Note, UserError
from jaxunshear.files import read_json, read_object, to_builtins, write_json

SCHEMA = 1  # of all records; a file without one has this first schema
Record = TypeVar("Record")


def write_record(path: Path, record: object) -> None:
    """Write a record to `path`, which is replaced atomically."""
    write_json(path, {"schema": SCHEMA} | to_builtins(record))


def read_record(path: Path, kind: type[Record], remedy: str) -> Record:
    """Read the record of type `kind` in `path`. Raises UserError, which ends with `remedy`."""
    return convert_record(read_json(path), kind, path, remedy)


def convert_record(content: object, kind: type[Record], source: object, remedy: str) -> Record:
    """Convert JSON to a record; fields of later versions are ignored. Raises as `read_record`."""
    schema = content.get("schema", SCHEMA) if isinstance(content, dict) else SCHEMA
    if schema != SCHEMA:
        raise UserError(
            f"{source} has the form {schema}, and this version reads {SCHEMA}: upgrade jaxunshear, "
            f"or {remedy}"
        )
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        lacks = re.sub(r"Object missing required field `(\w+)`", r"'\1'", str(error))
        raise UserError(f"{source} lacks {lacks}: {remedy}") from error


TIMES = "times.json"  # seconds of each stage of a run, added up over its commands


def read_times(run_dir: Path) -> dict[str, float]:
    """Read the seconds of each stage; a damaged file gives none, with a note."""
    path = Path(run_dir) / TIMES
    try:
        return read_object(path) if path.exists() else {}
    except UserError as error:
        warnings.warn(f"{error}; its times are left out", Note, stacklevel=2)
        return {}


# `reconstruct` continues from the results of `servo`, `ablate` writes beside those of the run
SHARED_FOLDERS = {"reconstruct": "servo", "ablation": "."}


def find_results_folder(run: Path, command: str) -> Path:
    """Find the folder of a run in which `command` writes its results."""
    return run / SHARED_FOLDERS.get(command, command)
