"""Files of results, read and written here alone: a record is a frozen dataclass, its file the fields as JSON and SCHEMA beside them.

>>> results = read_record(Path("runs/demo/results.json"), Results, "run `jaxunshear evaluate` again")
>>> results.pose_mae["disentangled"]["edge_mm"]
"""

import re
from pathlib import Path
from typing import TypeVar

import msgspec

from jaxunshear.errors import UserError
from jaxunshear.files import read_json, write_json
from jaxunshear.serialization import to_builtins

SCHEMA = 1  # of all records; a file that names none is of this first one
Record = TypeVar("Record")


def write_record(path: Path, record: object) -> None:
    """Replaces `path` in one step."""
    write_json(path, {"schema": SCHEMA} | to_builtins(record))


def read_record(path: Path, kind: type[Record], remedy: str) -> Record:
    """The record of this kind in `path`. Raises UserError, whose end is `remedy`: how the file is made anew."""
    return convert_record(read_json(path), kind, path, remedy)


def convert_record(held: object, kind: type[Record], source: object, remedy: str) -> Record:
    """As `read_record`, of JSON that is read already. What a later version may have added beside is not read."""
    schema = held.get("schema", SCHEMA) if isinstance(held, dict) else SCHEMA
    if schema != SCHEMA:
        raise UserError(
            f"{source} has the form {schema}, and this version reads {SCHEMA}: upgrade jaxunshear, or {remedy}"
        )
    try:
        return msgspec.convert(held, kind)
    except msgspec.ValidationError as error:
        lacks = re.sub(r"Object missing required field `(\w+)`", r"'\1'", str(error))
        raise UserError(f"{source} lacks {lacks}: {remedy}") from error
