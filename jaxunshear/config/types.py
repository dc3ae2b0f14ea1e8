"""What settings are made of: frozen dataclasses of typed fields, which find their own problems."""

import dataclasses
import functools
import math
import sys
import types
import typing
from collections.abc import Callable, Container, Iterator, Mapping
from typing import Annotated, Any, NamedTuple

from jaxunshear.errors import UserError

Hint = Any  # a type as annotations write it
Value = Any  # of a field, or of each of several
get_origin: Callable[[Hint], object] = typing.get_origin  # mypy mistypes typing's own
# The field that a message names, and what is wrong with its value and what to do instead. What
# finds a problem may rely on there being none before it.
Problem = tuple[str, str]


# What experiment files have registered, by what it is and its name: the file.
REGISTERED: dict[tuple[str, str], str] = {}


def claim_name(kind: str, name: str, names: Container[str], file: str) -> None:
    """Claim a name for what an experiment file registers; a file may be read twice.

    Raises UserError if the package or another file has the name.
    """
    if REGISTERED.get((kind, name), "" if name in names else file) != file:
        raise UserError(f"{kind} '{name}' is there already: choose another name")
    REGISTERED[kind, name] = file


def list_registering_files() -> list[str]:
    """List the experiment files that have registered something; processes of a sweep run them."""
    return sorted(set(REGISTERED.values()))


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
WEIGHTS = Mapping[str, float]  # the type of fields that hold weights by name
DESCRIPTIONS: dict[Hint, str] = {  # of what a field of a type takes
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "text",
    tuple[int, ...]: "integers separated by commas",
    tuple[float, ...]: "numbers separated by commas",
    tuple[str, ...]: "names separated by commas",
    tuple[tuple[float, float], ...]: "pairs a:b separated by commas",
    WEIGHTS: "pairs name:weight separated by commas",
}


def find_problems(settings: object, group: str = "") -> Iterator[Problem]:
    """Find problems of `settings` and of the groups in it: by its types and its `find_problems`."""
    kind: type = type(settings)
    values = {}
    for field, hint in list_hints(kind, include_extras=True).items():
        choices, value = list_choices(hint), getattr(settings, field)
        values[field] = value
        items = value if isinstance(value, tuple) else (value,)
        unknown = ", ".join(
            item or "''" for item in items if isinstance(item, str) and item not in choices
        )
        if choices and unknown:
            subject = f"{unknown} is" if isinstance(value, tuple) else "is"
            yield f"{group}{field}", f"{subject} unknown: use one of {', '.join(choices)}"
        for bound in getattr(hint, "__metadata__", ()):
            if isinstance(bound, Bound) and not bound.holds(value):
                yield f"{group}{field}", bound.remedy
    for field, remedy in settings.find_problems() if hasattr(settings, "find_problems") else ():
        yield f"{group}{field}", remedy
    for field, value in values.items():
        if dataclasses.is_dataclass(value):
            yield from find_problems(value, f"{group}{field}.")


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


def replace_value(settings: Any, name: str, value: Value) -> Any:
    """Replace the field of this dotted name. Raises UserError if these settings lack it."""
    first, _, rest = name.partition(".")
    if isinstance(settings, Mapping):
        return {**settings, name: value}
    fields = dataclasses.fields(settings) if dataclasses.is_dataclass(settings) else ()
    if first not in [field.name for field in fields]:
        raise UserError(
            f"this experiment has no field {first} there: "
            f"its {type(settings).__name__} has other fields"
        )
    if rest:
        value = replace_value(getattr(settings, first), rest, value)
    return dataclasses.replace(settings, **{first: value})


@functools.cache
def list_hints(kind: type, include_extras: bool = False) -> dict[str, Hint]:
    """Return the fields of a group of settings and their types."""
    hints = typing.get_type_hints(kind, include_extras=include_extras)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


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
    kinds = typing.get_args(kind)
    if kind in DESCRIPTIONS:
        return DESCRIPTIONS[kind]
    if types.NoneType in kinds:
        return f"{describe_hint(kinds[0])}, or none"
    if get_origin(kind) is tuple:
        items = "names, or files of outlines," if list_groups(kinds[0]) else "values"
        return f"{items} separated by commas" if kinds[-1] is ... else "values joined by ':'"
    if dataclasses.is_dataclass(kind):
        return f"a {typing.cast(type, kind).__name__.lower()}'s name"
    return f"one of {', '.join(list_choices(kind))}"


def is_of_type(value: Any, kind: Hint) -> bool:
    """Return whether a value is of a field's type; any text passes for one of its names."""
    kinds = typing.get_args(kind)
    if kind is Value:
        return True
    if _is_union(kind):
        return any(is_of_type(value, each) for each in kinds)
    if get_origin(kind) is tuple:
        if not isinstance(value, tuple):
            return False
        if kinds[-1] is ...:
            return all(is_of_type(item, kinds[0]) for item in value)
        return len(value) == len(kinds) and all(map(is_of_type, value, kinds))
    if kind == WEIGHTS:
        return isinstance(value, Mapping) and is_of_type(
            tuple(value.items()), tuple[tuple[str, float], ...]
        )
    if list_choices(kind):
        return isinstance(value, str)
    if kind is bool or isinstance(value, bool):  # a bool is an int to Python
        return kind is bool and isinstance(value, bool)
    if kind is float:
        return isinstance(value, int | float) and abs(value) <= sys.float_info.max
    return isinstance(value, kind)


def check_types(value: object, kind: Hint = None, name: str = "") -> None:
    """Refuse, by dotted name, settings of a wrong type; NaN and infinity count as wrong."""
    if kinds := list_groups(kind or type(value)):
        group = next((each for each in kinds if isinstance(value, each)), None)
        if group is None:
            expected = " or ".join(each.__name__ for each in kinds)
            raise UserError(
                f"{name or 'experiment'} is of type {type(value).__name__}, not {expected}"
            )
        for field, hint in list_hints(group).items():
            check_types(getattr(value, field), hint, f"{name}.{field}".lstrip("."))
    elif isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"--{name} must be a finite number, not {value}")
    elif isinstance(value, Mapping) and kind == WEIGHTS:
        for part, weight in value.items():
            check_types(weight, float, f"{name}.{part}")
    elif not is_of_type(value, kind):
        raise UserError(f"--{name} takes {describe_hint(kind)}, not {value!r}")
