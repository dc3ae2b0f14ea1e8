"""Forces on the nodes of a dome, and of a batch whose scenes are turned by sixths."""

from typing import NamedTuple

import numpy as np

from jaxunshear.simulator.harmonics import make_sixfold_permutations


class LatticePlacement(NamedTuple):
    """How the scenes of a batch lie on the lattice: each is turned by sixths of a turn."""

    rotation: np.ndarray  # (b, 3, 3) from the turned lattice to the sensor frame
    nodes: np.ndarray  # (b, n) the sensor's node that each node of the batch is

    def gather(self, force_n: np.ndarray) -> np.ndarray:
        """Turn forces (b, N, 3) on the sensor's nodes to forces (b, n, 3) on the batch's."""
        on_batch = np.take_along_axis(force_n, self.nodes[..., None], 1)
        return np.einsum("bji,bnj->bni", self.rotation, on_batch)

    def scatter(self, force_n: np.ndarray, nodes: int) -> np.ndarray:
        """Turn forces (b, n, 3) on the batch's nodes to forces (b, N, 3) on the sensor's."""
        on_sensor = np.zeros((len(force_n), nodes, 3))
        turned = np.einsum("bij,bnj->bni", self.rotation, force_n)
        np.put_along_axis(on_sensor, self.nodes[..., None], turned, 1)
        return on_sensor


def place_on_lattice(turn: np.ndarray, batch_nodes: np.ndarray, nodes: int) -> LatticePlacement:
    """Place scenes, turned by `turn` (b,) sixths, that are solved on some of the nodes."""
    angle = np.radians(60.0 * turn)
    rotation = np.zeros((len(angle), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(angle)
    rotation[:, 1, 0] = np.sin(angle)
    rotation[:, 0, 1] = -rotation[:, 1, 0]
    rotation[:, 2, 2] = 1
    return LatticePlacement(rotation, make_sixfold_permutations(nodes)[turn][:, batch_nodes])
