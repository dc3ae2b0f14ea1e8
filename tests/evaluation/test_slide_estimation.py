"""The slide read from codes: how far off, and whether its intervals hold what they promise."""

import numpy as np
import pytest

from jaxunshear.config.splits import SPLITS
from jaxunshear.evaluation.probes import CodedSlides, estimate_slides, split_by_slip

RNG = np.random.default_rng(0)
COUNTS = dict(zip(SPLITS, (1500, 600, 900), strict=True))


def test_intervals_hold_95_percent_and_widen_with_doubt():
    """The noise of the codes grows with their last number, and the doubtful slides have slipped."""
    splits = {}
    for name, count in COUNTS.items():
        slide = RNG.uniform(-2.5, 2.5, (count, 2))
        doubt = RNG.uniform(0, 1, (count, 1))
        noise = 0.05 * (1 + 9 * doubt) * RNG.normal(size=(count, 2))
        slides = {"slide_x_mm": slide[:, :1], "slide_y_mm": slide[:, 1:]}
        splits[name] = CodedSlides(
            np.concatenate([slide + noise, doubt], axis=1), slides, np.arange(count)
        )
    slips = doubt[:, 0] > 0.5
    rows = estimate_slides(splits, {"stuck": 1 - slips, "slipping": slips.astype(int)})
    found = {(row["name"], row["part"]): row for row in rows}
    for axis in "xy":
        every, sure, unsure = (
            found.pop((f"slide_{axis}_mm", part)) for part in ("all", "sticking", "slipped")
        )
        assert 0.93 < every["coverage"] < 0.97
        assert sure["coverage"] > 0.9 and unsure["coverage"] > 0.9
        assert unsure["half_width"] > 1.5 * sure["half_width"] and unsure["mae"] > 1.5 * sure["mae"]
        low, high = every["coverage interval"]
        assert low <= every["coverage"] <= high and every["rmse"] >= every["mae"] > 0
        assert sure["slides"] + unsure["slides"] == every["slides"] == COUNTS["test"]
        # no reader of these codes can do better than their noise, .05 to .5 mm
        assert 0.2 < every["mae"] < 0.35
    assert not found


def test_what_no_code_gives_is_covered_all_the_same():
    splits = {}
    for name, count in COUNTS.items():
        slides = {"slide_x_mm": RNG.uniform(-1, 1, (count, 1))}
        splits[name] = CodedSlides(RNG.normal(size=(count, 3)), slides, np.arange(count))
    (row,) = estimate_slides(splits, {})
    assert 0.92 < row["coverage"] < 0.98 and row["half_width"] > 0.85
    assert row["mae"] == pytest.approx(0.5, abs=0.06)


def test_slipped_is_where_all_that_touches_slips():
    state = {"stuck": np.array([0, 1, 50, 0]), "slipping": np.array([100, 99, 50, 0])}
    parts = split_by_slip(state)
    assert parts["slipped"].tolist() == [True, True, False, False]
    assert parts["sticking"].tolist() == [False, False, True, True]
