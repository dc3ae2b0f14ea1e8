"""Scenes in, pin positions out: grouped by what they need, solved in batches, each contact with its quality.

    contacts = simulate(TACTIP_331, ("disk",), scenes)
    contacts.pins  # (B, 331, 3) mm in the sensor frame

A scene pays only for the contact rings that its depth can reach, and a tap for no slide.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.contact.dome import RING_MM, RINGS, deepest_mm, dome, reach_mm
from jaxunshear.contact.friction import RHO, System, contact_state, follow_path, rest
from jaxunshear.contact.obstacle import Obstacles, sample
from jaxunshear.errors import UserError
from jaxunshear.scene.scene import Scenes
from jaxunshear.scene.sensor import Sensor

BATCH = 64


@dataclass(frozen=True)
class Level:
    """Increments of a press and of a slide, and when an increment is solved (a share of its length)."""

    press: int
    slide: int
    tolerance: float
    limit: int  # iterations of an increment


LEVELS = {
    "default": Level(press=2, slide=8, tolerance=0.2, limit=300),
    "reference": Level(press=4, slide=16, tolerance=0.02, limit=4000),
}
RING_COUNTS = (8, 10, 12, 14, 16, RINGS)  # a batch uses the first that covers its deepest scene


class Contacts(NamedTuple):
    """B contacts (numpy)."""

    pins: np.ndarray  # (B, P, 3) mm, displaced pin tips in the sensor frame
    residual_mm: np.ndarray  # (B,) of the worst increment
    converged: np.ndarray  # (B,) bool: every increment below its tolerance, every pin finite
    iterations: np.ndarray  # (B,)
    stuck: np.ndarray  # (B,) contact nodes at the end
    slipping: np.ndarray
    free: np.ndarray
    force_n: np.ndarray  # (B, 3) on the sensor, in the sensor frame


def rings_needed(sensor: Sensor, depth_mm: np.ndarray) -> np.ndarray:
    """Index into RING_COUNTS for each depth (B,)."""
    reach = np.array([reach_mm(sensor, depth) for depth in np.ravel(depth_mm)])
    return np.searchsorted([(count - 1) * RING_MM for count in RING_COUNTS], reach)


def plan(sensor: Sensor, scenes: Scenes) -> list[np.ndarray]:
    """Batches of scene indices of equal need: same rings, taps apart from slides, at most BATCH each."""
    check(sensor, scenes)
    slides = np.any(scenes.move != 0, axis=-1)
    need = 2 * rings_needed(sensor, scenes.pose[:, 3]) + slides
    batches = []
    for kind in np.unique(need):
        index = np.flatnonzero(need == kind)
        batches += [index[start : start + BATCH] for start in range(0, len(index), BATCH)]
    return batches


def check(sensor: Sensor, scenes: Scenes) -> None:
    """Refuse by name what cannot be simulated."""
    for field, values in zip(("pose", "move", "friction"), (scenes.pose, scenes.move, scenes.friction), strict=True):
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=-1))
        if len(bad):
            raise UserError(f"scene {bad[0]}: {field} = {values[bad[0]].tolist()} is not finite")
    if np.any(scenes.friction < 0):
        raise UserError(f"scene {np.flatnonzero(scenes.friction < 0)[0]}: friction is negative")
    deepest = deepest_mm(sensor)
    deep = np.flatnonzero(scenes.pose[:, 3] > deepest)
    if len(deep):
        depth = scenes.pose[deep[0], 3]
        raise UserError(
            f"scene {deep[0]}: depth {depth:.3g} mm cannot be reached; the contact model covers {deepest:.1f} mm"
        )


@lru_cache(maxsize=8)
def _system(sensor: Sensor, rings: int) -> tuple[System, jax.Array, float]:
    """The first rings of the dome, scaled; the pin map (3P, 3N) for scaled forces; newtons per scaled force."""
    whole = dome(sensor)
    count = 3 * (1 + 3 * rings * (rings - 1))
    w = whole.w[:count, :count]
    scale = np.trace(w) / count
    inverse = np.linalg.inv(w / scale + RHO * np.eye(count))
    as_float = partial(jnp.asarray, dtype=jnp.float32)
    system = System(as_float(w / scale), as_float((inverse + inverse.T) / 2), as_float(whole.nodes[: count // 3]))
    return system, as_float(whole.g[:, :count] / scale), 1 / scale


def paths(scenes: Scenes, level: Level, slides: bool) -> np.ndarray:
    """(T + 1, B, 4) way points, from touch to pose: down at pose - move, then along move; yaw in rad."""
    end = scenes.pose.copy()
    end[:, 2] = np.radians(end[:, 2])
    pressed = end.copy()
    pressed[:, :2] -= scenes.move
    down = np.linspace(0, 1, level.press + 1)[:, None]
    points = np.repeat(pressed[None], level.press + 1, axis=0)
    points[..., 3] *= down
    if slides:
        along = np.linspace(0, 1, level.slide + 1)[1:, None, None]
        points = np.concatenate([points, pressed + along * (end - pressed)])
    return points.astype(np.float32)


@partial(jax.jit, static_argnames=("tolerance", "limit"))
def _follow(system, to_pins, obstacles, which, friction, path, tolerance, limit):
    skin, quality = follow_path(system, obstacles, which, friction, path[1:], rest(system, path[0]), tolerance, limit)
    displaced = skin.force.reshape(len(which), -1) @ to_pins.T
    return displaced.reshape(len(which), -1, 3), quality, contact_state(skin, friction), jnp.sum(skin.force, axis=1)


def simulate(sensor: Sensor, names: tuple[str, ...], scenes: Scenes, level: str = "default", progress=None) -> Contacts:
    """Contacts of B scenes, in the order given; `scenes.stimulus` indexes `names`."""
    if level not in LEVELS:
        raise UserError(f"level '{level}' is unknown: use one of {', '.join(LEVELS)}")
    obstacles = _obstacles(names)
    parts, order = [], []
    for index in plan(sensor, scenes):
        parts.append(_solve_batch(sensor, obstacles, scenes.take(index), LEVELS[level]))
        order.append(index)
        if progress is not None:
            progress.advance(len(index))
    back = np.argsort(np.concatenate(order), kind="stable")
    return Contacts(*(np.concatenate(field)[back] for field in zip(*parts, strict=True)))


@lru_cache(maxsize=8)
def _obstacles(names: tuple[str, ...]) -> Obstacles:
    return sample(names)


def _solve_batch(sensor: Sensor, obstacles: Obstacles, scenes: Scenes, level: Level) -> Contacts:
    """One batch of equal need, padded to BATCH by repeating its last scene so that it compiles once."""
    count = len(scenes)
    padded = scenes.take(np.minimum(np.arange(BATCH), count - 1))
    rings = RING_COUNTS[int(rings_needed(sensor, padded.pose[:, 3]).max())]
    system, to_pins, newtons = _system(sensor, rings)
    path = paths(padded, level, bool(np.any(padded.move != 0)))
    moved, quality, states, force = _follow(
        system,
        to_pins,
        obstacles,
        jnp.asarray(padded.stimulus, jnp.int32),
        jnp.asarray(padded.friction, jnp.float32),
        jnp.asarray(path),
        level.tolerance,
        level.limit,
    )
    pins = np.asarray(dome(sensor).pins + np.asarray(moved), np.float32)
    residual, goal = np.asarray(quality.residual_mm), np.asarray(quality.tolerance_mm)
    converged = (residual <= goal) & np.isfinite(pins).all(axis=(1, 2))
    fields = (
        pins,
        residual,
        converged,
        np.asarray(quality.iterations),
        *map(np.asarray, states),
        np.asarray(force) * newtons,
    )
    return Contacts(*(field[:count] for field in fields))
