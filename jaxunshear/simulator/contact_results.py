"""What comes out of a contact, and what a later motion continues from."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay, cKDTree

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.pin_layout import compute_pin_lattice


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


def compute_indentation(sensor: Sensor, skins: Skins) -> Float[np.ndarray, "B P"]:
    """Compute the inward normal displacement in mm of the dome's outer face above each pin.

    It is positive where the face is pressed in. A pin beyond the contact nodes, where nothing ever
    touches, has that of the nearest node.
    """
    dome = load_shared_dome(sensor)
    outward = dome.nodes - np.array([0, 0, sensor.dome_radius_mm])
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    inward = -np.einsum("ni,nim->nm", outward, dome.w.reshape(*outward.shape, -1))
    corners, weights = _locate_pins(sensor, outward)
    per_force = np.einsum("pk,pkm->pm", weights, inward[corners])  # mm/N
    return skins.force_n.reshape(len(skins.force_n), -1) @ per_force.T


def _locate_pins(sensor: Sensor, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the contact nodes (P, 3) around each pin and their weights, on the flattened dome."""
    across = np.linalg.norm(outward[:, :2], axis=-1)
    arc = sensor.dome_radius_mm * np.arctan2(across, -outward[:, 2])
    flat = outward[:, :2] * (arc / np.maximum(across, 1e-12))[:, None]
    mesh, pins = Delaunay(flat), compute_pin_lattice(sensor)
    triangle = mesh.find_simplex(pins)
    beyond = triangle < 0
    transform = mesh.transform[triangle]
    first = np.einsum("pij,pj->pi", transform[:, :2], pins - transform[:, 2])
    corners, weights = mesh.simplices[triangle], np.column_stack([first, 1 - first.sum(axis=-1)])
    corners[beyond] = cKDTree(flat).query(pins[beyond])[1][:, None]
    weights[beyond] = [1, 0, 0]
    return corners, weights
