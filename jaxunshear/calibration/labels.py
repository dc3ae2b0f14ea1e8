"""A recording's labels as motions that can be simulated: `pose` and `move` of the robot become paths of the scene.

Robots report six numbers in a work frame whose depth axis points into the object, as static Euler angles x, y, z about the
sensor's tip; the sensor hovered, pressed at `pose - move` and went to `pose`. Three things no label gives, and the images do
(`fit`): how deep the work frame's origin lies, on which side of an edge the object is, and how the camera is turned.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.paths import Paths

EDGE_STIMULUS = "edge"  # the stimulus that stands for all recorded ones
FLAT_DISTANCE_MM = 25.0  # from the edge, where a half plane is flat for all the dome can reach


class LabelledMotions(NamedTuple):
    """N labelled contacts in a scene frame: z out of the object, x across its edge (if it has one), as the label's sign has it."""

    tip: np.ndarray  # (N, 2, 3) mm, the undeformed apex at the start and the end of the slide
    turn: Rotation  # (2 N,) the sensor's, starts first
    across: (
        bool  # whether some label runs across the object's top, which may then have an edge there
    )

    def __len__(self) -> int:
        return len(self.tip)

    def take(self, rows: np.ndarray) -> "LabelledMotions":
        return LabelledMotions(
            self.tip[rows], self.turn[np.concatenate([rows, rows + len(self)])], self.across
        )

    @property
    def slide(self) -> np.ndarray:
        """(N, 2) mm in the plane of the object's top."""
        return self.tip[:, 1, :2] - self.tip[:, 0, :2]

    @property
    def tilt_deg(self) -> np.ndarray:
        """(N,) between the sensor's axis and the normal, at the end."""
        return np.degrees(np.arccos(np.clip(self.turn[len(self) :].as_matrix()[:, 2, 2], -1, 1)))

    @property
    def yaw(self) -> np.ndarray:
        """(N,) rad, the sensor's turn about the normal at the end."""
        return _swing_twist(self.turn[len(self) :])[1]


class LabelFrame(NamedTuple):
    """How the object lies in the frame of the labels: what a robot's set-up leaves open, and pins show."""

    surface_mm: float = 0.0  # of the depth axis, where its top is
    across_mm: float = 0.0  # from the edge to where labels have it, along the scene's x
    tilt_x_deg: float = (
        0.0  # of its top, about the scene's x and y axes through the origin of the labels
    )
    tilt_y_deg: float = 0.0


def apply_frame(contacts: LabelledMotions, frame: LabelFrame) -> LabelledMotions:
    """The same contacts as the object has them: its top at depth 0 and level, its edge at x = 0."""
    turn = Rotation.from_euler("xy", [frame.tilt_x_deg, frame.tilt_y_deg], degrees=True)
    tip = contacts.tip + np.array([0, 0, frame.surface_mm])
    tip = turn.apply(tip.reshape(-1, 3)).reshape(tip.shape) + np.array([frame.across_mm, 0, 0])
    return LabelledMotions(tip, turn * contacts.turn, contacts.across)


def find_depth_axis(poses: np.ndarray) -> int:
    """Of labels (N, 6): z, or, where z does not vary, the first other one that does."""
    vary = np.ptp(poses, axis=0) > 1e-6
    return next((axis for axis in (2, 1, 0) if vary[axis]), 2)


def read_motions(poses: np.ndarray, moves: np.ndarray | None) -> LabelledMotions:
    """From labels (N, 6) mm and degrees."""
    moves = np.zeros_like(poses) if moves is None else np.nan_to_num(moves)
    vary = np.ptp(poses, axis=0) > 1e-6
    depth = find_depth_axis(poses)
    rest = [axis for axis in (1, 0, 2) if axis != depth]
    lateral = next((axis for axis in rest if vary[axis]), rest[0])
    basis = np.zeros((3, 3))
    basis[2, depth] = -1
    basis[0, lateral] = 1
    basis[1] = np.cross(basis[2], basis[0])
    points = np.stack([poses - moves, poses], axis=1)
    turn = Rotation.from_matrix(
        basis
        @ Rotation.from_euler(
            "xyz", points[..., 3:].swapaxes(0, 1).reshape(-1, 3), degrees=True
        ).as_matrix()
        @ basis.T
    )
    return LabelledMotions(points[..., :3] @ basis.T, turn, bool(vary[lateral]))


def make_paths(
    motions: LabelledMotions,
    sensor: Sensor,
    surface_mm: float,
    side: int,
    friction: float | np.ndarray,
) -> Paths:
    """Paths over HALF_PLANE. The top lies at `surface_mm` of the depth axis; `side` is +1 or -1 for an edge whose object lies
    towards negative or positive labels, 0 for no edge; `friction` of all, or (N,)."""
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
    swing, yaw = _swing_twist(turn)
    axis = turn.apply([0, 0, sensor.dome_radius_mm])
    centre = tip.swapaxes(0, 1).reshape(-1, 3) + axis
    tilt = Rotation.from_euler("z", -yaw[:, None]).apply(swing)  # in the yawed frame
    point = np.column_stack(
        [
            centre[:, :2],
            np.degrees(yaw),
            sensor.dome_radius_mm - centre[:, 2],
            np.degrees(tilt[:, :2]),
        ]
    )
    start, end = point[:count], point[count:]
    hover = start.copy()
    hover[:, 3] = np.minimum(start[:, 3], 0)
    points = np.stack([hover, start, end], axis=1)
    points[:, 1:, 2] = np.degrees(np.unwrap(np.radians(points[:, 1:, 2]), axis=1))
    points[:, 0, 2] = points[:, 1, 2]
    return Paths(np.zeros(count, int), np.full(count, friction), points)


def _swing_twist(turn: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors (N, 3) of the least tilt of the z axis, and angles (N,) rad about z done before it."""
    axis = turn.as_matrix()[..., 2]
    normal = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=-1)
    sine = np.linalg.norm(normal, axis=-1)
    angle = np.arctan2(sine, axis[:, 2])
    swing = normal * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 0.0)[:, None]
    twist = (Rotation.from_rotvec(swing).inv() * turn).as_matrix()
    return swing, np.arctan2(twist[:, 1, 0], twist[:, 0, 0])
