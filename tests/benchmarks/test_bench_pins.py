"""What `bench pins` says of frames whose pins are known."""

import numpy as np

from benchmarks import bench_pins
from tests.perception.test_pin_refinement import LATTICE, picture, slid


def test_errors_identities_and_times():
    true = np.stack([slid(), slid() + np.array([0.5, 0])])
    row = bench_pins.compare_pins(LATTICE, np.stack([picture(each) for each in true]), true)
    assert (
        row["frames"] == 2
        and row["sure"] == 1
        and row["wrong"] == 0
        and row["missed"] == row["extra"] == 0
    )
    assert 0 < row["rms_px"] < 0.15
    assert row["find_ms"] > 0 and row["follow_ms"] > 0 and row["ms"] <= row["ms_p95"]


def test_a_wrong_name_in_a_sure_frame_is_counted():
    others = slid()
    others[[10, 11]] = others[[11, 10]]
    row = bench_pins.compare_pins(LATTICE, picture(slid())[None], others[None])
    assert row["sure"] == 1 and row["wrong"] == 1


def test_frames_without_pins_are_not_sure():
    row = bench_pins.compare_pins(LATTICE, np.zeros((1, 256, 256), np.uint8), slid()[None])
    assert row["sure"] == 0 and row["wrong"] == 0 and row["missed"] == 331 and row["rms_px"] is None
