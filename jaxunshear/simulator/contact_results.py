"""What comes out of a contact, and what a later motion continues from."""

from typing import NamedTuple

import numpy as np


class Contacts(NamedTuple):
    """B contacts (numpy).

    A contact has converged if every increment is below its tolerance, every pin is finite, and no
    node was left out that turned out to be needed.
    """

    pins: np.ndarray  # (B, P, 3) mm, displaced pin tips in the sensor frame
    residual_mm: np.ndarray  # (B,) of the worst increment
    converged: np.ndarray  # (B,) bool
    iterations: np.ndarray  # (B,)
    stuck_nodes: np.ndarray  # (B,) contact nodes at the end
    slipping_nodes: np.ndarray
    free_nodes: np.ndarray
    force_n: np.ndarray  # (B, 3) on the sensor, in the sensor frame
    nodes: np.ndarray  # (B,) contact nodes that were solved for
    retried: np.ndarray  # (B,) bool: solved at a stronger level than the one requested


class Skins(NamedTuple):
    """State of B skins, from which a later motion continues (numpy, sensor frame)."""

    force_n: np.ndarray  # (B, N, 3) on the contact nodes of the sensor's dome
    point: np.ndarray  # (B, 6) where they are, as the points of `Paths`

    def take(self, index: np.ndarray) -> "Skins":
        return Skins(self.force_n[index], self.point[index])
