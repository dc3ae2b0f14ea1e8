"""Checks that refuse what cannot be simulated, by field, before any work starts."""

from collections.abc import Callable

import numpy as np

from jaxunshear.config.sensor import Sensor, check_sensor, compute_max_contact_depth_mm
from jaxunshear.errors import UserError
from jaxunshear.simulator.contact_results import Skins
from jaxunshear.simulator.paths import DEPTH, MIN_LEG_MM, TILT_X, Paths
from jaxunshear.simulator.scene import Scenes

SAME_POINT = 1e-6  # mm or degrees by which a path may begin beside its skin


def _refuse_scenes(bad: np.ndarray, describe: Callable[[int], str]) -> None:
    """Refuse the first of the scenes that are `bad`; further axes are points and columns."""
    rows = np.flatnonzero(bad.any(axis=tuple(range(1, bad.ndim))))
    if len(rows):
        raise UserError(f"scene {rows[0]}: {describe(rows[0])}")


def check_batch(batch: int) -> None:
    if batch < 1:
        raise UserError(f"batch = {batch}: solve at least 1 scene at a time")


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


def check_start_at_rest(paths: Paths) -> None:
    """Refuse paths without a skin to start from that stay in contact: their slide is unknown."""
    still = np.all(np.abs(np.diff(paths.points, axis=1)) < MIN_LEG_MM, axis=(1, 2))
    depth = paths.points[:, 0, DEPTH]
    _refuse_scenes(
        still & (depth > 0),
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
