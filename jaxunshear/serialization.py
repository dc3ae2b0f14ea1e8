"""Values as JSON and CSV can hold them."""

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def to_builtins(obj: Any) -> Any:
    """`obj` of built-in types only: records become dictionaries, without what is None where that is the default; arrays and their
    scalars become lists and numbers, paths become text."""
    if dataclasses.is_dataclass(obj):
        held = {
            each.name: (getattr(obj, each.name), each.default) for each in dataclasses.fields(obj)
        }
        return {
            name: to_builtins(value)
            for name, (value, default) in held.items()
            if value is not None or default is not None
        }
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
    """A heading of the first row's names, then a line a row."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()
