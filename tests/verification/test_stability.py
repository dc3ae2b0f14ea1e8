"""The judge of extreme contacts: what it passes, and that it does not pass what is wrong."""

import numpy as np
import pytest

from jaxunshear.errors import UserError
from jaxunshear.simulator.contacts import Contacts
from verification import stability
from verification.contact_case import HALF_SIZE, Case, make_motion, make_path_case
from verification.contact_cases import list_cases

PINS = np.zeros((HALF_SIZE.pins, 3))


def answer(pins: np.ndarray, converged: bool = True) -> Contacts:
    none, flag = np.zeros(1, int), np.array([converged])
    found = np.asarray(pins, float)[None], np.array([0.01]), flag, *(none,) * 4
    return Contacts(*found, np.zeros((1, 3)), none, np.zeros(1, bool))


def examine(solve, refused=None, twin=None) -> stability.StabilityRow:
    return stability.examine_case(Case("made up", solve, HALF_SIZE, refused, twin))


def still(*_):
    return answer(PINS)


def test_cases_are_many_and_their_names_differ():
    names = [case.name for case in list_cases()]
    assert len(names) >= 60 and len(set(names)) == len(names)


def test_a_contact_that_is_solved():
    motion = make_motion(0.5, slide=(0.3, 0.0))
    row = stability.examine_case(make_path_case("small", motion, sensor=HALF_SIZE))
    assert row.outcome == stability.SOLVED and row.holds and row.finite and row.converged
    assert row.float_px <= stability.PRECISION_PX
    assert min(row.nodes, row.iterations, row.ms) > 0


@pytest.mark.long
def test_nodes_that_stand_there_twice_change_nothing():
    (row,) = stability.run_stability(["contact nodes that stand there twice"])
    assert row.holds and row.twin_px < stability.PRECISION_PX


@pytest.mark.parametrize(
    ("part", "least"),
    [
        ("point with", 12),
        ("scene with", 4),
        ("friction nan", 1),
        ("friction -", 2),
        ("stimulus ", 2),
        ("depth 20", 1),
        ("NaN forces", 1),
        ("sensor with", 18),
    ],
)
def test_senseless_contacts_are_refused_by_name(part, least):
    rows = stability.run_stability([part])
    assert len(rows) >= least
    assert all(row.outcome == stability.REFUSED and row.said for row in rows)


def crash(level, retry):
    raise ZeroDivisionError


def shift_in_float64(level, retry):
    return answer(PINS + 0.05 * (getattr(level, "precision", "") == "float64"))


@pytest.mark.parametrize(
    ("solve", "twin", "outcome"),
    [
        (lambda *_: answer(PINS * np.nan), None, "not finite"),
        (lambda level, _: answer(PINS + (level == "auto")), None, "converged to something else"),
        (shift_in_float64, None, "float32 is too coarse"),
        (crash, None, "crashed"),
        (still, lambda *_: answer(PINS + 0.1), "differs from its twin"),
    ],
)
def test_what_is_wrong_does_not_pass(solve, twin, outcome):
    row = examine(solve, twin=twin)
    assert row.outcome == outcome and not row.holds and stability.select_failed([row])
    text = stability.format_table([row])
    assert "FAILED: made up" in text and "--only 'made up'" in text


def test_what_says_that_it_has_not_converged_is_given_up_and_shown():
    row = examine(lambda *_: answer(PINS, converged=False))
    assert row.outcome == stability.UNSOLVED and row.converged is False
    assert not stability.select_failed([row])
    assert "GIVEN UP: made up" in stability.format_table([row])


def test_what_nothing_could_be_compared_with_is_not_called_solved():
    """No tight solution: the reference judges; without that one it is said that nothing did."""

    def fail_if_tight(reference, off):
        def solve(level, retry):
            return answer(PINS + off * (level == "auto"), level in ("auto", reference))

        return solve

    row = examine(fail_if_tight("reference", 0.001))
    assert row.outcome == stability.UNCOMPARED and row.holds
    assert np.isnan(row.float_px) and row.tight_px > 0
    assert np.isnan(examine(fail_if_tight("none", 0.001)).tight_px)
    assert examine(fail_if_tight("reference", 10)).outcome == "converged to something else"
    lone = examine(still, twin=lambda *_: answer(PINS, converged=False))
    assert lone.outcome == stability.UNCOMPARED


def test_a_refusal_must_name_what_is_refused():
    def refuse(level, retry):
        raise UserError("friction -1 is below zero")

    assert examine(refuse, refused="friction").holds
    for solve, refused in ((refuse, "depth"), (refuse, None), (still, "depth")):
        assert not examine(solve, refused=refused).holds


@pytest.mark.parametrize(
    ("asked", "said"), [("frictoin", "did you mean friction"), ("0x0q", "many contain network, ")]
)
def test_cases_are_reported_by_words_of_their_names(asked, said):
    with pytest.raises(UserError, match=f"--only '{asked}': no name contains this; {said}"):
        stability.run_stability([asked])
