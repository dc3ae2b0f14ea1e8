"""Poses, slides, labels, and the sensor's pins."""

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Sensor, get_sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.paths import DEPTH, TILT_X, YAW, make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import (
    NEAR_MM,
    compute_edge_labels,
    has_one_edge,
    make_scenes,
    sample_poses,
    sample_slides,
)


def test_draws_stay_in_range_and_repeat():
    first = sample_poses(np.random.default_rng(3), 500, 5.0, 45.0, (1.0, 6.0))
    np.testing.assert_array_equal(
        first, sample_poses(np.random.default_rng(3), 500, 5.0, 45.0, (1.0, 6.0))
    )
    assert np.all(np.abs(first[:, :2]) <= 5) and np.all(np.abs(first[:, 2]) <= 45)
    assert first[:, 3].min() >= 1 and first[:, 3].max() <= 6 and first[:, 3].max() > 5.5
    assert np.all(np.abs(sample_slides(np.random.default_rng(0), 500, 2.5)) <= 2.5)
    with pytest.raises(UserError, match="poses = 0"):
        sample_poses(np.random.default_rng(0), 0, 5.0, 45.0, (1.0, 6.0))


def test_edge_labels_on_the_disk():
    pose = np.array([[2.0, 0.0, 0.0, 1.0], [-3.0, 0.0, 30.0, 1.0], [0.0, 4.0, -45.0, 1.0]])
    scenes = make_scenes(("disk",), np.zeros(3, int), pose, np.zeros((3, 2)))
    labels = compute_edge_labels(("disk",), scenes)
    outward = np.degrees(np.arctan2(4, 50))
    np.testing.assert_allclose(
        labels, [[2, 0], [-3, -30], [np.hypot(50, 4) - 50, outward + 45]], atol=1e-2
    )
    assert scenes.friction[0] == pytest.approx(0.7)


def test_an_edge_has_one_direction_but_near_a_medial_axis():
    """Of the teardrop, whose flanks mirror each other about the x axis and end in a tip of 1 mm; of the
    disk at its centre; of the straight edge nowhere."""

    def one(shape, *points):
        xy = np.array(points, float)
        pose = np.column_stack([xy, np.full((len(xy), 2), 3.0)])
        return has_one_edge((shape,), np.zeros(len(xy), int), pose).tolist()

    inside = [
        [-5.0, 0.0],
        [-5.0, 0.9 * NEAR_MM],
        [-5.0, -0.9 * NEAR_MM],
        [-5.0, 1.1 * NEAR_MM],
        [-5.0, 2.5],
    ]
    assert one("teardrop", *inside) == [False, False, False, True, True]
    assert one("teardrop", [0.0, 0.0], [2.0, 0.0]) == [
        False,
        True,
    ]  # the tip turns fast: 1 and 3 mm from its centre
    assert one("disk", [-50.0, 0.0], [-50.0, 1.5], [-46.0, 0.0], [0.0, 0.0]) == [
        False,
        False,
        True,
        True,
    ]
    assert one("edge", [0.0, 0.0], [-4.0, 3.0]) == [True, True]
    assert one("surface", [0.0, 0.0]) == [False]  # no edge, no direction


def test_which_shape_is_touched_decides_whether_an_edge_has_one_direction():
    pose = np.array([[-5.0, 0.2, 0.0, 3.0]] * 3)
    assert has_one_edge(("disk", "teardrop", "edge"), np.array([1, 0, 2]), pose).tolist() == [
        False,
        True,
        True,
    ]


def test_pins_of_both_layouts():
    rings, hexagon = compute_pin_tips(TACTIP_331), compute_pin_tips(TACTIP_127)
    assert rings.shape == (331, 3) and hexagon.shape == (127, 3) == (TACTIP_127.pins, 3)
    for sensor, pins in ((TACTIP_331, rings), (TACTIP_127, hexagon)):
        centre = np.array([0, 0, sensor.dome_radius_mm])
        np.testing.assert_allclose(
            np.linalg.norm(pins - centre, axis=-1), 18.0
        )  # skin 1 mm, pins 1 mm
        gaps = np.linalg.norm(pins[:, None] - pins[None], axis=-1) + 99 * np.eye(len(pins))
        assert gaps.min() > 0.7 * sensor.pin_spacing_mm * 0.9
    neighbours = np.sort(np.linalg.norm(hexagon[1:7] - hexagon[0], axis=-1))
    np.testing.assert_allclose(neighbours, neighbours[0])


def test_bad_sensors_are_refused():
    with pytest.raises(UserError, match="tactip9"):
        get_sensor("tactip9")
    with pytest.raises(UserError, match="layout"):
        compute_pin_tips(Sensor(layout="square"))
    with pytest.raises(UserError, match="rim"):
        compute_pin_tips(Sensor(rings=30))


def test_a_path_twists_on_its_way_to_the_pose_and_keeps_its_tilt():
    pose = np.array([[2.0, -1.0, 30.0, 3.0, 4.0, -20.0]])
    points = make_paths(
        make_scenes(("disk",), np.zeros(1, int), pose, np.array([[1.5, 0.5, -5.0]]))
    ).points[0]
    np.testing.assert_array_equal(points[2], pose[0])
    np.testing.assert_array_equal(points[1], [0.5, -1.5, 35.0, 3.0, 4.0, -20.0])
    np.testing.assert_array_equal(
        points[0, [YAW, DEPTH]], [35.0, 0.0]
    )  # it is pressed down straight
    np.testing.assert_array_equal(points[:, TILT_X:], np.tile(pose[0, 4:], (3, 1)))


def test_upright_paths_are_what_they_were():
    pose, move = np.array([[2.0, -1.0, 30.0, 3.0]]), np.array([[1.5, 0.5]])
    upright = make_paths(make_scenes(("disk",), np.zeros(1, int), pose, move)).points
    wide = (
        np.concatenate([pose, np.zeros((1, 2))], axis=1),
        np.concatenate([move, np.zeros((1, 1))], axis=1),
    )
    np.testing.assert_array_equal(
        upright, make_paths(make_scenes(("disk",), np.zeros(1, int), *wide)).points
    )
