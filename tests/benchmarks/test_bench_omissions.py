"""Parts that are not needed are gone from the compiled programs."""

import pytest

from benchmarks import bench_omissions
from jaxunshear.errors import UserError


@pytest.fixture(scope="module")
def rows():
    return bench_omissions.bench_needs(size=32, widths=(4, 8), rounds=1)


@pytest.mark.long
def test_every_part_left_out_saves_operations(rows):
    ratios = {row["left_out"]: row["operations_ratio"] for row in rows}
    assert all(ratio < 1 for ratio in ratios.values())
    assert ratios["shear code and DS"] < 0.75
    assert ratios["shear channels"] < 0.75
    assert ratios["networks that are not asked for"] < 0.5


@pytest.mark.long
def test_rows_hold_both_ways(rows):
    for row in rows:
        assert row["seconds_ratio"] > 0
        for kind in ("with", "without"):
            assert row[kind]["operations"] > 0 and row[kind]["compile_s"] > 0
            assert 0 < row[kind]["seconds"] <= row[kind]["p95"]
    assert "lambda 0" in bench_omissions.format_table(rows)


def test_a_size_that_cannot_be_halved_is_refused():
    with pytest.raises(UserError, match="size = 100"):
        bench_omissions.bench_needs(size=100)
