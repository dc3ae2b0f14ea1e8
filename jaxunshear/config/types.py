"""What settings are made of: frozen dataclasses whose fields have types, names of a few, and rules of their own. Imports nothing of ours
but errors.

A rule is (holds, field, what is wrong and what to do instead). Later rules may rely on earlier ones.
"""

import dataclasses
import functools
import math
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from jaxunshear.errors import UserError

Hint = Any  # a type as annotations write it
Value = Any  # of a field, or of each of several
Rule = tuple[bool, str, str]


def check_types(settings: object) -> None:
    """Refuses, by dotted name, values that an experiment file gave the wrong type; NaN and infinity count as wrong."""
    _check(settings, type(settings), "")


def list_own_rules(settings: object, group: str = "") -> Iterator[Rule]:
    """The rules of `settings` and of the groups in it, each beside its definition; fields by dotted name."""
    kind: type = type(settings)
    for field, hint in list_hints(kind).items():
        value = getattr(settings, field)
        if known := list_choices(hint):
            named = (
                one
                for one in (value if isinstance(value, tuple) else (value,))
                if isinstance(one, str)
            )
            odd = ", ".join(one for one in named if one not in known)
            which = f"{odd} is" if isinstance(value, tuple) else "is"
            yield not odd, f"{group}{field}", f"{which} unknown: use one of {', '.join(known)}"
    for holds, field, remedy in settings.rules() if hasattr(settings, "rules") else ():
        yield holds, f"{group}{field}", remedy
    for field in list_hints(kind):
        if dataclasses.is_dataclass(value := getattr(settings, field)):
            yield from list_own_rules(value, f"{group}{field}.")


def check_rules(settings: object, what: str) -> None:
    """Raises `UserError` that names `what` these settings are of, and the first field that cannot be."""
    for holds, field, remedy in list_own_rules(settings):
        if not holds:
            raise UserError(f"{what}: {field} = {get_value(settings, field)}: {remedy}")


def get_value(settings: object, name: str) -> Value:
    """Return the value of the field of this dotted name; 0 for a weight that is not there."""
    return functools.reduce(_get_part, name.split("."), settings)


def _get_part(settings: object, name: str) -> Value:
    return settings.get(name, 0.0) if isinstance(settings, Mapping) else getattr(settings, name)


def is_weights(kind: Hint) -> bool:
    """Return whether a field holds weights by name."""
    return get_origin(kind) is Mapping


@functools.cache
def list_hints(kind: type) -> dict[str, Hint]:
    """Fields of a group of settings and their types."""
    return typing.get_type_hints(kind)


def get_origin(kind: Hint) -> object:
    """`tuple` of `tuple[int, ...]`; None of a plain type."""
    return typing.get_origin(kind)


def list_groups(kind: Hint) -> list[type]:
    """The dataclasses that a field may hold: none, one, or those of a union."""
    kinds = (
        typing.get_args(kind) if get_origin(kind) in (types.UnionType, typing.Union) else (kind,)
    )
    return [typing.cast(type, each) for each in kinds if dataclasses.is_dataclass(each)]


def get_optional(kind: Hint) -> Hint:
    """The X of `X | None`, else None."""
    if get_origin(kind) in (types.UnionType, typing.Union) and not list_groups(kind):
        (inner,) = [arg for arg in typing.get_args(kind) if arg is not types.NoneType]
        return inner
    return None


def list_choices(kind: Hint) -> tuple[str, ...]:
    """The names that a field takes, or a tuple of them; none where it takes none."""
    if get_origin(kind) is tuple:
        return list_choices(typing.get_args(kind)[0])
    if get_origin(kind) in (types.UnionType, typing.Union):
        return tuple(name for part in typing.get_args(kind) for name in list_choices(part))
    return typing.get_args(kind) if get_origin(kind) is typing.Literal else ()


def describe_hint(kind: Hint) -> str:
    """What a field takes, in words."""
    if get_optional(kind) is not None:
        return f"{describe_hint(get_optional(kind))}, or none"
    if get_origin(kind) is tuple:
        inner, *more = typing.get_args(kind)
        if more[-1:] != [...]:
            return "numbers joined by ':'"
        if list_groups(inner):
            return "names, or files of outlines, separated by commas"
        plural = (
            "names"
            if list_choices(inner)
            else {int: "integers", float: "numbers", str: "names"}.get(inner, "pairs a:b")
        )
        return f"{plural} separated by commas"
    if is_weights(kind):
        return "pairs name:weight separated by commas"
    if known := list_choices(kind):
        return f"one of {', '.join(known)}"
    if dataclasses.is_dataclass(kind):
        return f"a {typing.cast(type, kind).__name__.lower()}'s name"
    return {int: "an integer", float: "a number", bool: "true or false", str: "text"}[kind]


def is_of_type(value: Any, kind: Hint) -> bool:
    """Whether a value is of a field's type; whether a name is a known one is for `list_own_rules`."""
    if (inner := get_optional(kind)) is not None:
        return value is None or is_of_type(value, inner)
    if get_origin(kind) is tuple:
        first, *more = typing.get_args(kind)
        if not isinstance(value, tuple):
            return False
        kinds = (first,) * len(value) if more[-1:] == [...] else (first, *more)
        return len(value) == len(kinds) and all(
            is_of_type(v, k) for v, k in zip(value, kinds, strict=True)
        )
    if is_weights(kind):
        return isinstance(value, Mapping) and all(
            isinstance(name, str) and is_of_type(weight, float) for name, weight in value.items()
        )
    if list_choices(kind):
        return isinstance(value, (str, *list_groups(kind)))
    if kind is float:
        return (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max
        )
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def _check(value: object, kind: Hint, name: str) -> None:
    if kinds := list_groups(kind):
        own = next((group for group in kinds if isinstance(value, group)), None)
        if own is None:
            wanted = " or ".join(group.__name__ for group in kinds)
            raise UserError(
                f"{name or 'experiment'} is of type {type(value).__name__}, not {wanted}"
            )
        for field, hint in list_hints(own).items():
            _check(getattr(value, field), hint, f"{name}.{field}".lstrip("."))
    elif isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"--{name} must be a finite number, not {value}")
    elif isinstance(value, Mapping) and is_weights(kind):
        for part, weight in value.items():
            _check(weight, float, f"{name}.{part}")
    elif not is_of_type(value, kind):
        raise UserError(f"--{name} takes {describe_hint(kind)}, not {value!r}")
