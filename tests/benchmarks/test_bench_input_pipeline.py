"""Steps with examples that are drawn, beside steps with examples that are there."""

import pytest

from benchmarks.bench_input_pipeline import COLUMNS, bench_input


@pytest.mark.long
def test_both_kinds_of_networks_have_a_row():
    rows = bench_input(seconds=0.0, widths=(4, 8))
    assert [row["name"] for row in rows] == ["images", "pins"]
    for row in rows:
        assert row["ratio_low"] <= row["ratio"] <= row["ratio_high"]
        assert set(row) == set(COLUMNS)
        assert (
            row["ms_there"] > 0 and row["ms_drawn"] > 0 and 0.5 < row["ratio"] <= row["ratio_p95"]
        )
