"""Complete objects from known heights: the shape returns, and gaps stay gaps."""

from typing import NamedTuple

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331, Camera, Preprocess
from jaxunshear.downstream.contour import Contour, trace_contour
from jaxunshear.downstream.reconstruct import (
    HeightMap,
    compute_skin_positions,
    extract_ridge_shape,
    fuse_heights,
    interpolate_map,
    score_shape,
    transform_to_target,
)
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.simulator.stimuli import STIMULI, compute_signed_distance

PLACES = np.array([xy for xy in compute_skin_positions(TACTIP_331) if np.linalg.norm(xy) < 6])
LATTICE = compute_rest_lattice(TACTIP_331, Camera(), Preprocess(size=128))


class Walk(NamedTuple):
    """A perfect one around an object, and the distance of its skin from the edge."""

    name: str
    contour: Contour
    point: np.ndarray
    distance: np.ndarray

    @property
    def height(self):
        """1 over the object and -1 beside it."""
        return np.where(self.distance < 0, 1.0, -1.0)

    def score(self, fused, is_over):
        distance = compute_signed_distance(STIMULI[self.name], fused.xy.astype(np.float32))
        return score_shape(fused, is_over, np.asarray(distance) < 0, self.contour)


def follow_perfectly(name, share=1.0):
    contour = trace_contour(STIMULI[name])
    steps = contour.at(np.arange(0, share * contour.length, 0.5))
    yaw = np.degrees(np.arctan2(contour.normal[steps, 1], contour.normal[steps, 0]))
    point = np.column_stack([contour.points[steps], yaw])
    xy = transform_to_target(point, PLACES).astype(np.float32)
    return Walk(name, contour, point, np.asarray(compute_signed_distance(STIMULI[name], xy)))


def fuse(point, value, cover_mm=0.0):
    return fuse_heights(
        point, np.broadcast_to(PLACES, (len(point), *PLACES.shape)), value, cover_mm
    )


def extract_above(fused, level=0):
    return np.nan_to_num(interpolate_map(fused), nan=-np.inf) > level


@pytest.mark.parametrize("name", ["disk", "spiral_2"])
def test_perfect_heights_give_the_shape_back(name):
    walk = follow_perfectly(name)
    fused = fuse(walk.point, walk.height)
    score = walk.score(fused, extract_above(fused))
    assert score.iou > 0.94 and score.mean_mm < 0.5 and score.hausdorff_mm < 3


def test_what_a_walk_did_not_reach_still_counts():
    walk = follow_perfectly("disk", share=0.05)
    reach = np.abs(walk.contour.points).max()
    fused = fuse(walk.point, walk.height, reach)
    assert fused.line[-1] >= reach - 0.5
    assert walk.score(fused, extract_above(fused)).iou < 0.05


def test_nothing_felt_is_reported():
    walk = follow_perfectly("disk")
    fused = fuse(walk.point, -np.abs(walk.height))
    score = walk.score(fused, extract_above(fused))
    assert score.iou == 0 and np.isinf(score.hausdorff_mm)


def test_steps_without_pins_are_left_out():
    _, _, point, _ = walk = follow_perfectly("disk")
    some = (np.arange(len(point)) % 3 != 0)[:, None]
    broken = fuse(point, np.where(some, walk.height, np.nan))
    absent = fuse(np.where(some, point, np.nan), np.where(some, walk.height, 100))
    np.testing.assert_array_equal(broken.value, absent.value)


def test_a_turned_sensor_feels_the_same_place_and_skin_goes_where_its_pins_went():
    point = np.array([[10.0, 5.0, 90.0], [10.0, 5.0, 0.0], [0.0, 0.0, 0.0]])
    xy = transform_to_target(point, np.array([[3.0, 0.0]]))
    np.testing.assert_allclose(xy[:, 0], [[10, 8], [13, 5], [3, 0]], atol=1e-12)
    xy = transform_to_target(point[::2], np.array([[[3.0, 0.0]], [[4.0, 1.0]]]))
    np.testing.assert_allclose(xy[:, 0], [[10, 8], [4, 1]], atol=1e-12)


@pytest.mark.parametrize("name", ["disk", "clover"])
def test_heights_are_interpolated_to_the_full_object(name):
    walk = follow_perfectly(name)
    fused = fuse(walk.point, walk.height + 2)
    full = interpolate_map(fused)
    score = walk.score(fused, extract_above(fused, 2))
    assert score.iou > 0.94 and score.iou_touched > 0.9
    known = ~np.isnan(fused.value)
    np.testing.assert_array_equal(full[known], fused.value[known])
    assert np.count_nonzero(~np.isnan(full)) > np.count_nonzero(known)


@pytest.mark.parametrize(
    ("name", "share"), [("disk", 1.0), ("clover", 1.0), ("teardrop", 1.0), ("disk", 0.5)]
)
def test_what_a_closed_ridge_surrounds_is_the_object(name, share):
    """Use heights like the growth of cells: greatest on the edge, least outside."""
    walk = follow_perfectly(name, share)
    growth = np.exp(-(walk.distance**2) / 8) + 0.5 / (1 + np.exp(2 * walk.distance))
    fused = fuse(walk.point, growth)
    score = walk.score(fused, extract_ridge_shape(fused))
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
