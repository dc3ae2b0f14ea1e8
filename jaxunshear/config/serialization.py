"""Settings as JSON, and back."""

import dataclasses
import typing
from typing import Any

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.types import (
    Hint,
    describe_hint,
    get_origin,
    is_of_type,
    list_groups,
    list_hints,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.version import __version__

VERSION = "version"  # of the package that wrote the settings beside it
OTHERS = "files of version 0.2.0 and earlier are not read"  # these do not name their version


def to_json(experiment: Experiment) -> Json:
    """`experiment` as nested dictionaries and lists."""
    return dataclasses.asdict(experiment)


def from_json(data: object, source: str = "experiment.json") -> Experiment:
    """Return the experiment that `to_json` wrote, with or without the version.

    Raises UserError naming fields that are unknown, missing or of a wrong type, or another version.
    """
    return build_value(
        without_version(data, source) if isinstance(data, dict) else data, Experiment, source, ""
    )


def with_version(settings: Json) -> Json:
    """Add the version of the package, which reads only its own files, to `settings`."""
    return {VERSION: __version__} | settings


def without_version(stored: Json, source: object) -> Json:
    """Return `stored` without its version. Raises UserError if that is not ours."""
    wrote = stored.get(VERSION, __version__)
    if _minor(wrote) != _minor(__version__):
        raise UserError(
            f"{source} was written by jaxunshear {wrote}, and this is {__version__}: "
            "use that version, or make it again in another folder"
        )
    return {name: value for name, value in stored.items() if name != VERSION}


def _minor(version: object) -> list[str]:
    """Return major and minor version: those of a patch read each other's files."""
    return str(version).split(".")[:2]


def build_value(data: object, kind: Hint, source: str, name: str) -> Any:
    """A value of type `kind` out of JSON; `name` is where in `source` it stands. Raises `UserError`."""
    items = next(iter(typing.get_args(kind)), None) if get_origin(kind) is tuple else None
    if list_groups(items) and isinstance(data, list):
        return tuple(
            item if isinstance(item, str) else build_value(item, items, source, name)
            for item in data
        )
    if kinds := list_groups(kind):
        return _group(data, kinds, source, name)
    value = _convert_to_tuples(data)
    if not is_of_type(value, kind):
        raise UserError(f"{source}: {name} takes {describe_hint(kind)}, not {data!r}")
    return value


def _group(data: object, kinds: list[type], source: str, name: str) -> Any:
    """Settings of whichever of `kinds` has the fields in `data`."""
    if not isinstance(data, dict):
        raise UserError(
            f"{source} does not fit version {__version__}: {name or 'its top level'} is no group; run it again"
        )
    own = min(kinds, key=lambda each: len(_misfits(data, list_hints(each), name)))
    fields = list_hints(own)
    if misfits := _misfits(data, fields, name):
        raise UserError(
            f"{source} does not fit version {__version__}: {', '.join(misfits)}; {OTHERS}: run it again"
        )
    parts = {
        field: build_value(data[field], hint, source, f"{name}.{field}".lstrip("."))
        for field, hint in fields.items()
    }
    return own(**parts)


def _misfits(given: Json, fields: dict[str, Hint], group: str) -> list[str]:
    """Say which settings of a group this version does not have, and which a file lacks."""
    gone = {field: value for field, value in given.items() if field not in fields}
    lacking = fields.keys() - given.keys()
    return [
        *(
            f"{group}.{field} = {value!r} is no setting".lstrip(".")
            for field, value in sorted(gone.items())
        ),
        *(f"{group}.{field} is missing".lstrip(".") for field in sorted(lacking)),
    ]


def _convert_to_tuples(data: object) -> object:
    return tuple(_convert_to_tuples(item) for item in data) if isinstance(data, list) else data
