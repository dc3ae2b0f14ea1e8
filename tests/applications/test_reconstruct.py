"""Whole objects out of heights that are known: the shape comes back, and what was not felt is not made up."""

import numpy as np
import pytest

from jaxunshear.applications.contour import outline
from jaxunshear.applications.reconstruct import (
    best_threshold,
    filled_shape,
    fuse,
    likeness,
    nearness,
    skin_places,
    to_target,
)
from jaxunshear.scene.sensor import TACTIP_331
from jaxunshear.scene.stimuli import STIMULI, signed_distance


def walked(name, share=1.0):
    """A perfect walk around an object, with heights of 1 mm over it and 0 beside it."""
    line = outline(STIMULI[name])
    steps = line.at(np.arange(0, share * line.length, 0.5))
    yaw = np.degrees(np.arctan2(line.normal[steps, 1], line.normal[steps, 0]))
    point = np.column_stack([line.points[steps], yaw])
    xy = to_target(point, skin_places(TACTIP_331))
    height = (inside(name, xy)).astype(float)
    return line, point, height


def inside(name, xy):
    return np.asarray(signed_distance(STIMULI[name], xy.astype(np.float32))) < 0


def truth(name, fused):
    return inside(name, np.stack(np.meshgrid(fused.x, fused.y), -1))


@pytest.mark.parametrize("name", ["disk", "spiral_2"])
def test_perfect_heights_give_the_shape_back(name):
    line, point, height = walked(name)
    fused = fuse(TACTIP_331, point, height)
    got = likeness(fused, filled_shape(fused, 0.5), truth(name, fused), line)
    assert got.iou > 0.94 and got.mean_mm < 0.5 and got.hausdorff_mm < 3


def test_half_a_walk_encloses_nothing():
    line, point, height = walked("disk", share=0.5)
    fused = fuse(TACTIP_331, point, height)
    got = likeness(fused, filled_shape(fused, 0.5), truth("disk", fused), line)
    assert got.iou < 0.4 and got.hausdorff_mm > 20


def test_nothing_felt_is_told():
    line, point, height = walked("disk")
    fused = fuse(TACTIP_331, point, np.zeros_like(height))
    got = likeness(fused, filled_shape(fused, 0.5), truth("disk", fused), line)
    assert got.iou == 0 and np.isinf(got.hausdorff_mm)


def test_steps_without_pins_are_left_out():
    _, point, height = walked("disk")
    broken, wrong = height.copy(), height.copy()
    broken[::3] = np.nan
    wrong[::3] = 100
    some = np.arange(len(height)) % 3 != 0
    np.testing.assert_array_equal(
        fuse(TACTIP_331, point, broken).height, fuse(TACTIP_331, np.where(some[:, None], point, np.nan), wrong).height
    )


def test_a_turned_sensor_feels_the_same_place():
    place = np.array([[3.0, 0.0]])
    xy = to_target(np.array([[10.0, 5.0, 90.0], [10.0, 5.0, 0.0]]), place)
    np.testing.assert_allclose(xy[:, 0], [[10, 8], [13, 5]], atol=1e-12)


def test_the_threshold_parts_two_heaps():
    rng = np.random.default_rng(0)
    solid = rng.random((40, 50)) < 0.3
    height = np.where(solid, rng.normal(2, 0.3, solid.shape), rng.normal(0, 0.3, solid.shape))
    height[0, 0] = np.nan
    assert 0.7 < best_threshold(height, solid, np.ones(50)) < 1.3
    assert nearness(np.zeros((1, 2)))[0] == 1
