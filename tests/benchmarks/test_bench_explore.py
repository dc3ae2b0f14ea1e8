"""Pictures of `explore` are timed, and those that cannot be had are counted apart."""

import pytest

from benchmarks.bench_explore import COLUMNS, bench_explore


@pytest.mark.long
def test_a_row_a_stimulus():
    rows = bench_explore(stimuli=("disk", "edge"), pictures=3, warm=False)
    assert [row["name"] for row in rows] == ["disk", "edge"]
    for row in rows:
        assert set(row) == set(COLUMNS) and row["pictures"] + row["refused"] == 3
        assert 0 < row["ms"] <= row["ms_p95"] <= row["most_ms"]
