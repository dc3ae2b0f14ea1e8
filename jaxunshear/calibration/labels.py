"""The labels of a recording as motions that can be simulated.

Robots report six numbers in a work frame whose depth axis points into the object: the position of
the sensor's tip and static Euler angles x, y, z about it. The sensor hovered, pressed at
`pose - move` and went to `pose`. The labels leave three things open, which `alignment` finds from
the images: the depth of the work frame's origin, the side of an edge on which the object is, and
the rotation of the camera.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.paths import Paths

EDGE_STIMULUS = "edge"  # the stimulus that stands for all recorded ones
FLAT_DISTANCE_MM = 25.0  # from the edge, where a half plane is flat for all the dome can reach


class LabelledMotions(NamedTuple):
    """N labelled contacts in a scene frame.

    z points out of the object, and x across its edge (if it has one) in the direction of the label.
    """

    tip: np.ndarray  # (N, 2, 3) mm, the undeformed apex at the start and the end of the slide
    turn: Rotation  # (2 N,) the sensor's, starts first
    across: bool  # whether a label varies across the object's top, which may then have an edge

    def __len__(self) -> int:
        return len(self.tip)

    def take(self, rows: np.ndarray) -> "LabelledMotions":
        turn = self.turn[np.concatenate([rows, rows + len(self)])]
        return LabelledMotions(self.tip[rows], turn, self.across)

    @property
    def slide(self) -> np.ndarray:
        """(N, 2) mm in the plane of the object's top."""
        return self.tip[:, 1, :2] - self.tip[:, 0, :2]

    @property
    def yaw(self) -> np.ndarray:
        """(N,) rad, the sensor's rotation about the normal at the end."""
        return _split_swing_twist(self.turn[len(self) :])[1]


class LabelFrame(NamedTuple):
    """How the object lies in the frame of the labels.

    A robot's set-up leaves this open; the pins show it.
    """

    surface_mm: float = 0.0  # of the depth axis, where its top is
    across_mm: float = 0.0  # from the edge to where labels have it, along the scene's x
    # of its top, about the scene's x and y axes through the origin of the labels
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0


def apply_frame(contacts: LabelledMotions, frame: LabelFrame) -> LabelledMotions:
    """Transform contacts to the object's own frame: top at depth 0 and level, edge at x = 0."""
    turn = Rotation.from_euler("xy", [frame.tilt_x_deg, frame.tilt_y_deg], degrees=True)
    tip = contacts.tip + np.array([0, 0, frame.surface_mm])
    tip = turn.apply(tip.reshape(-1, 3)).reshape(tip.shape) + np.array([frame.across_mm, 0, 0])
    return LabelledMotions(tip, turn * contacts.turn, contacts.across)


def find_depth_axis(poses: np.ndarray) -> int:
    """Find the depth axis of labels (N, 6): the first of z, y and x that varies, or else z."""
    varies = np.ptp(poses, axis=0) > 1e-6
    return next((axis for axis in (2, 1, 0) if varies[axis]), 2)


def read_motions(poses: np.ndarray, moves: np.ndarray | None) -> LabelledMotions:
    """Convert labels (N, 6), mm and degrees, to motions in a scene frame."""
    moves = np.zeros_like(poses) if moves is None else np.nan_to_num(moves)
    varies = np.ptp(poses, axis=0) > 1e-6
    depth = find_depth_axis(poses)
    in_plane = [axis for axis in (1, 0, 2) if axis != depth]
    lateral = next((axis for axis in in_plane if varies[axis]), in_plane[0])
    basis = np.zeros((3, 3))
    basis[2, depth] = -1
    basis[0, lateral] = 1
    basis[1] = np.cross(basis[2], basis[0])
    points = np.stack([poses - moves, poses], axis=1)
    angles = points[..., 3:].swapaxes(0, 1).reshape(-1, 3)
    labelled = Rotation.from_euler("xyz", angles, degrees=True)
    turn = Rotation.from_matrix(basis @ labelled.as_matrix() @ basis.T)
    return LabelledMotions(points[..., :3] @ basis.T, turn, bool(varies[lateral]))


def make_paths(
    motions: LabelledMotions,
    sensor: Sensor,
    surface_mm: float,
    side: int,
    friction: float | np.ndarray,
) -> Paths:
    """Make paths over a half plane.

    Args:
        surface_mm: Where the top lies on the depth axis.
        side: +1 or -1 for an edge whose object lies towards negative or positive labels; 0 for no
            edge.
        friction: Of all contacts, or (N,).
    """
    count = len(motions)
    tip = motions.tip.copy()
    tip[..., 2] += surface_mm
    tip[..., 1] -= tip[:, 1:, 1]  # a half plane is the same all along, but not without end
    turn = motions.turn
    if side < 0:  # half a turn about the normal
        half = Rotation.from_euler("z", 180, degrees=True)
        tip, turn = tip * [-1, -1, 1], half * turn
    if side == 0:
        tip[..., 0] -= tip[:, 1:, 0] + FLAT_DISTANCE_MM
    swing, yaw = _split_swing_twist(turn)
    axis = turn.apply([0, 0, sensor.dome_radius_mm])
    centre = tip.swapaxes(0, 1).reshape(-1, 3) + axis
    tilt = Rotation.from_euler("z", -yaw[:, None]).apply(swing)  # in the yawed frame
    depth = sensor.dome_radius_mm - centre[:, 2]
    point = np.column_stack([centre[:, :2], np.degrees(yaw), depth, np.degrees(tilt[:, :2])])
    start, end = point[:count], point[count:]
    hover = start.copy()
    hover[:, 3] = np.minimum(start[:, 3], 0)
    points = np.stack([hover, start, end], axis=1)
    points[:, 1:, 2] = np.degrees(np.unwrap(np.radians(points[:, 1:, 2]), axis=1))
    points[:, 0, 2] = points[:, 1, 2]
    return Paths(np.zeros(count, int), np.full(count, friction), points)


def _split_swing_twist(turn: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Split rotations into the least tilt of the z axis and a rotation about z before it.

    Returns rotation vectors (N, 3) and angles (N,) in rad.
    """
    axis = turn.as_matrix()[..., 2]
    normal = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=-1)
    sine = np.linalg.norm(normal, axis=-1)
    angle = np.arctan2(sine, axis[:, 2])
    swing = normal * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 0.0)[:, None]
    twist = (Rotation.from_rotvec(swing).inv() * turn).as_matrix()
    return swing, np.arctan2(twist[:, 1, 0], twist[:, 0, 0])
