"""Closed forms, orders and laws: the cheap checks here, all of them in the test that is marked long."""

import functools
import math

import numpy as np
import pytest

from tests.golden import make_runs
from verification import elements, laws, normal, periodic, shear
from verification.half_space import HalfSpace, half_space
from verification.tables import Row, as_dict, compare, fit_order, table, vanishes
from verification.verify import CHECKS, INCOMPRESSIBLE, verify


@pytest.fixture(scope="module")
def body() -> HalfSpace:
    return half_space(INCOMPRESSIBLE)


@pytest.fixture(scope="module")
def rows_of(body):
    """`rows_of(check)`: what a check of the half-space finds, computed once."""
    return functools.cache(lambda check: check(body))


def missed(rows: list[Row]) -> str:
    return table(row for row in rows if not row.holds)


@pytest.mark.parametrize("check", [elements.patch_test, elements.made_up_orders, laws.scaled])
def test_elements(check):
    assert not missed(check())


CHEAP = (
    *(normal.hertz, shear.cattaneo_mindlin, pytest.param(shear.cycle, marks=pytest.mark.long)),
    *(
        laws.of_the_compliance,
        laws.of_random_paths,
        laws.no_contact,
        laws.turned,
        laws.closed_loop,
        laws.of_increments,
    ),
)


@pytest.mark.parametrize("check", CHEAP, ids=lambda check: check.__name__)
def test_half_space(check, rows_of):
    rows = rows_of(check)
    assert not missed(rows)
    assert any(row.bar is not None for row in rows)


def test_golden_rows_of_the_half_space(rows_of):
    checks = {
        "pressed by a sphere (Hertz)": normal.hertz,
        "pressed and slid (Cattaneo and Mindlin)": shear.cattaneo_mindlin,
        "there and back": laws.closed_loop,
        "in more increments": laws.of_increments,
    }
    found = {name: [row.measured for row in rows_of(check)] for name, check in checks.items()}
    make_runs.hold("verification on a half-space", found)


def test_without_tamaas_a_row_says_so(body, absent):
    absent("tamaas")
    (row,) = periodic.against_tamaas(body)
    assert row.bar is None and "pip install" in row.note


def test_a_bar_holds_or_does_not():
    assert compare("g", "p", 2.0, 2.01, 0.01).holds
    assert not compare("g", "p", 2.0, 2.03, 0.01).holds
    assert compare("g", "p", 2.0, 4.0).holds  # informs only
    assert not vanishes("g", "p", math.nan, 1.0, 0.01).holds
    assert not compare("g", "p", 2.0, 2.0, 0.01, settled=False).holds
    for order, holds in ((1.1, True), (0.8, False), (math.nan, False), (None, False)):
        assert compare("g", "p", 2.0, 2.0, 0.01, order=order, least_order=1.0).holds == holds


def test_orders_are_fitted():
    sizes = np.array([1.0, 0.5, 0.25])
    assert fit_order(sizes, 3 * sizes**2) == pytest.approx(2.0)
    assert math.isnan(fit_order(sizes[:2], sizes[:2]))
    assert math.isnan(fit_order(sizes, [0.1, 0.0, 0.1]))


def test_the_table_gives_what_was_missed():
    rows = [
        compare("a group", "one", 2.0, 2.2, 0.05, order=1.0, least_order=0.5),
        vanishes("another", "two", 0.1, 1.0, 0.3, px=True),
    ]
    text = table(rows)
    assert (
        text.index("a group")
        < text.index("one")
        < text.index("MISSED")
        < text.index("another")
        < text.index("0.1 px")
    )
    assert as_dict(rows[0])["holds"] is False


@pytest.mark.long
def test_every_bar_holds():
    done = []

    class Count:
        def advance(self, n: float = 1) -> None:
            done.append(n)

    rows = verify(Count())
    assert sum(done) == len(CHECKS)
    assert not missed(rows)
