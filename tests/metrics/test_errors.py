"""Errors of poses and of pins on known answers."""

import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.metrics import compute_pose_errors
from jaxunshear.metrics.errors import match_pins, measure_pin_error
from tests.helpers.dots import draw_dots, make_lattice


def quantities(x, yaw, edge, angle):
    values = zip(("x_mm", "yaw_deg", "edge_mm", "edge_deg"), (x, yaw, edge, angle), strict=True)
    return {name: np.array([value], np.float32) for name, value in values}


def test_known_errors():
    errors = compute_pose_errors(quantities(1, 40, -2, 10), quantities(3, -5, 0.5, 12))
    assert errors == {"x_mm": 2, "yaw_deg": 45, "edge_mm": 2.5, "edge_deg": 2}


@pytest.mark.parametrize(
    ("a", "b", "error"), [(179, -179, 2), (-180, 180, 0), (90, -90, 180), (350, 0, 10)]
)
def test_angles_go_the_short_way_round(a, b, error):
    errors = compute_pose_errors(quantities(0, 0, 0, a), quantities(0, 0, 0, b))
    assert errors["edge_deg"] == pytest.approx(error, abs=1e-4)


def test_true_values_take_the_right_columns():
    batch = {"pose": np.array([[1.0, 2, 3, 4]]), "edge": np.array([[5.0, 6]])}
    true = read_true_values(make_range_targets((), Ranges()), batch)
    assert true == {"x_mm": 1, "yaw_deg": 3, "edge_mm": 5, "edge_deg": 6}


def test_errors_come_in_the_order_of_the_labels():
    true = quantities(0, 0, 0, 0)
    other_order = {name: true[name] for name in sorted(true)}
    assert tuple(compute_pose_errors(other_order, true)) == tuple(true)
    assert tuple(compute_pose_errors({"edge_mm": true["edge_mm"]}, true)) == ("edge_mm",)


def test_missing_quantities_and_lengths_are_refused():
    good = quantities(0, 0, 0, 0)
    with pytest.raises(ValueError, match="edge_mm"):
        compute_pose_errors(good, {name: good[name] for name in ("x_mm", "yaw_deg", "edge_deg")})
    with pytest.raises(ValueError, match="x_mm"):
        compute_pose_errors(good, {**good, "x_mm": np.zeros(2)})


def test_matching_is_one_to_one_and_counts_what_is_left():
    true = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    found = np.array([[0.5, 0.0], [0.2, 0.0], [10.0, 1.0], [100.0, 0.0]])
    match = match_pins(found, true, limit_px=3.0)
    np.testing.assert_allclose(sorted(match.error_px), [0.2, 1.0])
    assert (match.missed, match.extra) == (1, 2)


def test_a_far_outlier_does_not_bend_the_other_pairs():
    true = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]])
    found = np.array([[4.1, 0.0], [8.1, 0.0], [500.0, 0.0]])
    np.testing.assert_allclose(match_pins(found, true, 2.0).error_px, [0.1, 0.1], atol=1e-9)


@pytest.mark.parametrize(("found", "true"), [(0, 5), (4, 0)])
def test_nothing_found_or_nothing_there(found, true):
    assert match_pins(np.zeros((found, 2)), np.zeros((true, 2)), 1.0)[1:] == (true, found)


def test_pin_error_of_a_known_shift():
    centres = np.tile(make_lattice(9, 256)[None], (2, 1, 1))
    images = np.stack([draw_dots(c, 3.0, 256) for c in centres])
    error = measure_pin_error(images, centres + np.array([1.0, 0.0]), limit_px=9.0)
    assert error["rms_px"] == pytest.approx(1.0, abs=0.1)
    assert error["missed_per_image"] == error["extra_per_image"] == 0
    lost = measure_pin_error(images * 0, centres, limit_px=9.0)
    assert np.isnan(lost["rms_px"])
    assert lost["missed_per_image"] == centres.shape[1]
