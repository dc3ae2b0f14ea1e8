"""Networks of one layout of pins that read another one."""

import numpy as np
import pytest

from benchmarks import bench_layouts
from benchmarks.bench_layouts import COLUMNS, interpolate_pins, set_layout
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331
from jaxunshear.perception.lattice import compute_rings, make_lattice


def make_square_lattice(sensor):
    return make_lattice(64 + 3.0 * sensor.place_pins(), compute_rings(sensor))


def test_other_layouts_reach_as_far_on_the_same_dome():
    for layout, pins in (("rings", 331), ("hexagonal", 127), ("rectangular", 165)):
        sensor = set_layout(TACTIP_331, layout)
        assert sensor.pins == pins and sensor.dome_radius_mm == TACTIP_331.dome_radius_mm
        assert np.linalg.norm(sensor.place_pins(), axis=-1).max() == pytest.approx(15.0)
    assert set_layout(TACTIP_127, "hexagonal") is TACTIP_127


def test_a_smooth_motion_is_carried_over_from_pins_to_pins():
    wanted, given = (
        make_square_lattice(set_layout(TACTIP_331, layout)) for layout in ("rings", "hexagonal")
    )
    turn = np.array([[0.02, -0.1], [0.1, 0.03]])
    motion = (given.rest - 64) @ turn.T + 1.5
    moved = interpolate_pins(given, motion[None], wanted.rest)[0] - wanted.rest
    expected = (wanted.rest - 64) @ turn.T + 1.5
    inner = np.linalg.norm(wanted.rest - 64, axis=-1) < 0.85 * 45  # inside of the hexagon
    np.testing.assert_allclose(moved[inner], expected[inner], atol=1e-9)
    assert np.abs(moved - expected).max() < 0.5 * 45 * 0.1  # the nearest pin's, beyond it
    same = interpolate_pins(given, motion[None], given.rest)[0] - given.rest
    np.testing.assert_allclose(same, motion, atol=1e-9)


def test_rows_have_errors_of_each_target(monkeypatch):
    for name, few in (("CONTACTS", 20), ("WEIGHTS", ("skin",)), ("RINGS", {"rings": 10})):
        monkeypatch.setattr(bench_layouts, name, few)
    rows = bench_layouts.bench_layouts(seed=1)
    assert [row["name"] for row in rows] == [
        f"skin/rings/{target}" for target in ("edge_mm", "edge_deg", "depth_mm")
    ]
    for row in rows:
        assert set(row) == set(COLUMNS) and row["pins"] == 331 and row["read"] > 0.9
        assert 0 < row["unsheared"] < row["slides"]
