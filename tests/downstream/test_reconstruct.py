"""Complete objects out of heights that are known: the shape comes back, and what was not felt is not made up."""

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

PLACE = np.array(
    [place for place in compute_skin_positions(TACTIP_331) if np.linalg.norm(place) < 6]
)


def walked(name, share=1.0):
    """A perfect walk around an object, with heights of 1 over it and -1 beside it."""
    line = trace_contour(STIMULI[name])
    steps = line.at(np.arange(0, share * line.length, 0.5))
    yaw = np.degrees(np.arctan2(line.normal[steps, 1], line.normal[steps, 0]))
    point = np.column_stack([line.points[steps], yaw])
    return line, point, np.where(inside(name, transform_to_target(point, PLACE)), 1.0, -1.0)


def felt(point, value, cover_mm=0.0):
    return fuse_heights(point, np.broadcast_to(PLACE, (len(point), *PLACE.shape)), value, cover_mm)


def above(fused):
    return np.nan_to_num(interpolate_map(fused), nan=-np.inf) > 0


def inside(name, xy):
    return np.asarray(compute_signed_distance(STIMULI[name], xy.astype(np.float32))) < 0


def truth(name, fused):
    return inside(name, fused.xy)


@pytest.mark.parametrize("name", ["disk", "spiral_2"])
def test_perfect_heights_give_the_shape_back(name):
    line, point, height = walked(name)
    fused = felt(point, height)
    got = score_shape(fused, above(fused), truth(name, fused), line)
    assert got.iou > 0.94 and got.mean_mm < 0.5 and got.hausdorff_mm < 3


def test_what_a_walk_did_not_reach_still_counts():
    line, point, height = walked("disk", share=0.05)
    reach = np.abs(line.points).max()
    fused = felt(point, height, reach)
    assert fused.line[-1] >= reach - 0.5
    assert score_shape(fused, above(fused), truth("disk", fused), line).iou < 0.05


def test_nothing_felt_is_reported():
    line, point, height = walked("disk")
    fused = felt(point, -np.abs(height))
    got = score_shape(fused, above(fused), truth("disk", fused), line)
    assert got.iou == 0 and np.isinf(got.hausdorff_mm)


def test_steps_without_pins_are_left_out():
    _, point, height = walked("disk")
    broken, wrong = height.copy(), height.copy()
    broken[::3] = np.nan
    wrong[::3] = 100
    some = np.arange(len(height)) % 3 != 0
    np.testing.assert_array_equal(
        felt(point, broken).value, felt(np.where(some[:, None], point, np.nan), wrong).value
    )


def test_a_turned_sensor_feels_the_same_place():
    place = np.array([[3.0, 0.0]])
    xy = transform_to_target(np.array([[10.0, 5.0, 90.0], [10.0, 5.0, 0.0]]), place)
    np.testing.assert_allclose(xy[:, 0], [[10, 8], [13, 5]], atol=1e-12)


@pytest.mark.parametrize("name", ["disk", "clover"])
def test_heights_are_interpolated_to_the_full_object(name):
    line, point, _ = walked(name)
    xy = transform_to_target(point, PLACE)
    height = np.where(inside(name, xy), 3.0, 1.0)
    fused = felt(point, height)
    full = interpolate_map(fused)
    got = score_shape(fused, np.nan_to_num(full, nan=-np.inf) > 2, truth(name, fused), line)
    assert got.iou > 0.94 and got.iou_touched > 0.9
    known = ~np.isnan(fused.value)
    np.testing.assert_array_equal(full[known], fused.value[known])
    assert np.count_nonzero(~np.isnan(full)) > np.count_nonzero(known)


@pytest.mark.parametrize(
    ("name", "share"), [("disk", 1.0), ("clover", 1.0), ("teardrop", 1.0), ("disk", 0.5)]
)
def test_what_a_closed_ridge_surrounds_is_the_object(name, share):
    """Heights as of cells that grow over an edge: greatest on it, lower inside, lower still outside."""
    line, point, _ = walked(name, share)
    off = np.asarray(
        compute_signed_distance(STIMULI[name], transform_to_target(point, PLACE).astype(np.float32))
    )
    fused = felt(point, np.exp(-(off**2) / 8) + 0.5 / (1 + np.exp(2 * off)))
    got = score_shape(fused, extract_ridge_shape(fused), truth(name, fused), line)
    assert got.iou > 0.95 if share == 1 else got.iou < 0.6


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


def test_of_nothing_felt_there_is_no_map():
    x = np.arange(6.0)
    assert np.isnan(interpolate_map(HeightMap(x, np.full((6, 6), np.nan)))).all()


def test_skin_goes_where_its_pins_went():
    point = np.array([[10.0, 5.0, 90.0], [0.0, 0.0, 0.0]])
    place = np.array([[[3.0, 0.0]], [[4.0, 1.0]]])
    np.testing.assert_allclose(
        transform_to_target(point, place)[:, 0], [[10, 8], [4, 1]], atol=1e-12
    )
