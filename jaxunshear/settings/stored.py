"""Settings as JSON, and back."""

import dataclasses
import typing
from typing import Any

from jaxunshear.errors import UserError
from jaxunshear.settings.earlier import GONE, LATER, is_later
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.types import Hint, describe, fits, groups, hints, origin
from jaxunshear.storage import Json


def to_json(experiment: Experiment) -> Json:
    """`experiment` as nested dictionaries and lists."""
    return dataclasses.asdict(experiment)


def from_json(data: object, source: str = "experiment.json") -> Experiment:
    """The inverse of `to_json`; unknown and missing fields and wrong types are refused by name, but those that an earlier version did not
    write (`earlier.py`)."""
    return build(data, Experiment, source, "")


def build(data: object, kind: Hint, source: str, name: str) -> Any:
    """A value of type `kind` out of JSON; `name` is where in `source` it stands. Raises `UserError`."""
    items = next(iter(typing.get_args(kind)), None) if origin(kind) is tuple else None
    if groups(items) and isinstance(data, list):
        return tuple(item if isinstance(item, str) else build(item, items, source, name) for item in data)
    if kinds := groups(kind):
        if isinstance(data, dict):
            data = {field: value for field, value in data.items() if field not in GONE or not is_later(field, value)}
        given = set(data) if isinstance(data, dict) else set()
        own = next((each for each in kinds if _fills(given, set(hints(each)))), kinds[0])
        fields = hints(own)
        if not isinstance(data, dict) or not _fills(given, set(fields)):
            odd = (
                sorted((given ^ set(fields)) - (set(fields) & set(LATER))) if isinstance(data, dict) else ["all of it"]
            )
            raise UserError(
                f"{source} does not fit this version: see {name or 'its top level'}, {', '.join(odd)}; run it again"
            )
        parts = {
            field: build(data[field] if field in data else LATER[field], hint, source, f"{name}.{field}".lstrip("."))
            for field, hint in fields.items()
        }
        return own(**parts)
    value = _tupled(data)
    if not fits(value, kind):
        raise UserError(f"{source}: {name} takes {describe(kind)}, not {data!r}")
    return value


def _fills(given: set[str], fields: set[str]) -> bool:
    """Whether a file that gives these has all that is not LATER, and nothing else."""
    return given <= fields and fields - given <= set(LATER)


def _tupled(data: object) -> object:
    return tuple(_tupled(item) for item in data) if isinstance(data, list) else data
