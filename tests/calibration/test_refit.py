"""From wrong values a refit goes towards the truth and explains more of contacts it never saw; what it has seen is not compared."""

import json
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from jaxunshear.calibration.alignment import Matter
from jaxunshear.calibration.calibrated import SHIPPED, Calibrated, read_calibration, value_of, with_value
from jaxunshear.calibration.folders import read_folder
from jaxunshear.calibration.held_out import among, held_out
from jaxunshear.calibration.labels import Frame, framed
from jaxunshear.calibration.prediction import probe
from jaxunshear.calibration.refit import UNITS, _changed, refit
from jaxunshear.calibration.validate import validate
from jaxunshear.calibration.validation import places
from jaxunshear.scene.pins import pin_lattice, pin_tips
from tests.calibration.test_alignment import TRUE, _contacts, _like_a_skin, _recorded

WRONG = 1.4  # times the truth
KNOWN = ("friction", "pin_length_mm")


class Refitted(NamedTuple):
    truth: Calibrated
    results: dict[str, Any]
    file: Any
    out: Any


def _quiet(text: str) -> None:
    pass


def _value(results, name):
    return next(row["value"] for row in results["rows"] if row["name"] == name)


def _wrong(truth):
    for name in KNOWN:
        truth = with_value(truth, name, WRONG * value_of(truth, name))
    return truth


def _truth(simulated):
    return Calibrated("truth", simulated.sensor, simulated.camera, simulated.friction, ())


@pytest.fixture(scope="module")
def found(simulated, tmp_path_factory):
    out = tmp_path_factory.mktemp("refit")
    truth = _truth(simulated)
    results = validate(simulated.folder, _wrong(truth), None, 0, out, _quiet, refit=out / "refit.json")
    return Refitted(truth, results, out / "refit.json", out)


def test_two_wrong_values_are_found(simulated):
    truth = _truth(simulated)
    wrong = _wrong(truth)
    parts, _ = held_out(simulated.folder, None, 0, ())
    folder, _ = read_folder(parts[0], wrong)
    known, frames = refit([folder.matter], wrong, [folder.start], KNOWN)
    for name in KNOWN:
        assert value_of(known, name) == pytest.approx(value_of(truth, name), rel=0.15)
    assert value_of(known, "skin_mm") == truth.sensor.skin_mm
    assert len(frames) == 1 and frames[0].across_mm == 0  # no edge


def test_values_and_frame_are_found_within_bounds():
    """In place of the simulator: pins that stay behind by friction, and that a softer gel lets farther down."""

    def like_a_skin(sensor, contacts, side, friction, surface_mm, ratio):
        moved, fine = _like_a_skin(sensor, contacts, side, friction, surface_mm, ratio)
        tips = pin_tips(probe(sensor, ratio)) / 20
        moved[..., :2] += friction * tips[:, :2] ** 2 * contacts.slide[:, None]
        moved[..., 1] += 0.1 * np.log(ratio) * tips[:, 0] * contacts.tip[:, 1, 2][:, None]
        return moved, fine

    truth = replace(SHIPPED, friction=0.4)
    contacts = _contacts()
    moved, _ = like_a_skin(truth.sensor, framed(contacts, TRUE), 1, 0.4, 0.0, truth.values.skin_to_gel)
    place = places(truth.values, truth.sensor, 128, pin_lattice(truth.sensor), moved)
    seen = _recorded(contacts)._replace(place=place)
    names = ("friction", "skin_to_gel")
    for wrong, bound in ((1.5, False), (20.0, True)):  # the second is farther off than a refit may go
        start = with_value(with_value(truth, "friction", 0.4 * wrong), "skin_to_gel", 2 * truth.values.skin_to_gel)
        matter = Matter(seen, contacts, 1, start.values, start.sensor, like_a_skin)
        known, frames = refit([matter], start, [Frame(*TRUE)], names)
        assert known.friction == pytest.approx(0.8 if bound else 0.4, rel=0.05)
        assert bound or known.values.skin_to_gel == pytest.approx(truth.values.skin_to_gel, rel=0.1)
        assert bound or np.allclose(frames[0], TRUE, atol=0.1)


@pytest.mark.long
def test_it_explains_more_of_contacts_it_never_saw(found):
    for kind in ("tap", "slide"):
        gain = _value(found.results, f"gain.r2.{kind}.all")
        assert gain > 0
        assert gain == pytest.approx(
            _value(found.results, f"r2.{kind}") - _value(found.results, f"before.r2.{kind}"), abs=1e-9
        )
    assert _value(found.results, "r2.slide") > 0.98
    truth = found.truth.friction
    assert abs(_value(found.results, "after.friction") - truth) < 0.5 * (WRONG - 1) * truth
    assert _value(found.results, "gain.r2.slide.friction") > 0
    text = (found.out / "validate.txt").read_text()
    assert all(name in text for name in (*UNITS, "frame", "r2 gained, slides"))


@pytest.mark.long
def test_its_file_is_a_calibration_that_scores_the_same(found, simulated):
    known = read_calibration(found.file)
    assert value_of(known, "friction") == _value(found.results, "after.friction")
    parts, _ = held_out(simulated.folder, None, 0, known.used)
    assert set(parts[0].align.names) == set(known.used) and not among(parts[0].scored.names, known.used).any()
    again = validate(simulated.folder, known, None, 0, None, _quiet)
    for name in ("r2.tap", "r2.slide"):
        assert _value(again, name) == pytest.approx(_value(found.results, name), abs=0.003)
    assert len(json.loads(found.file.read_text())["image_names"]) == 12
    assert next(row["contacts"] for row in again["rows"] if row["name"] == "r2.slide") <= 24


def test_values_keep_within_bounds():
    far = _changed(SHIPPED, SHIPPED, "pin_length_mm", 100.0)
    assert far.sensor.pin_length_mm == pytest.approx(10 * SHIPPED.sensor.pin_length_mm)
    assert 0.39 < _changed(SHIPPED, SHIPPED, "gel_poisson", 100.0).sensor.gel_poisson < 0.49
    assert 0.49 < _changed(SHIPPED, SHIPPED, "gel_poisson", -100.0).sensor.gel_poisson < 0.5
    stiff = with_value(SHIPPED, "skin_to_gel", 20.0)
    assert stiff.sensor.gel_modulus_mpa == SHIPPED.sensor.skin_modulus_mpa / 20


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("validate {folder} --refit {folder}/refit.json", "lies among the recordings"),
        ("validate {folder} --refit {beside}", "is a folder: name a file"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(words, said, tmp_path, command):
    folder, beside = tmp_path / "recordings", tmp_path / "beside"
    folder.mkdir()
    beside.mkdir()
    answer = command(*words.format(folder=folder, beside=beside).split())
    assert answer.code == 2 and said in answer.err and answer.err.strip().count("\n") == 0
