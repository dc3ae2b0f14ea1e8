"""What settings are made of: frozen dataclasses with typed fields, which find their own problems.

Imports nothing of this package but errors.
"""

import dataclasses
import functools
import math
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, NamedTuple

from jaxunshear.errors import UserError

Hint = Any  # a type as annotations write it
Value = Any  # of a field, or of each of several


class Problem(NamedTuple):
    """A value that cannot work. What finds it may rely on there being no problem before it."""

    field: str  # which the message names
    remedy: str  # what is wrong with its value, and what to do instead


class Bound(NamedTuple):
    """A condition on each value of a field, which stands in the type of the field.

    >>> epochs: Annotated[float, Bound(lambda value: value > 0, "must be above zero")] = 6.0
    """

    holds: Callable[[Value], bool]
    remedy: str


def between(low: float, high: float) -> Bound:
    """Make the bound that a value is at least `low` and at most `high`."""
    return Bound(lambda value: low <= value <= high, f"use {low} to {high}")


Positive = Annotated[float, Bound(lambda value: value > 0, "must be above zero")]
NotNegative = Annotated[float, Bound(lambda value: value >= 0, "must not be below zero")]
Count = Annotated[int, Bound(lambda value: value >= 1, "must be at least 1")]
Share = Annotated[float, Bound(lambda value: 0 < value <= 1, "use a share above 0, at most 1")]
Fraction = Annotated[float, Bound(lambda value: 0 <= value < 1, "use 0 up to, but not, 1")]
Counts = Annotated[
    tuple[int, ...], Bound(lambda each: all(n >= 1 for n in each), "list positive numbers")
]


def find_problems(settings: object, group: str = "") -> Iterator[Problem]:
    """Find problems of `settings` and of the groups in it: by its types and its `find_problems`."""
    kind: type = type(settings)
    hints = list_hints(kind)
    values = {field: getattr(settings, field) for field in hints}
    for field, hint in hints.items():
        choices, value = list_choices(hint), values[field]
        items = value if isinstance(value, tuple) else (value,)
        unknown = ", ".join(
            item or "''" for item in items if isinstance(item, str) and item not in choices
        )
        if choices and unknown:
            subject = f"{unknown} is" if isinstance(value, tuple) else "is"
            remedy = f"{subject} unknown: use one of {', '.join(choices)}"
            yield Problem(f"{group}{field}", remedy)
        for bound in list_bounds(kind).get(field, ()):
            if not bound.holds(value):
                yield Problem(f"{group}{field}", bound.remedy)
    for field, remedy in settings.find_problems() if hasattr(settings, "find_problems") else ():
        yield Problem(f"{group}{field}", remedy)
    for field in hints:
        if dataclasses.is_dataclass(values[field]):
            yield from find_problems(values[field], f"{group}{field}.")


def raise_first_problem(settings: object, what: str) -> None:
    """Raise UserError for the first problem of `settings`, called `what`."""
    for field, remedy in find_problems(settings):
        raise UserError(f"{what}: {field} = {get_value(settings, field)}: {remedy}")


def get_value(settings: Value, name: str) -> Value:
    """Return the value of the field of this dotted name; 0 for a weight that is not there."""
    for part in name.split("."):
        is_weight = isinstance(settings, Mapping)
        settings = settings.get(part, 0.0) if is_weight else getattr(settings, part)
    return settings


def get_origin(kind: Hint) -> object:
    """Return `tuple` for `tuple[int, ...]`, None for a plain type; mypy mistypes typing's own."""
    return typing.get_origin(kind)


def is_weights(kind: Hint) -> bool:
    """Return whether a field holds weights by name."""
    return get_origin(kind) is Mapping


@functools.cache
def list_hints(kind: type) -> dict[str, Hint]:
    """Return the fields of a group of settings and their types."""
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


@functools.cache
def list_bounds(kind: type) -> dict[str, list[Bound]]:
    """Return the bounds in the types of the fields of a group of settings."""
    bounds: dict[str, list[Bound]] = {}
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        metadata = getattr(hint, "__metadata__", ())
        bounds[name] = [each for each in metadata if isinstance(each, Bound)]
    return bounds


def list_groups(kind: Hint) -> list[type]:
    """Return the dataclasses that a field may hold: none, one, or those of a union or registry."""
    groups: list[type] = []
    for each in typing.get_args(kind) if _is_union(kind) else (kind,):
        registered = getattr(each, "__dict__", {}).get("registered")
        if isinstance(registered, dict):
            groups += registered.values()
        elif dataclasses.is_dataclass(each):
            groups.append(typing.cast(type, each))
    return groups


def get_optional(kind: Hint) -> Hint:
    """Return the X of `X | None`, else None."""
    if _is_union(kind) and not list_groups(kind):
        (inner,) = [arg for arg in typing.get_args(kind) if arg is not types.NoneType]
        return inner
    return None


def list_choices(kind: Hint) -> tuple[str, ...]:
    """Return the names that a field, or a tuple in it, may hold; none if it may hold any."""
    if get_origin(kind) is tuple:
        return list_choices(typing.get_args(kind)[0])
    if _is_union(kind):
        return tuple(name for part in typing.get_args(kind) for name in list_choices(part))
    return typing.get_args(kind) if get_origin(kind) is typing.Literal else ()


def _is_union(kind: Hint) -> bool:
    return get_origin(kind) in (types.UnionType, typing.Union)


def describe_hint(kind: Hint) -> str:
    """Describe in words what a field takes."""
    if get_optional(kind) is not None:
        return f"{describe_hint(get_optional(kind))}, or none"
    if get_origin(kind) is tuple:
        return _describe_tuple(kind)
    if is_weights(kind):
        return "pairs name:weight separated by commas"
    if choices := list_choices(kind):
        return f"one of {', '.join(choices)}"
    if dataclasses.is_dataclass(kind):
        return f"a {typing.cast(type, kind).__name__.lower()}'s name"
    return {int: "an integer", float: "a number", bool: "true or false", str: "text"}[kind]


def _describe_tuple(kind: Hint) -> str:
    item, *more = typing.get_args(kind)
    if more[-1:] != [...]:
        return "numbers joined by ':'"
    if list_groups(item):
        return "names, or files of outlines, separated by commas"
    if list_choices(item):
        return "names separated by commas"
    plurals = {int: "integers", float: "numbers", str: "names"}
    return f"{plurals.get(item, 'pairs a:b')} separated by commas"


def is_of_type(value: Any, kind: Hint) -> bool:
    """Return whether a value is of a field's type; any text passes for one of its names."""
    if kind is Value:
        return True
    if _is_union(kind) and not list_groups(kind):
        return any(is_of_type(value, each) for each in typing.get_args(kind))
    if get_origin(kind) is tuple:
        kinds = typing.get_args(kind)
        if not isinstance(value, tuple):
            return False
        if kinds[-1] is ...:
            return all(is_of_type(item, kinds[0]) for item in value)
        return len(value) == len(kinds) and all(map(is_of_type, value, kinds))
    if is_weights(kind):
        return isinstance(value, Mapping) and all(
            isinstance(name, str) and is_of_type(weight, float) for name, weight in value.items()
        )
    if list_choices(kind):
        return isinstance(value, (str, *list_groups(kind)))
    if kind is bool or isinstance(value, bool):  # a bool is an int to Python
        return kind is bool and isinstance(value, bool)
    if kind is float:
        return isinstance(value, int | float) and abs(value) <= sys.float_info.max
    return isinstance(value, kind)


def check_types(settings: object) -> None:
    """Refuse, by dotted name, values of a wrong type; NaN and infinity count as wrong."""
    _check(settings, type(settings), "")


def _check(value: object, kind: Hint, name: str) -> None:
    if kinds := list_groups(kind):
        group = next((each for each in kinds if isinstance(value, each)), None)
        if group is None:
            expected = " or ".join(each.__name__ for each in kinds)
            raise UserError(
                f"{name or 'experiment'} is of type {type(value).__name__}, not {expected}"
            )
        for field, hint in list_hints(group).items():
            _check(getattr(value, field), hint, f"{name}.{field}".lstrip("."))
    elif isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"--{name} must be a finite number, not {value}")
    elif isinstance(value, Mapping) and is_weights(kind):
        for part, weight in value.items():
            _check(weight, float, f"{name}.{part}")
    elif not is_of_type(value, kind):
        raise UserError(f"--{name} takes {describe_hint(kind)}, not {value!r}")
