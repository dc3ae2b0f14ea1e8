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
# older files do not name their version
OLD_FILES = "files of version 0.2.0 and earlier are not read"


def to_json(experiment: Experiment) -> Json:
    """Convert an experiment to nested dictionaries and lists."""
    return dataclasses.asdict(experiment)


def from_json(data: object, source: str = "experiment.json") -> Experiment:
    """Return the experiment that `to_json` wrote, with or without the version.

    Raises UserError naming fields that are unknown, missing or of a wrong type, or another version.
    """
    settings = remove_version(data, source) if isinstance(data, dict) else data
    return build_value(settings, Experiment, source, "")


def add_version(settings: Json) -> Json:
    """Add the version of the package, which reads only its own files, to `settings`."""
    return {VERSION: __version__} | settings


def remove_version(stored: Json, source: object) -> Json:
    """Return `stored` without its version. Raises UserError if this version does not read it."""
    version = stored.get(VERSION, __version__)
    if _get_minor(version) != _get_minor(__version__):
        raise UserError(
            f"{source} was written by jaxunshear {version}, and this is {__version__}: "
            "use that version, or make it again in another folder"
        )
    return {name: value for name, value in stored.items() if name != VERSION}


def _get_minor(version: object) -> list[str]:
    """Return major and minor version; versions that share them read each other's files."""
    return str(version).split(".")[:2]


def build_value(data: object, kind: Hint, source: str, name: str) -> Any:
    """Make a value of type `kind` from JSON. Raises UserError.

    Args:
        source: the file, for messages.
        name: where in `source` the value stands.
    """
    item_kind = typing.get_args(kind)[0] if get_origin(kind) is tuple else None
    if list_groups(item_kind) and isinstance(data, list):
        return tuple(
            item if isinstance(item, str) else build_value(item, item_kind, source, name)
            for item in data
        )
    if kinds := list_groups(kind):
        return _build_group(data, kinds, source, name)
    value = _convert_to_tuples(data)
    if not is_of_type(value, kind):
        raise UserError(f"{source}: {name} takes {describe_hint(kind)}, not {data!r}")
    return value


def _build_group(data: object, kinds: list[type], source: str, name: str) -> Any:
    """Make settings of that one of `kinds` which the fields in `data` fit best."""
    problem = f"{source} does not fit version {__version__}: "
    if not isinstance(data, dict):
        raise UserError(f"{problem}{name or 'its top level'} is no group; run it again")
    prefix = f"{name}." if name else ""
    kind = min(kinds, key=lambda each: len(_list_misfits(data, list_hints(each), prefix)))
    fields = list_hints(kind)
    if misfits := _list_misfits(data, fields, prefix):
        raise UserError(f"{problem}{', '.join(misfits)}; {OLD_FILES}: run it again")
    parts = {
        field: build_value(data[field], hint, source, f"{prefix}{field}")
        for field, hint in fields.items()
    }
    return kind(**parts)


def _list_misfits(data: Json, fields: dict[str, Hint], prefix: str) -> list[str]:
    """List what is in the data but no field, and the fields that the data lack."""
    unknown = sorted(data.keys() - fields.keys())
    missing = sorted(fields.keys() - data.keys())
    return [
        *(f"{prefix}{field} = {data[field]!r} is no setting" for field in unknown),
        *(f"{prefix}{field} is missing" for field in missing),
    ]


def _convert_to_tuples(data: object) -> object:
    return tuple(_convert_to_tuples(item) for item in data) if isinstance(data, list) else data
