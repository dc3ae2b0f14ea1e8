"""The table of inputs that robots and laboratories meet, and the answer of each door.

A door is a command, or a function of Python. Each module of this folder has a list `CASES`, and one
test that runs each of them.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest


class Case(NamedTuple):
    """An input, the door that it is given to, and the answer in a few words."""

    name: str
    door: str
    answer: str
    # makes the input, opens the door and asserts the answer; takes what the module's test gives it
    check: Callable[..., None]


def list_cases(door: str, answer: str, make: Callable[..., Any], rows: Iterable[Any]) -> list[Case]:
    """List cases of one door and answer: a row is a name and what `make` takes."""
    return [Case(name, door, answer, make(*given)) for name, *given in rows]


def run_each(cases: Iterable[Case]) -> pytest.MarkDecorator:
    """Parametrise a test by cases, as the argument `case`."""
    parameters: list[Any] = [pytest.param(case, id=f"{case.door}: {case.name}") for case in cases]
    return pytest.mark.parametrize("case", parameters)
