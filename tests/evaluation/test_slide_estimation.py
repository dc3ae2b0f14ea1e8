"""The slide read from codes: how far off, and whether its intervals hold what they promise."""

import numpy as np
import pytest

from jaxunshear.evaluation.slide_estimation import estimate_slides, is_slipping

RNG = np.random.default_rng(0)
COUNTS = (1500, 600, 900)


def made(count):
    """Make codes whose noise grows with their last number, their slides, and which have slipped."""
    slide = RNG.uniform(-2.5, 2.5, (count, 2))
    doubt = RNG.uniform(0, 1, (count, 1))
    codes = np.concatenate(
        [slide + 0.05 * (1 + 9 * doubt) * RNG.normal(size=(count, 2)), doubt], axis=1
    )
    return codes, {"slide_x_mm": slide[:, :1], "slide_y_mm": slide[:, 1:]}, doubt[:, 0] > 0.5


@pytest.fixture(scope="module")
def rows():
    (one, known, _), (two, between, _), (three, true, slipped) = (made(count) for count in COUNTS)
    args = [one, two, three], [known, between, true], np.arange(COUNTS[0]), np.arange(COUNTS[2])
    return {
        (row["name"], row["part"]): row for row in estimate_slides(*args, slipped)
    }, estimate_slides(*args)


def test_intervals_hold_95_percent_and_widen_with_doubt(rows):
    found, plain = rows
    assert set(found) == {
        (f"slide_{axis}_mm", part) for axis in "xy" for part in ("all", "sticking", "slipped")
    }
    for axis in "xy":
        every, sure, unsure = (
            found[f"slide_{axis}_mm", part] for part in ("all", "sticking", "slipped")
        )
        assert 0.93 < every["coverage"] < 0.97
        assert sure["coverage"] > 0.9 and unsure["coverage"] > 0.9
        assert unsure["half_width"] > 1.5 * sure["half_width"] and unsure["mae"] > 1.5 * sure["mae"]
        low, high = every["coverage interval"]
        assert low <= every["coverage"] <= high and every["rmse"] >= every["mae"] > 0
        assert sure["slides"] + unsure["slides"] == every["slides"] == COUNTS[2]
        # no reader of these codes can do better than their noise, .05 to .5 mm
        assert 0.2 < every["mae"] < 0.35
    assert [row["part"] for row in plain] == ["all", "all"]


def test_what_no_code_gives_is_covered_all_the_same():
    codes = [RNG.normal(size=(count, 3)) for count in COUNTS]
    reported = [{"slide_x_mm": RNG.uniform(-1, 1, (count, 1))} for count in COUNTS]
    (row,) = estimate_slides(codes, reported, np.arange(COUNTS[0]), np.arange(COUNTS[2]))
    assert (
        0.92 < row["coverage"] < 0.98
        and row["half_width"] > 0.85
        and row["mae"] == pytest.approx(0.5, abs=0.06)
    )


def test_slipped_is_where_all_that_touches_slips():
    np.testing.assert_array_equal(
        is_slipping(np.array([0, 1, 50, 0]), np.array([100, 99, 50, 0])), [True, True, False, False]
    )
