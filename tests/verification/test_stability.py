"""The judge of extreme contacts: what it passes, and that it does not pass what is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.errors import UserError
from jaxunshear.simulator.contact_results import Contacts
from verification import stability
from verification.contact_case import HALF_SIZE, Case, format_sensor, make_motion, make_path_case
from verification.contact_cases import list_cases

SHALLOW = make_motion(0.5, slide=(0.3, 0.0))


def answer(pins: np.ndarray, converged: bool = True) -> Contacts:
    none = np.zeros(1, int)
    return Contacts(
        np.asarray(pins, float)[None],
        np.array([0.01]),
        np.array([converged]),
        *(none,) * 4,
        np.zeros((1, 3)),
        none,
        np.zeros(1, bool),
    )


def made_up(solve, refused=None, twin=None) -> Case:
    return Case("made up", solve, "the line", HALF_SIZE, refused, twin)


def test_cases_are_many_and_their_names_differ():
    names = [case.name for case in list_cases()]
    assert len(names) >= 60 and len(set(names)) == len(names)


def test_a_contact_that_is_solved():
    row = stability.examine_case(make_path_case("small", SHALLOW, sensor=HALF_SIZE))
    assert row.outcome == stability.SOLVED and row.holds and row.finite and row.converged
    assert (
        row.float_px <= stability.PRECISION_PX
        and row.nodes > 0
        and row.iterations > 0
        and row.ms > 0
    )


@pytest.mark.long
def test_nodes_that_stand_there_twice_change_nothing():
    (case,) = [
        case
        for case in list_cases()
        if case.name.startswith("contact nodes that stand there twice")
    ]
    row = stability.examine_case(case)
    assert row.holds and row.twin_px < stability.PRECISION_PX


@pytest.mark.parametrize(
    "part",
    [
        "point with",
        "scene with",
        "friction nan",
        "friction -",
        "stimulus ",
        "depth 20",
        "NaN forces",
    ],
)
def test_senseless_contacts_are_refused_by_name(part):
    rows = stability.run_stability(part)
    assert rows and all(row.outcome == stability.REFUSED and row.said for row in rows)


def test_senseless_sensors_are_refused_by_the_field():
    rows = stability.run_stability("sensor with")
    assert len(rows) >= 18 and [row.outcome for row in rows] == [stability.REFUSED] * len(rows)


PINS = np.zeros((HALF_SIZE.pins, 3))


@pytest.mark.parametrize(
    ("solve", "outcome"),
    [
        (lambda level, retry: answer(PINS * np.nan), "not finite"),
        (lambda level, retry: answer(PINS + (level == "auto")), "converged to something else"),
        (
            lambda level, retry: answer(
                PINS + 0.05 * (getattr(level, "precision", "") == "float64")
            ),
            "float32 is too coarse",
        ),
        (lambda level, retry: 1 / 0, "crashed"),
    ],
)
def test_what_is_wrong_does_not_pass(solve, outcome):
    row = stability.examine_case(made_up(solve))
    assert row.outcome == outcome and not row.holds and stability.select_failed([row])
    assert (
        row.scene == "the line"
        and "the line" in stability.format_table([row])
        and "--only" in stability.format_table([row])
    )


def test_what_says_that_it_has_not_converged_is_given_up_and_shown():
    row = stability.examine_case(made_up(lambda *_: answer(PINS, converged=False)))
    assert row.outcome == stability.UNSOLVED and row.converged is False
    assert stability.select_given_up([row]) and not stability.select_failed([row])
    assert "the line" in stability.format_table([row])


def test_what_nothing_could_be_compared_with_is_not_called_solved():
    """No tight solution: the reference judges; without that one it is said that nothing did."""

    def tight_fails(reference):
        return lambda level, retry: answer(
            PINS + (level == "auto") * 0.001, converged=level in ("auto", reference)
        )

    row = stability.examine_case(made_up(tight_fails("reference")))
    assert (
        row.outcome == stability.UNCOMPARED
        and row.holds
        and np.isnan(row.float_px)
        and row.tight_px > 0
    )
    assert np.isnan(stability.examine_case(made_up(tight_fails("none"))).tight_px)
    off = made_up(
        lambda level, retry: answer(
            PINS + 10 * (level == "auto"), converged=level in ("auto", "reference")
        )
    )
    assert stability.examine_case(off).outcome == "converged to something else"
    lone = made_up(lambda *_: answer(PINS), twin=lambda *_: answer(PINS, converged=False))
    assert stability.examine_case(lone).outcome == stability.UNCOMPARED


def test_a_twin_that_differs_does_not_pass():
    row = stability.examine_case(
        made_up(lambda *_: answer(PINS), twin=lambda *_: answer(PINS + 0.1))
    )
    assert row.outcome == "differs from its twin" and not row.holds


def test_a_refusal_must_name_what_is_refused():
    def refuse(level, retry):
        raise UserError("friction -1 is below zero")

    assert stability.examine_case(made_up(refuse, refused="friction")).holds
    assert not stability.examine_case(made_up(refuse, refused="depth")).holds
    assert not stability.examine_case(made_up(refuse)).holds
    assert not stability.examine_case(made_up(lambda *_: answer(PINS), refused="depth")).holds


def test_an_unknown_case_is_refused():
    with pytest.raises(UserError, match="no case's name"):
        stability.run_stability("nothing of the kind")


def test_a_line_says_what_sets_a_sensor_apart():
    sensor = replace(TACTIP_331, skin_modulus_mpa=7.0)
    assert format_sensor(sensor) == "Sensor(skin_modulus_mpa=7.0)"
    assert "skin_modulus_mpa=7.0" in make_path_case("any", SHALLOW, sensor=sensor).line


@pytest.mark.parametrize(
    ("asked", "said"), [("frictoin", "some do friction"), ("0x0q", "some do network, ")]
)
def test_cases_are_reported_by_words_of_their_names(asked, said):
    with pytest.raises(UserError, match=f"--only '{asked}': no case's name contains this; {said}"):
        stability.run_stability(asked)
