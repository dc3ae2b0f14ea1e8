"""How far the skin has been pressed in above each pin: the truth that a reconstructed contact geometry is compared with."""

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from jaxunshear.contact.batches import dome
from jaxunshear.contact.skins import Skins
from jaxunshear.scene.sensor import Sensor, pin_lattice


def indentation(sensor: Sensor, skins: Skins) -> np.ndarray:
    """(B, P) mm: inward normal displacement of the dome's outer face above each pin, positive where it is pressed in.

    Of a pin beyond the contact nodes, where nothing ever touches, that of the nearest node.
    """
    whole = dome(sensor)
    outward = whole.nodes - np.array([0, 0, sensor.dome_radius_mm])
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    loaded = np.flatnonzero(np.any(skins.force_n != 0, axis=(0, 2)))
    columns = (3 * loaded[:, None] + np.arange(3)).ravel()
    moved = skins.force_n[:, loaded].reshape(len(skins.force_n), -1) @ whole.w[columns]
    inward = -np.sum(moved.reshape(len(moved), -1, 3) * outward, axis=-1)
    corners, shares = _above_pins(sensor, outward)
    return np.sum(inward[:, corners] * shares, axis=-1)


def _above_pins(sensor: Sensor, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Contact nodes (P, 3) around each pin, and their shares (P, 3), on the dome rolled out flat."""
    across = np.linalg.norm(outward[:, :2], axis=-1)
    arc = sensor.dome_radius_mm * np.arctan2(across, -outward[:, 2])
    flat = outward[:, :2] * (arc / np.maximum(across, 1e-12))[:, None]
    mesh, pins = Delaunay(flat), pin_lattice(sensor)
    triangle = mesh.find_simplex(pins)
    beyond = triangle < 0
    transform = mesh.transform[triangle]
    first = np.einsum("pij,pj->pi", transform[:, :2], pins - transform[:, 2])
    corners, shares = mesh.simplices[triangle], np.column_stack([first, 1 - first.sum(axis=-1)])
    corners[beyond] = cKDTree(flat).query(pins[beyond])[1][:, None]
    shares[beyond] = [1, 0, 0]
    return corners, shares
