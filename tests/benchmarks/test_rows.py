"""Benchmarks at a small size: their rows, and that what they say of known work is right."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import (
    bench_data,
    bench_demo,
    bench_explore,
    bench_omissions,
    bench_pin_networks,
    bench_pins,
    bench_read,
)
from benchmarks import bench_input_pipeline as bench_input
from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.errors import UserError
from tests.perception.test_pin_refinement import LATTICE, picture, slid

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
def test_every_step_of_a_set_has_its_time_and_its_bytes():
    rows = bench_data.bench_data(5)
    steps = ["plan", "simulate and draw", "stored", "read into memory"]
    assert [row["name"] for row in rows] == steps
    assert all(set(row) == set(bench_data.COLUMNS) for row in rows)
    _, chunk, stored, read = rows
    assert chunk["cpu_ms"] > read["cpu_ms"] > 0
    pins, bits = 331 * 2 * 4, 128 * 128 / 8
    assert chunk["bytes"] > pins + bits
    assert stored["bytes"] > pins * 4 / 3  # of a slide and its tap, for two contacts of three
    assert read["bytes"] >= (pins + bits) * 4 / 3


@pytest.mark.long
def test_the_stages_of_a_run_add_up_to_its_time():
    rows = bench_demo.bench_demo(ROOT / "experiments" / "tiny.py")
    seconds = {row["name"]: row["s"] for row in rows}
    assert {"disentangled", "posenet", "evaluate", bench_demo.REST} < set(seconds)
    assert min(seconds.values()) > 0
    total = seconds.pop(bench_demo.TOTAL)
    assert total == pytest.approx(sum(seconds.values()))
    assert rows[0]["s"] / rows[0]["products"] == pytest.approx(total / rows[-1]["products"])


def test_a_run_that_fails_has_no_times(tmp_path):
    with pytest.raises(UserError, match=r"missing\.py = exit code 2"):
        bench_demo.bench_demo(tmp_path / "missing.py")


@pytest.mark.long
def test_pictures_of_the_explorer():
    rows = bench_explore.bench_explore(stimuli=("disk", "edge"), pictures=3, warm=False)
    assert [row["name"] for row in rows] == ["disk", "edge"]
    for row in rows:
        assert set(row) == set(bench_explore.COLUMNS) and row["pictures"] + row["refused"] == 3
        assert 0 < row["ms"] <= row["ms_p95"] <= row["most_ms"]


@pytest.mark.long
def test_steps_with_examples_in_memory_and_drawn():
    rows = bench_input.bench_input(seconds=0.0, widths=(4, 8))
    assert [row["name"] for row in rows] == ["images", "pins"]
    for row in rows:
        assert set(row) == set(bench_input.COLUMNS)
        assert row["ratio_low"] <= row["ratio"] <= row["ratio_high"]
        assert row["ms_there"] > 0 and 0.5 < row["ratio"] <= row["ratio_p95"]


@pytest.mark.long
def test_every_network_over_pins_and_use_has_a_row():
    rows = bench_pin_networks.bench_pinnets(rounds=2, turn_s=0.0)
    uses = [("training step", PIN_TRAINING.batch)]
    uses += [("a frame", batch) for batch in bench_pin_networks.BATCHES]
    expected = [(name, *use) for name in bench_pin_networks.NETS for use in uses]
    assert [(row["name"], row["what"], row["batch"]) for row in rows] == expected
    for row in rows:
        assert set(row) == set(bench_pin_networks.COLUMNS)
        assert 0 < row["ms"] <= row["ms_p95"] and row["plain_ms"] > 0
    alone, of_many = (row["ms"] for row in rows[1:3])
    assert alone < of_many  # 64 frames at once


@pytest.mark.long
def test_every_part_left_out_saves_operations():
    rows = bench_omissions.bench_needs(size=32, widths=(4, 8), rounds=1)
    ratios = {row["left_out"]: row["operations_ratio"] for row in rows}
    assert all(ratio < 1 for ratio in ratios.values())
    assert ratios["shear code and DS"] < 0.75
    assert ratios["shear channels"] < 0.75
    assert ratios["networks that are not asked for"] < 0.5
    for row in rows:
        for kind in ("with", "without"):
            assert row[kind]["operations"] > 0 and row[kind]["compile_s"] > 0
            assert 0 < row[kind]["seconds"] <= row[kind]["p95"]
    assert "lambda 0" in bench_omissions.format_table(rows)


def test_a_size_that_cannot_be_halved_is_refused():
    with pytest.raises(UserError, match="size = 100: is not divisible by 32"):
        bench_omissions.bench_needs(size=100)


def compare(images, true):
    return bench_pins.compare_pins(LATTICE, np.array(images), np.array(true))


def test_errors_identities_and_times_of_found_pins():
    true = [slid(), slid() + np.array([0.5, 0])]
    row = compare([picture(each) for each in true], true)
    assert (row["frames"], row["sure"], row["wrong"]) == (2, 1, 0)
    assert row["missed"] == row["extra"] == 0 and 0 < row["rms_px"] < 0.15
    assert row["find_ms"] > 0 and row["follow_ms"] > 0 and row["ms"] <= row["ms_p95"]


def test_a_wrong_name_in_a_sure_frame_is_counted_and_no_pins_are_not_sure():
    others = slid()
    others[[10, 11]] = others[[11, 10]]
    row = compare([picture(slid())], [others])
    assert row["sure"] == 1 and row["wrong"] == 1
    row = compare(np.zeros((1, 256, 256), np.uint8), [slid()])
    assert (row["sure"], row["wrong"], row["missed"], row["rms_px"]) == (0, 0, 331, None)


@pytest.mark.long
def test_every_step_of_reading_a_frame_has_its_time_beside_a_plain_pass():
    rows = bench_read.bench_read(frames=20)
    assert [row["name"] for row in rows] == ["128 px", "256 px"]
    for row in rows:
        assert set(row) == {"size", *bench_read.COLUMNS} and row["frames"] >= 40
        assert row["sure"] > 0.9
        for step in bench_read.STEPS:
            assert 0 < row[f"{step}_ms"] <= row[f"{step}_ms_p95"]
        assert row["sum_ms"] > max(row["detect_ms"], row["identify_ms"])
        assert 0 < row["ratio"] <= row["ratio_p95"]


def test_centroids_of_white_parts():
    image = np.zeros((8, 8), np.uint8)
    image[1:3, 1:4] = image[6, 5] = 255
    np.testing.assert_allclose(bench_read.compute_centroids(image), [[1.5, 2], [6, 5]])
