"""Pose errors on known answers."""

import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.metrics import compute_pose_errors

NAMES = ("x_mm", "yaw_deg", "edge_mm", "edge_deg")


def quantities(*values):
    return {name: np.array([value], np.float32) for name, value in zip(NAMES, values, strict=True)}


def test_known_errors():
    errors = compute_pose_errors(quantities(1, 40, -2, 10), quantities(3, -5, 0.5, 12))
    assert errors == quantities(2, 45, 2.5, 2)


@pytest.mark.parametrize(
    ("a", "b", "error"), [(179, -179, 2), (-180, 180, 0), (90, -90, 180), (350, 0, 10)]
)
def test_angles_go_the_short_way_round(a, b, error):
    found = compute_pose_errors(quantities(0, 0, 0, a), quantities(0, 0, 0, b))["edge_deg"]
    assert found[0] == pytest.approx(error, abs=1e-4)


def test_true_values_take_the_right_columns():
    batch = {"pose": np.array([[1.0, 2, 3, 4]]), "edge": np.array([[5.0, 6]])}
    assert read_true_values(make_range_targets((), Ranges()), batch) == quantities(1, 3, 5, 6)


def test_errors_come_in_the_order_of_the_labels():
    true = quantities(0, 0, 0, 0)
    assert tuple(compute_pose_errors({name: true[name] for name in sorted(true)}, true)) == NAMES
    assert tuple(compute_pose_errors({"edge_mm": true["edge_mm"]}, true)) == ("edge_mm",)


def test_missing_quantities_and_lengths_are_refused():
    good = quantities(0, 0, 0, 0)
    with pytest.raises(ValueError, match="edge_mm"):
        compute_pose_errors(good, {name: good[name] for name in ("x_mm", "yaw_deg", "edge_deg")})
    with pytest.raises(ValueError, match="x_mm"):
        compute_pose_errors(good, {**good, "x_mm": np.zeros(2)})
