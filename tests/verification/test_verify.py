"""Closed forms, orders and laws: the cheap checks, and all of them in a long test."""

import functools
import math

import numpy as np
import pytest

from jaxunshear.errors import UserError
from tests.golden import make_runs
from verification import elements, invariants, normal_contact, tamaas_comparison, tangential_contact
from verification.half_space import HalfSpace, make_half_space
from verification.verification_rows import Row, Rows, convert_row, fit_order, format_rows
from verification.verify import CHECKS, INCOMPRESSIBLE, run_verification


@pytest.fixture(scope="module")
def body() -> HalfSpace:
    return make_half_space(INCOMPRESSIBLE)


@pytest.fixture(scope="module")
def rows_of(body):
    """`rows_of(check)`: what a check of the half-space finds, computed once."""
    return functools.cache(lambda check: check(body))


def missed(rows: list[Row]) -> str:
    return format_rows(row for row in rows if not row.holds)


@pytest.mark.parametrize(
    "check",
    [elements.run_patch_test, elements.measure_manufactured_orders, invariants.check_scaling],
)
def test_elements(check):
    assert not missed(check())


CHEAP = (
    normal_contact.check_hertz,
    tangential_contact.check_cattaneo_mindlin,
    pytest.param(tangential_contact.check_cycle, marks=pytest.mark.long),
    invariants.check_compliance,
    invariants.check_random_paths,
    invariants.check_no_contact,
    invariants.check_rotation,
    invariants.check_closed_loop,
    invariants.check_increment_order,
)


@pytest.mark.parametrize("check", CHEAP, ids=lambda check: check.__name__)
def test_half_space(check, rows_of):
    rows = rows_of(check)
    assert not missed(rows)
    assert any(row.bar is not None for row in rows)


def test_golden_rows_of_the_half_space(rows_of):
    checks = {
        "pressed by a sphere (Hertz)": normal_contact.check_hertz,
        "pressed and slid (Cattaneo and Mindlin)": tangential_contact.check_cattaneo_mindlin,
        "there and back": invariants.check_closed_loop,
        "in more increments": invariants.check_increment_order,
    }
    found = {name: [row.measured for row in rows_of(check)] for name, check in checks.items()}
    make_runs.hold("verification on a half-space", found)


def test_without_tamaas_a_row_says_so(body, absent):
    absent("tamaas")
    (row,) = tamaas_comparison.compare_with_tamaas(body)
    assert row.bar is None and "pip install" in row.note


@pytest.mark.parametrize(
    ("measured", "bar", "more", "holds"),
    [
        (2.01, 0.01, {}, True),
        (2.03, 0.01, {}, False),
        (4.0, None, {}, True),  # informs only
        (math.nan, 0.01, {}, False),
        (2.0, 0.01, {"settled": False}, False),
        (2.0, 0.01, {"order": 1.1, "least_order": 1.0}, True),
        (2.0, 0.01, {"order": 0.8, "least_order": 1.0}, False),
        (2.0, 0.01, {"order": math.nan, "least_order": 1.0}, False),
        (2.0, 0.01, {"order": None, "least_order": 1.0}, False),
    ],
)
def test_a_bar_holds_or_does_not(measured, bar, more, holds):
    rows = Rows("g")
    rows.compare("p", 2.0, measured, bar, **more)
    assert rows[0].holds == holds


def test_orders_are_fitted():
    sizes = np.array([1.0, 0.5, 0.25])
    assert fit_order(sizes, 3 * sizes**2) == pytest.approx(2.0)
    assert math.isnan(fit_order(sizes[:2], sizes[:2]))
    assert math.isnan(fit_order(sizes, [0.1, 0.0, 0.1]))


def test_the_table_gives_what_was_missed():
    rows, others = Rows("a group"), Rows("another")
    rows.compare("one", 2.0, 2.2, 0.05, order=1.0, least_order=0.5)
    others.expect_zero("two", 0.1, 1.0, 0.3, px=True)
    text = format_rows([*rows, *others])
    places = [text.index(part) for part in ("a group", "one", "MISSED", "another", "0.1 px")]
    assert places == sorted(places)
    assert convert_row(rows[0])["holds"] is False


@pytest.mark.long
def test_every_bar_holds():
    rows = run_verification()
    assert not missed(rows)


def test_only_the_named_checks_run(monkeypatch):
    ran = []
    for name in CHECKS:
        monkeypatch.setitem(CHECKS, name, lambda name=name: ran.append(name) or [])
    run_verification(["hertz", "full_dome.check_rotation"])
    assert ran == ["normal_contact.check_hertz", "full_dome.check_rotation"]
    with pytest.raises(UserError, match=r"'hetrz': .* did you mean hertz\? .*check_tilt"):
        run_verification(["hertz", "hetrz"])
    assert len(ran) == 2
