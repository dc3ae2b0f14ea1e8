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
from collections.abc import Iterator
from typing import Any

from jaxunshear.errors import UserError

Hint = Any  # a type as annotations write it
Value = Any  # of a field, or of each of several
Rule = tuple[bool, str, str]


def check_types(settings: object) -> None:
    """Refuses, by dotted name, values that an experiment file gave the wrong type; NaN and infinity count as wrong."""
    _check(settings, type(settings), "")


def own_rules(settings: object, group: str = "") -> Iterator[Rule]:
    """The rules of `settings` and of the groups in it, each beside its definition; fields by dotted name."""
    kind: type = type(settings)
    for field, hint in hints(kind).items():
        value = getattr(settings, field)
        if known := choices(hint):
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
    for field in hints(kind):
        if dataclasses.is_dataclass(value := getattr(settings, field)):
            yield from own_rules(value, f"{group}{field}.")


def check_rules(settings: object, what: str) -> None:
    """Raises `UserError` that names `what` these settings are of, and the first field that cannot be."""
    for holds, field, remedy in own_rules(settings):
        if not holds:
            raise UserError(f"{what}: {field} = {value_of(settings, field)}: {remedy}")


def value_of(settings: object, name: str) -> Value:
    """Of the field of this dotted name."""
    return functools.reduce(getattr, name.split("."), settings)


@functools.cache
def hints(kind: type) -> dict[str, Hint]:
    """Fields of a group of settings and their types."""
    return typing.get_type_hints(kind)


def origin(kind: Hint) -> object:
    """`tuple` of `tuple[int, ...]`; None of a plain type."""
    return typing.get_origin(kind)


def groups(kind: Hint) -> list[type]:
    """The dataclasses that a field may hold: none, one, or those of a union."""
    kinds = typing.get_args(kind) if origin(kind) in (types.UnionType, typing.Union) else (kind,)
    return [typing.cast(type, each) for each in kinds if dataclasses.is_dataclass(each)]


def optional(kind: Hint) -> Hint:
    """The X of `X | None`, else None."""
    if origin(kind) in (types.UnionType, typing.Union) and not groups(kind):
        (inner,) = [arg for arg in typing.get_args(kind) if arg is not types.NoneType]
        return inner
    return None


def choices(kind: Hint) -> tuple[str, ...]:
    """The names that a field takes, or a tuple of them; none where it takes none."""
    if origin(kind) is tuple:
        return choices(typing.get_args(kind)[0])
    if origin(kind) in (types.UnionType, typing.Union):
        return tuple(name for part in typing.get_args(kind) for name in choices(part))
    return typing.get_args(kind) if origin(kind) is typing.Literal else ()


def describe(kind: Hint) -> str:
    """What a field takes, in words."""
    if optional(kind) is not None:
        return f"{describe(optional(kind))}, or none"
    if origin(kind) is tuple:
        inner, *more = typing.get_args(kind)
        if more[-1:] != [...]:
            return "numbers joined by ':'"
        if groups(inner):
            return "names, or files of outlines, separated by commas"
        plural = (
            "names"
            if choices(inner)
            else {int: "integers", float: "numbers", str: "names"}.get(inner, "pairs a:b")
        )
        return f"{plural} separated by commas"
    if known := choices(kind):
        return f"one of {', '.join(known)}"
    if dataclasses.is_dataclass(kind):
        return f"a {typing.cast(type, kind).__name__.lower()}'s name"
    return {int: "an integer", float: "a number", bool: "true or false", str: "text"}[kind]


def fits(value: Any, kind: Hint) -> bool:
    """Whether a value is of a field's type; whether a name is a known one is for `own_rules`."""
    if (inner := optional(kind)) is not None:
        return value is None or fits(value, inner)
    if origin(kind) is tuple:
        first, *more = typing.get_args(kind)
        if not isinstance(value, tuple):
            return False
        kinds = (first,) * len(value) if more[-1:] == [...] else (first, *more)
        return len(value) == len(kinds) and all(
            fits(v, k) for v, k in zip(value, kinds, strict=True)
        )
    if choices(kind):
        return isinstance(value, (str, *groups(kind)))
    if kind is float:
        return (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max
        )
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def _check(value: object, kind: Hint, name: str) -> None:
    if kinds := groups(kind):
        own = next((group for group in kinds if isinstance(value, group)), None)
        if own is None:
            wanted = " or ".join(group.__name__ for group in kinds)
            raise UserError(
                f"{name or 'experiment'} is of type {type(value).__name__}, not {wanted}"
            )
        for field, hint in hints(own).items():
            _check(getattr(value, field), hint, f"{name}.{field}".lstrip("."))
    elif isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"--{name} must be a finite number, not {value}")
    elif not fits(value, kind):
        raise UserError(f"--{name} takes {describe(kind)}, not {value!r}")
