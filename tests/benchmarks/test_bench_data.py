"""What a simulated set takes, step by step."""

import pytest

from benchmarks.bench_data import COLUMNS, bench_data


@pytest.mark.long
def test_every_step_has_its_time_and_its_bytes():
    rows = bench_data(5)
    assert [row["name"] for row in rows] == [
        "plan",
        "simulate and draw",
        "stored",
        "read into memory",
    ]
    assert all(set(row) == set(COLUMNS) for row in rows)
    _, chunk, stored, read = rows
    assert chunk["cpu_ms"] > read["cpu_ms"] > 0
    pins, bits = 331 * 2 * 4, 128 * 128 / 8
    assert chunk["bytes"] > pins + bits
    assert stored["bytes"] > pins * 4 / 3  # of a slide and its tap, for two contacts of three
    assert read["bytes"] >= (pins + bits) * 4 / 3
