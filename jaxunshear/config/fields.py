"""Single settings by dotted name: read from a command line, replaced, shown.

>>> experiment = override_fields(load_experiment("experiments/demo.py"), ["--train.epochs", "5", "--sensor", "tactip127"])
>>> validate(experiment)
"""

import dataclasses
import difflib
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.sensor import Sensor, get_sensor
from jaxunshear.config.types import (
    Hint,
    Value,
    describe_hint,
    get_optional,
    get_origin,
    is_weights,
    list_choices,
    list_groups,
    list_hints,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json

NOT_SETTABLE = ("config", "digest")


def override_fields(experiment: Experiment, argv: Sequence[str]) -> Experiment:
    """`experiment` with fields replaced: `--train.epochs 5` or `--train.epochs=5`, several at will; the last wins."""
    for name, value in parse_overrides(argv):
        experiment = replace_field(experiment, name, value)
    return experiment


def replace_field(experiment: Experiment, name: str, value: object) -> Experiment:
    """`experiment` with the field of this dotted name replaced; its type is for `check_types` to judge.

    Raises `UserError` where there is no such field.
    """
    _find_field_type(name, dict(list_field_types()))
    return _replace_at_path(experiment, name.split("."), value)


def _find_field_type(name: str, kinds: Mapping[str, Hint]) -> Hint:
    """Return the type of a field, or of one weight of a field of weights. Raises UserError."""
    group, _, part = name.rpartition(".")
    if part and is_weights(kinds.get(group)):
        return float
    if name not in kinds:
        raise UserError(f"there is no field --{name}{_suggestion(name, kinds)}")
    return kinds[name]


def parse_overrides(argv: Sequence[str]) -> list[tuple[str, Value]]:
    """Dotted names and parsed values of `--name value` or `--name=value`; names and types are refused here, by name."""
    kinds, pairs = dict(list_field_types()), []
    words = iter(argv)
    for word in words:
        if not word.startswith("--"):
            raise UserError(
                f"argument '{word}' is not understood: fields are changed by --name value"
            )
        name, equals, text = word[2:].partition("=")
        kind = _find_field_type(name, kinds)
        if not equals:
            text = next(words, None)  # type: ignore[assignment]
            if text is None or text.startswith("--"):
                raise UserError(f"--{name} needs a value: {describe_hint(kind)}")
        pairs.append((name, _parse(text, kind, name)))
    return pairs


def split_overrides(
    argv: Sequence[str], own: Iterable[str], flags: Iterable[str]
) -> tuple[list[str], list[str]]:
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
            (fields if is_field else kept).extend(
                [value] if (value := next(words, None)) is not None else []
            )
    return kept, fields


def list_field_types(kind: type = Experiment, prefix: str = "") -> Iterator[tuple[str, Hint]]:
    """Dotted names and types of all fields that can be overridden; `sensor` itself takes a name.

    No `config` and no `digest`: they name settings and set none. A group that may be of several kinds has the fields of all.
    """
    for field in dataclasses.fields(kind):
        if field.name in NOT_SETTABLE:
            continue
        hint = list_hints(kind)[field.name]
        kinds = list_groups(hint)
        if not kinds or hint is Sensor:
            yield prefix + field.name, hint
        known: Json = {}
        for group in kinds:
            known |= dict(list_field_types(group, f"{prefix}{field.name}."))
        yield from known.items()


def format_value(value: object) -> str:
    """A field's value as it is written on the command line; a sensor by its name."""
    if isinstance(value, Sensor):
        return value.name
    if isinstance(value, Mapping):
        return ",".join(f"{name}:{weight}" for name, weight in value.items()) or "''"
    if isinstance(value, tuple):
        return (
            ",".join(
                ":".join(map(str, item)) if isinstance(item, tuple) else str(item) for item in value
            )
            or "''"
        )
    return str(value).lower() if isinstance(value, bool) else str(value)


def _suggestion(name: str, kinds: Iterable[str]) -> str:
    kinds = list(kinds)
    if name in ("paired.config", "pose.config"):
        return ": a configuration is chosen by the experiment's file; run another one, or change its fields"
    inside = [kind for kind in kinds if kind.startswith(name + ".")]
    if inside:
        return f": it is a group, with {', '.join('--' + kind for kind in inside[:4])}{', ...' if len(inside) > 4 else ''}"
    last = [kind for kind in kinds if kind.rpartition(".")[2] == name.rpartition(".")[2]]
    near = (
        difflib.get_close_matches(name, kinds, n=1, cutoff=0.7)
        or last[:3]
        or difflib.get_close_matches(name, kinds, n=1)
    )
    return (
        f": did you mean {' or '.join('--' + kind for kind in near)}?"
        if near
        else ": see `jaxunshear run --help`"
    )


def _replace_at_path(node: Any, path: list[str], value: object) -> Any:
    if isinstance(node, Mapping):
        return {**node, path[0]: value}
    if not hasattr(node, path[0]):
        raise UserError(
            f"this experiment has no field {path[0]} there: its {type(node).__name__} has other fields"
        )
    if len(path) > 1:
        value = _replace_at_path(getattr(node, path[0]), path[1:], value)
    return dataclasses.replace(node, **{path[0]: value})


def _parse(text: str, kind: Hint, name: str) -> Value:
    """`text` as a value of `kind`; tuples are comma lists, tuples within them are joined by colons."""
    try:
        return _parse_value(text.strip(), kind)
    except ValueError:
        raise UserError(f"--{name} takes {describe_hint(kind)}, not '{text}'") from None


def _parse_value(text: str, kind: Hint) -> Value:
    if (inner := get_optional(kind)) is not None:
        return None if text.lower() == "none" else _parse_value(text, inner)
    if get_origin(kind) is tuple:
        first, *more = typing.get_args(kind)
        if more[-1:] == [...]:
            return (
                tuple(_parse_value(item.strip(), first) for item in text.split(",")) if text else ()
            )
        items = text.split(":")
        return tuple(
            _parse_value(item.strip(), part)
            for item, part in zip(items, (first, *more), strict=True)
        )
    if is_weights(kind):
        pairs = [item.split(":") for item in text.split(",") if item]
        return {name.strip(): float(weight) for name, weight in pairs}
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError
        return text.lower() == "true"
    if kind is Sensor:
        return get_sensor(text)
    if list_choices(kind):
        return parse_stimulus(text) if list_groups(kind) else text
    return kind(text)
