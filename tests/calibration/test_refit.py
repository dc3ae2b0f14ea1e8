"""From wrong values a refit goes towards the truth and explains more of contacts it never saw; what it has seen is not compared."""

import json
from typing import Any, NamedTuple

import pytest

from jaxunshear.calibration.calibrated import Calibrated, read_calibration, value_of, with_value
from jaxunshear.calibration.folders import read_folder
from jaxunshear.calibration.held_out import among, held_out
from jaxunshear.calibration.refit import UNITS, _changed, refit
from jaxunshear.calibration.validate import validate

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


def test_values_keep_within_bounds(found):
    far = _changed(found.truth, found.truth, "pin_length_mm", 100.0)
    assert far.sensor.pin_length_mm == pytest.approx(5 * found.truth.sensor.pin_length_mm)
    assert 0.4 < _changed(found.truth, found.truth, "gel_poisson", 100.0).sensor.gel_poisson < 0.49
    assert 0.49 < _changed(found.truth, found.truth, "gel_poisson", -100.0).sensor.gel_poisson < 0.5
    stiff = with_value(found.truth, "skin_to_gel", 20.0)
    assert stiff.sensor.gel_modulus_mpa == found.truth.sensor.skin_modulus_mpa / 20


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
