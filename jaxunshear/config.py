"""Experiments: read from a Python file, changed field by field on the command line, checked, kept as JSON. No JAX here.

>>> experiment = override(load_experiment("experiments/demo.py"), ["--train.epochs", "5", "--sensor", "tactip127"])
>>> validate(experiment)
"""

import dataclasses
import difflib
import functools
import math
import runpy
import sys
import traceback
import types
import typing
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxunshear.earlier import LATER
from jaxunshear.errors import UserError
from jaxunshear.experiment import Experiment
from jaxunshear.scene.sensor import Sensor, sensor_named

NOT_SET = ("config", "digest")


def load_experiment(path: str | Path) -> Experiment:
    """The variable `experiment` of the Python file `path`, of the right types but not yet validated."""
    found = load_variable(path, experiment=Experiment)
    check_types(found)
    return found


def load_variable(path: str | Path, **kinds: type) -> Any:
    """The first variable named in `kinds` that the Python file `path` defines, of that type. Raises `UserError`."""
    path = Path(path)
    if not path.is_file():
        raise UserError(
            f"experiment file {path} {'is a folder' if path.is_dir() else 'does not exist'}: name a Python file"
        )
    try:
        variables = runpy.run_path(str(path), run_name="jaxunshear_experiment")
    except (Exception, SystemExit) as error:
        raise UserError(f"experiment file {path} {_failure(path, error)}") from error
    for name, kind in kinds.items():
        found = variables.get(name)
        if found is not None and not isinstance(found, kind):
            raise UserError(f"experiment file {path}: `{name}` is of type {type(found).__name__}, not {kind.__name__}")
        if found is not None:
            return found
    if "sweep" in variables:
        raise UserError(f"experiment file {path} defines a sweep: run it with `jaxunshear sweep {path}`")
    name, kind = next(iter(kinds.items()))
    raise UserError(f"experiment file {path} defines no variable `{name}`: add {name} = {kind.__name__}(...)")


def override(experiment: Experiment, argv: Sequence[str]) -> Experiment:
    """`experiment` with fields replaced: `--train.epochs 5` or `--train.epochs=5`, several at will; the last wins."""
    for name, value in parse_overrides(argv):
        experiment = replaced(experiment, name, value)
    return experiment


def replaced(experiment: Experiment, name: str, value: Any) -> Experiment:
    """`experiment` with the field of this dotted name replaced; its type is for `check_types` to judge.

    Raises `UserError` where there is no such field.
    """
    kinds = dict(field_types())
    if name not in kinds:
        raise UserError(f"there is no field --{name}{_suggestion(name, kinds)}")
    return _replaced(experiment, name.split("."), value)


def parse_overrides(argv: Sequence[str]) -> list[tuple[str, Any]]:
    """Dotted names and parsed values of `--name value` or `--name=value`; names and types are refused here, by name."""
    kinds, pairs = dict(field_types()), []
    words = iter(argv)
    for word in words:
        if not word.startswith("--"):
            raise UserError(f"argument '{word}' is not understood: fields are changed by --name value")
        name, equals, text = word[2:].partition("=")
        if name not in kinds:
            raise UserError(f"there is no field --{name}{_suggestion(name, kinds)}")
        if not equals:
            text = next(words, None)  # type: ignore[assignment]
            if text is None or text.startswith("--"):
                raise UserError(f"--{name} needs a value: {_describe(kinds[name])}")
        pairs.append((name, _parse(text, kinds[name], name)))
    return pairs


def split_overrides(argv: Sequence[str], own: Iterable[str], flags: Iterable[str]) -> tuple[list[str], list[str]]:
    """Parts a command line: what argparse reads, and every `--name value` where --name is not of `own`.

    No value follows `flags`.
    """
    kept: list[str] = []
    fields: list[str] = []
    words = iter(argv)
    for word in words:
        is_field = word.startswith("--") and word.partition("=")[0] not in own
        (fields if is_field else kept).append(word)
        if word.startswith("--") and "=" not in word and word not in flags:
            (fields if is_field else kept).extend([value] if (value := next(words, None)) is not None else [])
    return kept, fields


def to_json(experiment: Experiment) -> dict[str, Any]:
    """`experiment` as nested dictionaries and lists."""
    return dataclasses.asdict(experiment)


def from_json(data: Any, source: str = "experiment.json") -> Experiment:
    """The inverse of `to_json`; unknown and missing fields and wrong types are refused by name, but those that an earlier version did not
    write (`earlier.py`)."""
    return build(data, Experiment, source, "")


def field_types(kind: type = Experiment, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and types of all fields that can be overridden; `sensor` itself takes a name.

    No `config` and no `digest`: they name settings and set none. A group that may be of several kinds has the fields of all.
    """
    for field in dataclasses.fields(kind):
        if field.name in NOT_SET:
            continue
        hint = _hints(kind)[field.name]
        groups = _groups(hint)
        if not groups or hint is Sensor:
            yield prefix + field.name, hint
        known: dict[str, Any] = {}
        for group in groups:
            known |= dict(field_types(group, f"{prefix}{field.name}."))
        yield from known.items()


def check_types(experiment: Experiment) -> None:
    """Refuses, by dotted name, values that an experiment file gave the wrong type; NaN and infinity count as wrong."""
    _check(experiment, Experiment, "")


def validate(experiment: Experiment) -> None:
    """Refuses values no run could work with, by dotted name and with a remedy: sizes, ranges, counts, unknown names."""
    from jaxunshear.limits import limits  # the table of rules is long: see there

    check_types(experiment)
    for ok, name, complaint in limits(experiment):
        if not ok:
            value = functools.reduce(getattr, name.split("."), experiment)
            raise UserError(f"--{name} {show(value)}: {complaint}")


def _failure(path: Path, error: BaseException) -> str:
    if "null bytes" in str(error) or "codec can't decode" in str(error):
        return "is not text: name a Python file"
    if isinstance(error, SyntaxError):
        return f"has a syntax error in line {error.lineno}: {error.msg}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    where = f" in line {lines[-1]}" if lines else ""
    return f"fails{where}: {type(error).__name__}: {' '.join(str(error).split())}"


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _suggestion(name: str, kinds: Iterable[str]) -> str:
    kinds = list(kinds)
    if name in ("paired.config", "pose.config"):
        return ": a configuration is chosen by the experiment's file; run another one, or change its fields"
    inside = [kind for kind in kinds if kind.startswith(name + ".")]
    if inside:
        return (
            f": it is a group, with {', '.join('--' + kind for kind in inside[:4])}{', ...' if len(inside) > 4 else ''}"
        )
    last = [kind for kind in kinds if kind.rpartition(".")[2] == name.rpartition(".")[2]]
    near = (
        difflib.get_close_matches(name, kinds, n=1, cutoff=0.7)
        or last[:3]
        or difflib.get_close_matches(name, kinds, n=1)
    )
    return f": did you mean {' or '.join('--' + kind for kind in near)}?" if near else ": see `jaxunshear run --help`"


def _replaced(node: Any, path: list[str], value: Any) -> Any:
    if not hasattr(node, path[0]):
        raise UserError(f"this experiment has no field {path[0]} there: its {type(node).__name__} has other fields")
    if len(path) > 1:
        value = _replaced(getattr(node, path[0]), path[1:], value)
    return dataclasses.replace(node, **{path[0]: value})


def _groups(kind: Any) -> list[type]:
    """The dataclasses that a field may hold: none, one, or those of a union."""
    kinds = typing.get_args(kind) if typing.get_origin(kind) in (types.UnionType, typing.Union) else (kind,)
    return [typing.cast(type, each) for each in kinds if dataclasses.is_dataclass(each)]


def _optional(kind: Any) -> Any:
    """The X of `X | None`, else None."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union) and not _groups(kind):
        (inner,) = [arg for arg in typing.get_args(kind) if arg is not types.NoneType]
        return inner
    return None


def _describe(kind: Any) -> str:
    if _optional(kind) is not None:
        return f"{_describe(_optional(kind))}, or none"
    if typing.get_origin(kind) is tuple:
        inner, *more = typing.get_args(kind)
        if more[-1:] != [...]:
            return "numbers joined by ':'"
        return {int: "integers", float: "numbers", str: "names"}.get(inner, "pairs a:b") + " separated by commas"
    return {int: "an integer", float: "a number", bool: "true or false", str: "text", Sensor: "a sensor's name"}[kind]


def _parse(text: str, kind: Any, name: str) -> Any:
    """`text` as a value of `kind`; tuples are comma lists, tuples within them are joined by colons."""
    try:
        return _parsed(text.strip(), kind)
    except ValueError:
        raise UserError(f"--{name} takes {_describe(kind)}, not '{text}'") from None


def _parsed(text: str, kind: Any) -> Any:
    if (inner := _optional(kind)) is not None:
        return None if text.lower() == "none" else _parsed(text, inner)
    if typing.get_origin(kind) is tuple:
        first, *more = typing.get_args(kind)
        if more[-1:] == [...]:
            return tuple(_parsed(item.strip(), first) for item in text.split(",")) if text else ()
        items = text.split(":")
        return tuple(_parsed(item.strip(), part) for item, part in zip(items, (first, *more), strict=True))
    if kind is bool:
        return {"true": True, "false": False}.get(text.lower()) if text.lower() in ("true", "false") else _refuse()
    if kind is Sensor:
        return sensor_named(text)
    return kind(text)


def _refuse() -> typing.NoReturn:
    raise ValueError


def _check(value: Any, kind: Any, name: str) -> None:
    if groups := _groups(kind):
        own = next((group for group in groups if isinstance(value, group)), None)
        if own is None:
            wanted = " or ".join(group.__name__ for group in groups)
            raise UserError(f"{name or 'experiment'} is of type {type(value).__name__}, not {wanted}")
        for field, hint in _hints(own).items():
            _check(getattr(value, field), hint, f"{name}.{field}".lstrip("."))
    elif isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"--{name} must be a finite number, not {value}")
    elif not _fits(value, kind):
        raise UserError(f"--{name} takes {_describe(kind)}, not {value!r}")


def _fits(value: Any, kind: Any) -> bool:
    if (inner := _optional(kind)) is not None:
        return value is None or _fits(value, inner)
    if typing.get_origin(kind) is tuple:
        first, *more = typing.get_args(kind)
        if not isinstance(value, tuple):
            return False
        kinds = (first,) * len(value) if more[-1:] == [...] else (first, *more)
        return len(value) == len(kinds) and all(_fits(v, k) for v, k in zip(value, kinds, strict=True))
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def build(data: Any, kind: Any, source: str, name: str) -> Any:
    if groups := _groups(kind):
        given = set(data) if isinstance(data, dict) else set()
        own = next((group for group in groups if _fills(given, set(_hints(group)))), groups[0])
        hints = _hints(own)
        if not isinstance(data, dict) or not _fills(given, set(hints)):
            odd = sorted((given ^ set(hints)) - (set(hints) & set(LATER))) if isinstance(data, dict) else ["all of it"]
            raise UserError(
                f"{source} does not fit this version: see {name or 'its top level'}, {', '.join(odd)}; run it again"
            )
        parts = {
            field: build(data[field] if field in data else LATER[field], hint, source, f"{name}.{field}".lstrip("."))
            for field, hint in hints.items()
        }
        return own(**parts)
    value = _tupled(data)
    if not _fits(value, kind):
        raise UserError(f"{source}: {name} takes {_describe(kind)}, not {data!r}")
    return value


def _fills(given: set[str], fields: set[str]) -> bool:
    """Whether a file that gives these has all that is not LATER, and nothing else."""
    return given <= fields and fields - given <= set(LATER)


def _tupled(data: Any) -> Any:
    return tuple(_tupled(item) for item in data) if isinstance(data, list) else data


def show(value: Any) -> str:
    """A field's value as it is written on the command line; a sensor by its name."""
    if isinstance(value, Sensor):
        return value.name
    if isinstance(value, tuple):
        return ",".join(":".join(map(str, item)) if isinstance(item, tuple) else str(item) for item in value) or "''"
    return str(value).lower() if isinstance(value, bool) else str(value)
