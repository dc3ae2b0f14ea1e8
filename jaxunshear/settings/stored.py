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
        return _group(data, kinds, source, name)
    value = _tupled(data)
    if not fits(value, kind):
        raise UserError(f"{source}: {name} takes {describe(kind)}, not {data!r}")
    return value


def _group(data: object, kinds: list[type], source: str, name: str) -> Any:
    """Settings of whichever of `kinds` has the fields in `data`."""
    if not isinstance(data, dict):
        raise UserError(f"{source} does not fit this version: {name or 'its top level'} is no group; run it again")
    given = {field: value for field, value in data.items() if field not in GONE or not is_later(field, value)}
    own = min(kinds, key=lambda each: len(_misfits(given, hints(each), name)))
    fields = hints(own)
    if misfits := _misfits(given, fields, name):
        raise UserError(f"{source} does not fit this version: {', '.join(misfits)}; run it again")
    values = LATER | given
    parts = {field: build(values[field], hint, source, f"{name}.{field}".lstrip(".")) for field, hint in fields.items()}
    return own(**parts)


def _misfits(given: Json, fields: dict[str, Hint], group: str) -> list[str]:
    """Say which settings of a group this version no longer has, and which a file lacks that are not LATER."""
    gone = {field: value for field, value in given.items() if field not in fields}
    lacking = fields.keys() - given.keys() - LATER.keys()
    return [
        *(f"{group}.{field} = {value!r} is no setting".lstrip(".") for field, value in sorted(gone.items())),
        *(f"{group}.{field} is missing".lstrip(".") for field in sorted(lacking)),
    ]


def _tupled(data: object) -> object:
    return tuple(_tupled(item) for item in data) if isinstance(data, list) else data
