"""Labels become the motions that they describe."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxunshear.calibration.labels import FLAT_DISTANCE_MM, make_paths, read_motions
from jaxunshear.config.sensor import TACTIP_331

RADIUS = TACTIP_331.dome_radius_mm
# x y z mm, Rx Ry Rz deg: the work frame's z points into the object
POSES = np.array(
    [[0, -2.0, 4.0, 0, 0, 30.0], [0, 1.0, 3.5, 10.0, -15.0, -20.0], [0, 5.0, 3.0, 0, 0, 170.0]]
)
MOVES = np.array([[1.0, 2.0, 0, 0, 0, 3.0], [-1.0, 0.5, 0, 4.0, -2.0, 0], [0, 0, 0, 0, 0, 40.0]])
# x across the edge, z out of the object
WORK_TO_SCENE = np.array([[0, 1.0, 0], [1.0, 0, 0], [0, 0, -1.0]])


def _rotate_as_labelled(label):
    labelled = Rotation.from_euler("xyz", label[3:], degrees=True).as_matrix()
    return WORK_TO_SCENE @ labelled @ WORK_TO_SCENE.T


@pytest.mark.parametrize("side", [1, -1])
def test_points_hold_the_undeformed_dome(side):
    """The lowest point of a sphere that stands as the labels say has the path's depth and place."""
    paths = make_paths(
        read_motions(POSES, MOVES), TACTIP_331, surface_mm=1.0, side=side, friction=0.3
    )
    polar, around = np.meshgrid(
        np.radians(np.arange(0, 40, 0.05)), np.radians(np.arange(0, 360, 0.5)), indexing="ij"
    )
    cap = RADIUS * np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), 1 - np.cos(polar)], -1
    )
    half = np.diag([side, side, 1])
    for i in range(len(POSES)):
        for point, label in ((1, POSES[i] - MOVES[i]), (2, POSES[i])):
            turn = half @ _rotate_as_labelled(label)
            skin = half @ WORK_TO_SCENE @ label[:3] + cap.reshape(-1, 3) @ turn.T
            lowest = skin[np.argmin(skin[:, 2])]
            x, y, _, depth = paths.points[i, point, :4]
            assert depth == pytest.approx(-lowest[2] - 1.0, abs=1e-3)
            np.testing.assert_allclose([x, y], lowest[:2], atol=0.1)


def test_yaw_and_tilt_make_up_the_turn():
    paths = make_paths(read_motions(POSES, MOVES), TACTIP_331, surface_mm=0.0, side=1, friction=0.3)
    for i in range(len(POSES)):
        yaw, _, tilt_x, tilt_y = paths.points[i, 2, 2:]
        turn = Rotation.from_euler("z", yaw, degrees=True) * Rotation.from_rotvec(
            [tilt_x, tilt_y, 0], degrees=True
        )
        np.testing.assert_allclose(turn.as_matrix(), _rotate_as_labelled(POSES[i]), atol=1e-12)


def test_twist_takes_the_short_way():
    """170 degrees reached from 130 is a twist of 40, also across the jump at 180."""
    for last in (170.0, 190.0):
        pose = np.array([[0, 0, 3.0, 0, 0, last], [0, 1, 3.5, 0, 0, 0]])
        move = np.array([[0, 0, 0, 0, 0, 40.0], [0, 0, 0, 0, 0, 0]])
        points = make_paths(read_motions(pose, move), TACTIP_331, 0.0, 0, 0.3).points
        assert abs(points[0, 2, 2] - points[0, 1, 2]) == pytest.approx(40)


def test_flat_contacts_end_inland():
    contacts = read_motions(POSES[:1], MOVES[:1])
    points = make_paths(contacts, TACTIP_331, surface_mm=1.5, side=0, friction=0.3).points[0]
    np.testing.assert_allclose(points[2, 0], -FLAT_DISTANCE_MM)
    np.testing.assert_allclose(points[2, :2] - points[1, :2], contacts.slide[0])
    np.testing.assert_allclose(points[:, 3], [0, 2.5, 2.5])


def test_the_depth_axis_is_the_one_that_varies():
    """A wall: presses along y, tilts about z, slides along x."""
    poses = np.zeros((3, 6))
    poses[:, 1], poses[:, 5] = [-3, -2, -1], [-10, 0, 20]
    moves = np.zeros((3, 6))
    moves[:, 0] = [2, -1, 0.5]
    contacts = read_motions(poses, moves)
    np.testing.assert_allclose(-contacts.tip[:, 1, 2], [-3, -2, -1])
    upright = contacts.turn[len(poses) :].as_matrix()[:, 2, 2]
    np.testing.assert_allclose(upright, np.cos(np.radians([10, 0, 20])), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(contacts.slide, axis=-1), [2, 1, 0.5])
    assert not contacts.across
    np.testing.assert_array_equal(read_motions(poses, None).slide, 0)


@pytest.mark.parametrize("side", [0, 1, -1])
def test_where_along_the_edge_a_contact_lies_does_not_matter(side):
    """A simulated half plane has an end; recordings may be made far from their origin."""
    poses = np.tile([300.0, 1.0, -40.0, 0, 0, 5.0], (3, 1)) + np.diag([0.5, 1.0, 0.2, 0, 0, 0])[:3]
    moves = np.tile([0.3, 0.4, 0, 0, 0, 0], (3, 1))
    far, near = (
        make_paths(read_motions(each, moves), TACTIP_331, -43.0, side, 0.5).points
        for each in (poses, poses - [300, 0, 0, 0, 0, 0])
    )
    np.testing.assert_allclose(far[:, -1, 1], 0, atol=1e-9)
    np.testing.assert_allclose(far, near, atol=1e-9)
