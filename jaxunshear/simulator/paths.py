"""Motions in full: way points of the sensor over a stimulus, with slide, twist and tilt.

Many motions are arrays with a leading axis:

    press, slide, twist: points = [[-2, 0, 0, 0, 0, 0], [-2, 0, 0, 3, 0, 0], [0, 0, 20, 3, 0, 0]]

`Scenes` are the paper's two kinds of motion; `make_paths` converts them.
"""

from dataclasses import dataclass

import numpy as np

from jaxunshear.simulator.scene import Scenes

X, Y, YAW, DEPTH, TILT_X, TILT_Y = range(6)
TURNS = (YAW, TILT_X, TILT_Y)


@dataclass(frozen=True)
class Paths:
    """B motions over K way points (numpy), in the target frame; straight lines in between.

    A point is x, y (mm), yaw (deg), depth (mm), tilt_x, tilt_y (deg). `depth` is how far the lowest
    point of the undeformed dome, above (x, y), would lie below the stimulus' top. The tilt is a
    rotation vector in the yawed frame, about the dome's centre, so that it moves neither the lowest
    point nor its depth. At the first point the skin is at rest.
    """

    stimulus: np.ndarray  # (B,) index into a tuple of stimuli
    friction: np.ndarray  # (B,) Coulomb coefficient, 0 to infinity
    points: np.ndarray  # (B, K, 6)

    def __len__(self) -> int:
        return len(self.stimulus)

    @property
    def radians(self) -> np.ndarray:
        """(B, K, 6) points, with angles in rad."""
        points = np.array(self.points, float)
        points[..., TURNS] = np.radians(points[..., TURNS])
        return points

    def take(self, index: np.ndarray) -> "Paths":
        return Paths(self.stimulus[index], self.friction[index], self.points[index])


def make_paths(scenes: Scenes) -> Paths:
    """Make the paths of scenes: down at `pose - move`, then along `move` (nowhere for a tap).

    The slide keeps its depth and tilt and turns at an even pace.
    """
    points = np.zeros((len(scenes), 3, 6))
    points[..., : scenes.pose.shape[1]] = scenes.pose[:, None]
    points[:, :2, : scenes.move.shape[1]] -= scenes.move[:, None]
    points[:, 0, DEPTH] = 0
    return Paths(scenes.stimulus, scenes.friction, points)
