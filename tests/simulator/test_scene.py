"""Poses, slides, labels, and the sensor's pins."""

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, get_sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import (
    NEAR_MM,
    compute_edge_labels,
    has_one_edge,
    make_scenes,
    sample_poses,
    sample_slides,
)


def make_taps(shape, pose):
    return make_scenes((shape,), np.zeros(len(pose), int), pose, np.zeros((len(pose), 2)))


def test_samples_stay_in_range_and_repeat():
    def sample(count=500):
        return sample_poses(np.random.default_rng(3), count, 5.0, 45.0, (1.0, 6.0))

    first, again = sample(), sample()
    np.testing.assert_array_equal(first, again)
    assert np.all(np.abs(first[:, :2]) <= 5) and np.all(np.abs(first[:, 2]) <= 45)
    assert first[:, 3].min() >= 1 and 5.5 < first[:, 3].max() <= 6
    assert np.all(np.abs(sample_slides(np.random.default_rng(0), 500, 2.5)) <= 2.5)
    with pytest.raises(UserError, match="poses = 0"):
        sample(0)


DISK_POSES = [[2.0, 0.0, 0.0, 1.0], [-3.0, 0.0, 30.0, 1.0], [0.0, 4.0, -45.0, 1.0]]
DISK_LABELS = [[2, 0], [-3, -30], [np.hypot(50, 4) - 50, np.degrees(np.arctan2(4, 50)) + 45]]
EDGE_POSES = [[2.5, -4.0, 30.0, 2.0], [-1.0, 3.0, -170.0, 2.0], [0.5, 0.0, 180.0, 1.0]]
EDGE_LABELS = [[2.5, -30], [-1.0, 170], [0.5, 180]]


@pytest.mark.parametrize(
    ("shape", "pose", "labels", "atol"),
    [("disk", DISK_POSES, DISK_LABELS, 1e-2), ("edge", EDGE_POSES, EDGE_LABELS, 1e-5)],
)
def test_edge_labels(shape, pose, labels, atol):
    scenes = make_taps(shape, np.array(pose))
    np.testing.assert_allclose(compute_edge_labels((shape,), scenes), labels, atol=atol)
    assert scenes.friction[0] == pytest.approx(0.7)


# the teardrop's flanks mirror each other about the x axis and end in a tip of 1 mm
INSIDE = [[-5.0, share * NEAR_MM] for share in (0.0, 0.9, -0.9, 1.1, 2.5)]


@pytest.mark.parametrize(
    ("shape", "places", "expected"),
    [
        ("teardrop", INSIDE, [False, False, False, True, True]),
        # the tip turns fast: 1 and 3 mm from its centre
        ("teardrop", [[0.0, 0.0], [2.0, 0.0]], [False, True]),
        (
            "disk",
            [[-50.0, 0.0], [-50.0, 1.5], [-46.0, 0.0], [0.0, 0.0]],
            [False, False, True, True],
        ),
        ("edge", [[0.0, 0.0], [-4.0, 3.0]], [True, True]),
        ("surface", [[0.0, 0.0]], [False]),  # no edge, no direction
    ],
)
def test_an_edge_has_one_direction_but_near_a_medial_axis(shape, places, expected):
    pose = np.column_stack([places, np.full((len(places), 2), 3.0)])
    assert has_one_edge((shape,), np.zeros(len(places), int), pose).tolist() == expected


def test_each_scene_is_judged_by_its_own_shape():
    pose = np.array([[-5.0, 0.2, 0.0, 3.0]] * 3)
    found = has_one_edge(("disk", "teardrop", "edge"), np.array([1, 0, 2]), pose)
    assert found.tolist() == [False, True, True]


@pytest.mark.parametrize(("sensor", "count"), [(TACTIP_331, 331), (TACTIP_127, 127)])
def test_pins_stand_on_the_skin_and_apart(sensor, count):
    pins = compute_pin_tips(sensor)
    assert pins.shape == (count, 3) == (sensor.pins, 3)
    centre = np.array([0, 0, sensor.dome_radius_mm])
    # skin 1 mm, pins 1 mm
    np.testing.assert_allclose(np.linalg.norm(pins - centre, axis=-1), 18.0)
    gaps = np.linalg.norm(pins[:, None] - pins[None], axis=-1) + 99 * np.eye(len(pins))
    assert gaps.min() > 0.63 * sensor.pin_spacing_mm
    neighbours = np.linalg.norm(pins[1:7] - pins[0], axis=-1)
    np.testing.assert_allclose(neighbours, neighbours[0])


def test_an_unknown_sensor_is_refused():
    with pytest.raises(UserError, match="tactip9"):
        get_sensor("tactip9")


def test_a_path_twists_on_its_way_to_the_pose_and_keeps_its_tilt():
    pose, move = np.array([[2.0, -1.0, 30.0, 3.0, 4.0, -20.0]]), np.array([[1.5, 0.5, -5.0]])
    points = make_paths(make_scenes(("disk",), np.zeros(1, int), pose, move)).points[0]
    pressed = [0.5, -1.5, 35.0, 3.0, 4.0, -20.0]  # straight down
    np.testing.assert_array_equal(points, [[*pressed[:3], 0.0, *pressed[4:]], pressed, pose[0]])
    upright = make_paths(make_taps("disk", pose[:, :4])).points
    np.testing.assert_array_equal(upright[0, -1], [2.0, -1.0, 30.0, 3.0, 0.0, 0.0])
