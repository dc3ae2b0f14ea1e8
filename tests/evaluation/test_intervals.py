"""Half-widths of answers, and what they hold."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxunshear.evaluation.intervals import (
    COVERAGE_ELSEWHERE,
    ELSEWHERE_NOTE,
    MIN_CONTACTS,
    compute_coverage,
    compute_half_widths,
)

LOCKED = (
    Path(__file__).resolve().parents[2] / "docs" / "results" / "locked" / "recorded_pins_seed0.json"
)


def test_of_evenly_spread_errors_the_width_is_the_conformal_one():
    errors = {"pose/tap/y_mm": np.random.default_rng(0).permutation(np.arange(1, 101) / 100)}
    # the ceil(101 * .95)-th of 100
    assert compute_half_widths(errors) == {"tap": {"y_mm": pytest.approx(0.96)}}


def test_the_share_that_is_held_is_of_the_other_contacts():
    widths = {"tap": {"y_mm": 0.5}, "sheared": {"y_mm": 1.0}}
    others = {
        "pose/tap/y_mm": np.array([0.1, 0.5, 0.51, 2.0]),
        "pose/tap/z_mm": np.ones(3),
        "pins/sheared": np.ones(3),
    }
    assert compute_coverage(widths, others) == {"tap": {"y_mm": 0.5}}


def test_of_a_few_contacts_no_width_is_known():
    errors = {
        f"pose/tap/{name}": np.ones(count)
        for name, count in (("y_mm", MIN_CONTACTS - 1), ("z_mm", MIN_CONTACTS))
    }
    assert compute_half_widths(errors) == {"tap": {"z_mm": 1.0}}


def test_new_draws_are_held_as_often_as_promised():
    generator, held = np.random.default_rng(1), []
    for _ in range(300):
        known, others = (np.abs(generator.standard_t(3, size=count)) for count in (99, 200))
        widths = compute_half_widths({"pose/tap/y_mm": known})
        held.append(compute_coverage(widths, {"pose/tap/y_mm": others})["tap"]["y_mm"])
    assert np.mean(held) == pytest.approx(0.95, abs=0.006)


def test_what_they_held_on_other_recordings_is_what_the_file_says():
    rows = {row["name"]: row["value"] for row in json.loads(LOCKED.read_text())["rows"]}
    stored = {name: rows[f"coverage.unsheared.{name}"] for name in COVERAGE_ELSEWHERE}
    assert stored == COVERAGE_ELSEWHERE
    assert ELSEWHERE_NOTE.endswith("they held 94 % of y, 82 % of z, 95 % of Rz")
