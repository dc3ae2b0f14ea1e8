"""Pose errors on known answers."""

import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.metrics import compute_pose_errors


def quantities(x, yaw, edge, angle):
    values = zip(("x_mm", "yaw_deg", "edge_mm", "edge_deg"), (x, yaw, edge, angle), strict=True)
    return {name: np.array([value], np.float32) for name, value in values}


def test_known_errors():
    errors = compute_pose_errors(quantities(1, 40, -2, 10), quantities(3, -5, 0.5, 12))
    assert {name: float(error[0]) for name, error in errors.items()} == {
        "x_mm": 2, "yaw_deg": 45, "edge_mm": 2.5, "edge_deg": 2}  # fmt: skip


@pytest.mark.parametrize(
    ("a", "b", "error"), [(179, -179, 2), (-180, 180, 0), (90, -90, 180), (350, 0, 10)]
)
def test_angles_go_the_short_way_round(a, b, error):
    assert compute_pose_errors(quantities(0, 0, 0, a), quantities(0, 0, 0, b))["edge_deg"][
        0
    ] == pytest.approx(error, abs=1e-4)


def test_true_values_take_the_right_columns():
    batch = {"pose": np.array([[1.0, 2, 3, 4]]), "edge": np.array([[5.0, 6]])}
    true = read_true_values(make_range_targets((), Ranges()), batch)
    assert {name: value[0] for name, value in true.items()} == {
        "x_mm": 1,
        "yaw_deg": 3,
        "edge_mm": 5,
        "edge_deg": 6,
    }


def test_errors_come_in_the_order_of_the_labels():
    true = quantities(0, 0, 0, 0)
    assert tuple(compute_pose_errors({name: true[name] for name in sorted(true)}, true)) == tuple(
        true
    )
    assert tuple(compute_pose_errors({"edge_mm": true["edge_mm"]}, true)) == ("edge_mm",)


def test_missing_quantities_and_lengths_are_refused():
    good = quantities(0, 0, 0, 0)
    with pytest.raises(ValueError, match="edge_mm"):
        compute_pose_errors(good, {name: good[name] for name in ("x_mm", "yaw_deg", "edge_deg")})
    with pytest.raises(ValueError, match="x_mm"):
        compute_pose_errors(good, {**good, "x_mm": np.zeros(2)})
