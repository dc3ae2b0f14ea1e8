"""Checks that refuse what cannot be simulated, by field, before any work starts."""

import numpy as np

from jaxunshear.config.reach import compute_max_contact_depth_mm
from jaxunshear.config.sensor import Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.contact_results import Skins
from jaxunshear.simulator.paths import DEPTH, TILT_X, Paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.scheduler import MIN_LEG_MM

SAME_POINT = 1e-6  # mm or degrees by which a path may begin beside its skin


def check_batch(batch: int) -> None:
    if batch < 1:
        raise UserError(f"batch = {batch}: solve at least 1 scene at a time")


def check_scenes(scenes: Scenes) -> None:
    """Check scenes before they become paths, so that a message names the scene's own field."""
    for field, values in (("pose", scenes.pose), ("move", scenes.move)):
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=-1))
        if len(bad):
            raise UserError(f"scene {bad[0]}: {field} = {values[bad[0]].tolist()} is not finite")


def check_paths(sensor: Sensor, stimuli: int, paths: Paths) -> None:
    """Check a sensor and its paths over so many stimuli."""
    check_sensor(sensor)
    if paths.points.ndim != 3 or paths.points.shape[1] < 2 or paths.points.shape[2] != 6:
        raise UserError(f"points have shape {paths.points.shape}: give (B, K, 6) with K at least 2")
    bad = np.flatnonzero(~np.isfinite(paths.points).all(axis=(1, 2)))
    if len(bad):
        raise UserError(f"scene {bad[0]}: points = {paths.points[bad[0]].tolist()} are not finite")
    bad = np.flatnonzero(~(paths.friction >= 0))
    if len(bad):
        value = paths.friction[bad[0]]
        raise UserError(
            f"scene {bad[0]}: friction {value:g} is not a number from 0 (none) to infinity (stick)"
        )
    bad = np.flatnonzero((paths.stimulus < 0) | (paths.stimulus >= stimuli))
    if len(bad):
        raise UserError(
            f"scene {bad[0]}: stimulus {paths.stimulus[bad[0]]} is not one of the {stimuli} named"
        )
    _check_depths(sensor, paths)


def _check_depths(sensor: Sensor, paths: Paths) -> None:
    tilt = np.linalg.norm(paths.points[..., TILT_X:], axis=-1)
    deepest = np.vectorize(
        lambda degrees: compute_max_contact_depth_mm(sensor, degrees), otypes=[float]
    )(tilt)
    deep = np.argwhere(paths.points[..., DEPTH] > deepest)
    if len(deep):
        row, point = deep[0]
        depth, most = paths.points[row, point, DEPTH], max(deepest[row, point], 0)
        tilted = f" at a tilt of {tilt[row, point]:.3g} deg" if tilt[row, point] else ""
        raise UserError(
            f"scene {row}: depth {depth:.3g} mm cannot be reached{tilted}; "
            f"the contact model covers {most:.1f} mm there"
        )


def check_start_at_rest(paths: Paths) -> None:
    """Refuse paths without a skin to start from that stay in contact: their slide is unknown."""
    still = np.all(np.abs(np.diff(paths.points, axis=1)) < MIN_LEG_MM, axis=(1, 2))
    bad = np.flatnonzero(still & (paths.points[:, 0, DEPTH] > 0))
    if len(bad):
        depth = paths.points[bad[0], 0, DEPTH]
        raise UserError(
            f"scene {bad[0]}: its path stays where it begins, at depth {depth:.3g} mm: "
            "begin at depth 0, or give the skin to start from"
        )


def check_start(paths: Paths, start: Skins, nodes: int) -> None:
    """Check that paths start from these skins, of a dome with so many contact nodes."""
    if start.force_n.shape != (len(paths), nodes, 3) or not np.isfinite(start.force_n).all():
        raise UserError(
            f"the skins to start from: give {len(paths)} of them, with finite forces on {nodes} "
            f"nodes; these are {start.force_n.shape[0]} with {start.force_n.shape[1]}"
        )
    distance = np.abs(paths.points[:, 0] - start.point).max(axis=-1)
    bad = np.flatnonzero(distance > SAME_POINT)
    if len(bad):
        raise UserError(
            f"scene {bad[0]}: its path starts elsewhere than its skin: "
            f"begin at {start.point[bad[0]].tolist()}"
        )
