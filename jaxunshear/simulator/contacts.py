"""What comes out of a contact, what a later motion continues from, and what cannot be simulated."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay

from jaxunshear.config.contact_rings import compute_max_contact_depth_mm
from jaxunshear.config.sensor import Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.paths import DEPTH, MIN_LEG_MM, TILT_X, Paths
from jaxunshear.simulator.pin_layout import (
    compute_outward_normals,
    compute_pin_lattice,
    flatten_places,
)
from jaxunshear.simulator.scene import Scenes
from jaxunshear.triangles import find_corners

SAME_POINT = 1e-6  # mm or degrees by which a path may begin beside its skin


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
    """Compute the inward normal displacement in mm of the outer face above each pin.

    It is positive where the face is pressed in. A pin beyond the contact nodes, where nothing ever
    touches, has that of the nearest node.
    """
    dome = load_shared_dome(sensor)
    flat = flatten_places(sensor, dome.nodes)
    outward = compute_outward_normals(sensor, flat)
    inward = -np.einsum("ni,nim->nm", outward, dome.w.reshape(*outward.shape, -1))
    corners, weights, _ = find_corners(Delaunay(flat), compute_pin_lattice(sensor))
    per_force = np.einsum("pk,pkm->pm", weights, inward[corners])  # mm/N
    return skins.force_n.reshape(len(skins.force_n), -1) @ per_force.T


def _refuse_scenes(bad: np.ndarray, describe: Callable[[int], str]) -> None:
    """Refuse the first of the scenes that are `bad`; further axes are points and columns."""
    rows = np.flatnonzero(bad.any(axis=tuple(range(1, bad.ndim))))
    if len(rows):
        raise UserError(f"scene {rows[0]}: {describe(rows[0])}")


def check_scenes(scenes: Scenes) -> None:
    """Check scenes before they become paths, so that a message names the scene's own field."""
    _refuse_scenes(
        ~np.isfinite(scenes.pose), lambda i: f"pose = {scenes.pose[i].tolist()} is not finite"
    )
    _refuse_scenes(
        ~np.isfinite(scenes.move), lambda i: f"move = {scenes.move[i].tolist()} is not finite"
    )


def check_paths(sensor: Sensor, stimuli: int, paths: Paths) -> None:
    """Check a sensor and its paths over so many stimuli."""
    check_sensor(sensor)
    points, friction, stimulus = paths.points, paths.friction, paths.stimulus
    if points.ndim != 3 or points.shape[1] < 2 or points.shape[2] != 6:
        raise UserError(f"points have shape {points.shape}: give (B, K, 6) with K at least 2")
    _refuse_scenes(~np.isfinite(points), lambda i: f"points = {points[i].tolist()} are not finite")
    _refuse_scenes(
        ~(friction >= 0),
        lambda i: f"friction {friction[i]:g} is not a number from 0 (none) to infinity (stick)",
    )
    _refuse_scenes(
        (stimulus < 0) | (stimulus >= stimuli),
        lambda i: f"stimulus {stimulus[i]} is not one of the {stimuli} named",
    )
    _check_depths(sensor, points)


def _check_depths(sensor: Sensor, points: np.ndarray) -> None:
    tilt = np.linalg.norm(points[..., TILT_X:], axis=-1)
    find_deepest = np.vectorize(lambda deg: compute_max_contact_depth_mm(sensor, deg), [float])
    deepest, depth = find_deepest(tilt), points[..., DEPTH]

    def describe(i: int) -> str:
        k = np.argmax(depth[i] - deepest[i])
        tilted = f" at a tilt of {tilt[i, k]:.3g} deg" if tilt[i, k] else ""
        return (
            f"depth {depth[i, k]:.3g} mm cannot be reached{tilted}; "
            f"the contact model covers {max(deepest[i, k], 0):.1f} mm there"
        )

    _refuse_scenes(depth > deepest, describe)


def check_start_at_rest(sensor: Sensor, paths: Paths) -> None:
    """Refuse paths without a skin to start from that stay in contact: their slide is unknown."""
    still = np.all(np.abs(np.diff(paths.points, axis=1)) < MIN_LEG_MM, axis=(1, 2))
    depth = paths.points[:, 0, DEPTH]
    tilt = np.radians(np.linalg.norm(paths.points[:, 0, TILT_X:], axis=-1))
    lowered = sensor.radius_mm * np.sin(tilt) if sensor.is_flat else 0.0  # of a pad's rim
    _refuse_scenes(
        still & (depth > -lowered),
        lambda i: (
            f"its path stays where it begins, at depth {depth[i]:.3g} mm: "
            "begin at depth 0, or give the skin to start from"
        ),
    )


def check_start(paths: Paths, start: Skins, nodes: int) -> None:
    """Check that paths start from these skins, of a dome with so many contact nodes."""
    if start.force_n.shape != (len(paths), nodes, 3) or not np.isfinite(start.force_n).all():
        raise UserError(
            f"the skins to start from: give {len(paths)} of them, with finite forces on {nodes} "
            f"nodes; these are {start.force_n.shape[0]} with {start.force_n.shape[1]}"
        )
    _refuse_scenes(
        np.abs(paths.points[:, 0] - start.point) > SAME_POINT,
        lambda i: f"its path starts elsewhere than its skin: begin at {start.point[i].tolist()}",
    )
