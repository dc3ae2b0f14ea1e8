"""Turns values into what JSON and CSV can hold."""

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def to_builtins(obj: Any) -> Any:
    """Convert to built-in types.

    Dataclasses become dictionaries, without fields that are None by default; arrays and their
    scalars become lists and numbers, paths become text; NaN and infinity become None.
    """
    if dataclasses.is_dataclass(obj):
        values = {}
        for field in dataclasses.fields(obj):
            value = getattr(obj, field.name)
            if value is not None or field.default is not None:
                values[field.name] = to_builtins(value)
        return values
    if isinstance(obj, Mapping):
        return {str(key): to_builtins(value) for key, value in obj.items()}
    if isinstance(obj, list | tuple):
        return [to_builtins(value) for value in obj]
    if isinstance(obj, float):
        return obj if obj - obj == 0 else None
    if obj is None or isinstance(obj, str | bool | int):
        return obj
    if isinstance(obj, Path):
        return str(obj)
    if hasattr(obj, "tolist"):  # numpy and JAX, without importing either
        return to_builtins(obj.tolist())
    raise TypeError(f"{type(obj).__name__} cannot be written as JSON")


def format_csv(table: Sequence[Mapping[str, object]]) -> str:
    """Format a heading with the names in the first row, then a line per row."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()
