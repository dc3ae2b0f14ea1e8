"""Complete objects from known heights: the shape returns, and gaps stay gaps."""

import numpy as np
import pytest

from jaxunshear.config.image import Camera, Preprocess
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.data.simulated_contacts import SimulatedContacts
from jaxunshear.downstream.contour import trace_contour
from jaxunshear.downstream.reconstruct import (
    SKIN,
    VORONOI,
    HeightMap,
    compute_skin_positions,
    extract_ridge_shape,
    find_separating_level,
    fuse_heights,
    interpolate_map,
    make_shape_estimators,
    score_shape,
    transform_to_target,
)
from jaxunshear.errors import UserError
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.simulator.stimuli import STIMULI, compute_signed_distance

PLACES = np.array([xy for xy in compute_skin_positions(TACTIP_331) if np.linalg.norm(xy) < 6])
LATTICE = compute_rest_lattice(TACTIP_331, Camera(), Preprocess(size=128))


def follow_perfectly(name, share=1.0):
    """Follow an object perfectly, with heights of 1 over it and -1 beside it."""
    contour = trace_contour(STIMULI[name])
    steps = contour.at(np.arange(0, share * contour.length, 0.5))
    yaw = np.degrees(np.arctan2(contour.normal[steps, 1], contour.normal[steps, 0]))
    point = np.column_stack([contour.points[steps], yaw])
    return contour, point, np.where(is_inside(name, transform_to_target(point, PLACES)), 1.0, -1.0)


def fuse(point, value, cover_mm=0.0):
    return fuse_heights(
        point, np.broadcast_to(PLACES, (len(point), *PLACES.shape)), value, cover_mm
    )


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
    xy = transform_to_target(point, PLACES)
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
        compute_signed_distance(
            STIMULI[name], transform_to_target(point, PLACES).astype(np.float32)
        )
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


def test_a_level_misses_as_much_as_it_adds():
    generator = np.random.default_rng(0)
    over = np.arange(20_000) < 15_000
    values = generator.normal(np.where(over, 3.0, 1.0), 0.5)
    assert abs(find_separating_level(values, over) - 2.0) < 0.05


@pytest.fixture
def estimators():
    """Make estimators of made-up taps: skin over an edge is pressed in, and spreads its pins."""
    generator = np.random.default_rng(1)
    place, pins = compute_skin_positions(TACTIP_331), len(LATTICE.rest)
    angle, aside = generator.uniform(0, 2 * np.pi, 60), generator.uniform(-3, 3, 60)
    distance = place @ np.stack([np.cos(angle), np.sin(angle)]) - aside
    distance = distance.T
    pressed = 2.0 / (1 + np.exp(distance))
    spread = 0.1 * pressed[..., None] * (LATTICE.rest - LATTICE.centre)
    motion = spread + generator.normal(0, 0.05, spread.shape)
    assert pressed.shape == (60, pins)
    return make_shape_estimators(TACTIP_331, LATTICE, motion, pressed, distance), motion


def test_makers_agree_on_what_they_are_given(estimators):
    by_name, motion = estimators
    assert list(by_name) == [VORONOI, SKIN]
    assert not by_name[VORONOI].in_mm and by_name[SKIN].in_mm
    gaps = motion[:3].copy()
    gaps[1] = np.nan
    for estimator in by_name.values():
        value, place = estimator.estimate_values(gaps), estimator.locate_values(gaps)
        assert place.shape == (*value.shape, 2)
        assert np.isnan(value[1]).all() and not np.isnan(value[[0, 2]]).any()


def test_untouched_skin_stands_as_the_dome_does(estimators):
    estimator = estimators[0][SKIN]
    still = np.zeros((1, *LATTICE.rest.shape))
    distance = np.linalg.norm(estimator.locate_values(still)[0], axis=-1)
    radius = TACTIP_331.dome_radius_mm
    np.testing.assert_allclose(
        estimator.estimate_values(still)[0], radius - np.sqrt(radius**2 - distance**2), atol=1e-9
    )


def test_small_images_are_refused():
    from jaxunshear.downstream.geometry import measure_tap_motions

    blank = np.zeros((2, 32, 32), np.uint8)
    none = np.zeros((2, 0))
    with pytest.raises(UserError, match="of 32 px: use a model of larger images"):
        measure_tap_motions(
            LATTICE, SimulatedContacts(none, none, blank, blank, none, none, none, 0)
        )
