"""How far the skin is pressed in above each pin: the ground truth of contact geometry."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay, cKDTree

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.contact_results import Skins
from jaxunshear.simulator.pin_layout import compute_pin_lattice
from jaxunshear.simulator.systems import load_shared_dome


def compute_indentation(sensor: Sensor, skins: Skins) -> Float[np.ndarray, "B P"]:
    """Compute the inward normal displacement in mm of the dome's outer face above each pin.

    It is positive where the face is pressed in. A pin beyond the contact nodes, where nothing ever
    touches, has that of the nearest node.
    """
    return skins.force_n.reshape(len(skins.force_n), -1) @ compute_indentation_per_force(sensor).T


def compute_indentation_per_force(sensor: Sensor) -> Float[np.ndarray, "P N3"]:
    """Compute the indentation above each pin in mm/N of force on each contact node."""
    full = load_shared_dome(sensor)
    outward = full.nodes - np.array([0, 0, sensor.dome_radius_mm])
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    inward = -np.einsum("ni,nim->nm", outward, full.w.reshape(*outward.shape, -1))
    corners, weights = _locate_pins(sensor, outward)
    return np.einsum("pk,pkm->pm", weights, inward[corners])


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
