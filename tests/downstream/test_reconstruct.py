"""Complete objects from known heights: the shape returns, and gaps stay gaps."""

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.downstream.contour import trace_contour
from jaxunshear.downstream.reconstruct import (
    HeightMap,
    compute_skin_positions,
    extract_ridge_shape,
    fuse_heights,
    interpolate_map,
    score_shape,
    transform_to_target,
)
from jaxunshear.simulator.stimuli import STIMULI, compute_signed_distance

SKIN = np.array([xy for xy in compute_skin_positions(TACTIP_331) if np.linalg.norm(xy) < 6])


def follow_perfectly(name, share=1.0):
    """Follow an object perfectly, with heights of 1 over it and -1 beside it."""
    contour = trace_contour(STIMULI[name])
    steps = contour.at(np.arange(0, share * contour.length, 0.5))
    yaw = np.degrees(np.arctan2(contour.normal[steps, 1], contour.normal[steps, 0]))
    point = np.column_stack([contour.points[steps], yaw])
    return contour, point, np.where(is_inside(name, transform_to_target(point, SKIN)), 1.0, -1.0)


def fuse(point, value, cover_mm=0.0):
    return fuse_heights(point, np.broadcast_to(SKIN, (len(point), *SKIN.shape)), value, cover_mm)


def extract_above(fused):
    return np.nan_to_num(interpolate_map(fused), nan=-np.inf) > 0


def is_inside(name, xy):
    return np.asarray(compute_signed_distance(STIMULI[name], xy.astype(np.float32))) < 0


def find_truth(name, fused):
    return is_inside(name, fused.xy)


@pytest.mark.parametrize("name", ["disk", "spiral_2"])
def test_perfect_heights_give_the_shape_back(name):
    contour, point, height = follow_perfectly(name)
    fused = fuse(point, height)
    score = score_shape(fused, extract_above(fused), find_truth(name, fused), contour)
    assert score.iou > 0.94 and score.mean_mm < 0.5 and score.hausdorff_mm < 3


def test_what_a_walk_did_not_reach_still_counts():
    contour, point, height = follow_perfectly("disk", share=0.05)
    reach = np.abs(contour.points).max()
    fused = fuse(point, height, reach)
    assert fused.line[-1] >= reach - 0.5
    assert score_shape(fused, extract_above(fused), find_truth("disk", fused), contour).iou < 0.05


def test_nothing_felt_is_reported():
    contour, point, height = follow_perfectly("disk")
    fused = fuse(point, -np.abs(height))
    score = score_shape(fused, extract_above(fused), find_truth("disk", fused), contour)
    assert score.iou == 0 and np.isinf(score.hausdorff_mm)


def test_steps_without_pins_are_left_out():
    _, point, height = follow_perfectly("disk")
    broken, wrong = height.copy(), height.copy()
    broken[::3] = np.nan
    wrong[::3] = 100
    some = np.arange(len(height)) % 3 != 0
    np.testing.assert_array_equal(
        fuse(point, broken).value, fuse(np.where(some[:, None], point, np.nan), wrong).value
    )


def test_a_turned_sensor_feels_the_same_place():
    place = np.array([[3.0, 0.0]])
    xy = transform_to_target(np.array([[10.0, 5.0, 90.0], [10.0, 5.0, 0.0]]), place)
    np.testing.assert_allclose(xy[:, 0], [[10, 8], [13, 5]], atol=1e-12)


@pytest.mark.parametrize("name", ["disk", "clover"])
def test_heights_are_interpolated_to_the_full_object(name):
    contour, point, _ = follow_perfectly(name)
    xy = transform_to_target(point, SKIN)
    height = np.where(is_inside(name, xy), 3.0, 1.0)
    fused = fuse(point, height)
    full = interpolate_map(fused)
    score = score_shape(
        fused, np.nan_to_num(full, nan=-np.inf) > 2, find_truth(name, fused), contour
    )
    assert score.iou > 0.94 and score.iou_touched > 0.9
    known = ~np.isnan(fused.value)
    np.testing.assert_array_equal(full[known], fused.value[known])
    assert np.count_nonzero(~np.isnan(full)) > np.count_nonzero(known)


@pytest.mark.parametrize(
    ("name", "share"), [("disk", 1.0), ("clover", 1.0), ("teardrop", 1.0), ("disk", 0.5)]
)
def test_what_a_closed_ridge_surrounds_is_the_object(name, share):
    """Use heights like the growth of cells: greatest on the edge, least outside."""
    contour, point, _ = follow_perfectly(name, share)
    distance = np.asarray(
        compute_signed_distance(STIMULI[name], transform_to_target(point, SKIN).astype(np.float32))
    )
    fused = fuse(point, np.exp(-(distance**2) / 8) + 0.5 / (1 + np.exp(2 * distance)))
    score = score_shape(fused, extract_ridge_shape(fused), find_truth(name, fused), contour)
    assert score.iou > 0.95 if share == 1 else score.iou < 0.6


def test_a_height_without_a_hollow_is_no_ridge():
    x = np.arange(-8, 9.0)
    hill = np.exp(-(x[None] ** 2 + x[:, None] ** 2) / 20)
    assert not extract_ridge_shape(HeightMap(x, hill)).any()
    assert not extract_ridge_shape(HeightMap(x, np.full(hill.shape, np.nan))).any()


def test_between_cells_heights_are_linear():
    x = np.arange(6.0)
    plane = 1 + 2 * x[None] - x[:, None]
    holes = plane.copy()
    holes[1:5, 2:4] = np.nan
    np.testing.assert_allclose(interpolate_map(HeightMap(x, holes)), plane, atol=1e-9)


def test_skin_goes_where_its_pins_went():
    point = np.array([[10.0, 5.0, 90.0], [0.0, 0.0, 0.0]])
    place = np.array([[[3.0, 0.0]], [[4.0, 1.0]]])
    np.testing.assert_allclose(
        transform_to_target(point, place)[:, 0], [[10, 8], [4, 1]], atol=1e-12
    )
