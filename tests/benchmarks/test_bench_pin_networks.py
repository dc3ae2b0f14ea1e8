"""Networks over pins, timed: a row a network and a use."""

import pytest

from benchmarks.bench_pin_networks import BATCHES, COLUMNS, NETS, bench_pin_networks
from jaxunshear.config.experiment import PIN_TRAINING


@pytest.mark.long
def test_every_network_and_use_has_a_row():
    rows = bench_pin_networks(rounds=2, turn_s=0.0)
    uses = [("training step", PIN_TRAINING.batch), *(("a frame", batch) for batch in BATCHES)]
    assert [(row["name"], row["what"], row["batch"]) for row in rows] == [
        (name, *use) for name in NETS for use in uses
    ]
    for row in rows:
        assert set(row) == set(COLUMNS) and 0 < row["ms"] <= row["ms_p95"] and row["plain_ms"] > 0
    alone, of_many = (row["ms"] for row in rows[1:3])
    assert alone < of_many  # 64 frames at once
