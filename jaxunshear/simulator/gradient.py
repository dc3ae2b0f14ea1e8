"""Derivatives of the pins by way points, friction and the ratio of the moduli.

    gradient = compute_pin_gradient(TACTIP_331, ("disk",), paths)
    gradient.d_points  # (B, P, 3, K, 6) mm of pin motion per mm or degree of each way point
    gradient.at_switch  # (B,) there a derivative is one-sided

To put pins into a loss of your own:

    with jax.enable_x64(True):
        model = make_pin_model(TACTIP_331, ("disk",), paths)

        def compute_loss(friction):
            pins = simulate_pins(model, paths.points, friction).pins
            return jnp.sum((pins - measured_pins) ** 2)

        jax.jit(jax.value_and_grad(compute_loss))(paths.friction)

All derivatives are those of the converged contact (see `implicit`), along a path whose increments
are cut as for the model's paths. They do not see the kinks of a sampled obstacle's distance, whose
slope changes by about 1 % at its grid lines.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator import dome as domes
from jaxunshear.simulator.contact_problem import ContactProblem, System, make_undeformed_skins
from jaxunshear.simulator.implicit import GOAL_MM, compute_pin_state
from jaxunshear.simulator.increment import RHO
from jaxunshear.simulator.input_checks import check_batch, check_paths
from jaxunshear.simulator.level import Level, get_level
from jaxunshear.simulator.obstacle import Obstacles
from jaxunshear.simulator.paths import TURNS, Paths, cut_increments
from jaxunshear.simulator.scheduler import (
    Simulation,
    Stimuli,
    find_reachable_nodes,
)

SWITCH_MM = 1e-6  # nearer to a switch than this, rounding decides on which side a node is found
TOUCHING_SHARE = 0.75  # of the nodes within reach: about as many as ever touch at once


class ScaledCompliance(NamedTuple):
    """A compliance divided by the mean diagonal of w, on which the pins do not depend."""

    w: Array  # (3N, 3N)
    g: Array  # (3P, 3N)


class Compliances(NamedTuple):
    """Compliances of N nodes and P pins at M ratios of the moduli, mm/N for the sensor's gel."""

    log_ratios: Array  # (M,) log(skin modulus : gel modulus), rising
    w: Array  # (M, 3N, 3N), and its slope by the logarithm
    w_slope: Array
    g: Array  # (M, 3P, 3N)
    g_slope: Array

    def interpolate(self, log_ratio: Float[Array, ""]) -> ScaledCompliance:
        """Interpolate by cubic Hermite polynomials; linearly from a single ratio."""
        knots = self.log_ratios
        if len(knots) == 1:
            step = log_ratio - knots[0]
            w, g = self.w[0] + step * self.w_slope[0], self.g[0] + step * self.g_slope[0]
        else:
            left = jnp.clip(jnp.searchsorted(knots, log_ratio) - 1, 0, len(knots) - 2)
            width = knots[left + 1] - knots[left]
            s = (log_ratio - knots[left]) / width
            weights = (
                (1 + 2 * s) * (1 - s) ** 2,
                s**2 * (3 - 2 * s),
                width * s * (1 - s) ** 2,
                width * s**2 * (s - 1),
            )

            def interpolate(values: Array, slopes: Array) -> Array:
                ends = jnp.stack([values[left], values[left + 1], slopes[left], slopes[left + 1]])
                return jnp.tensordot(jnp.stack(weights), ends, 1)

            w, g = interpolate(self.w, self.w_slope), interpolate(self.g, self.g_slope)
        scale = jax.lax.stop_gradient(jnp.trace(w) / len(w))
        return ScaledCompliance(w / scale, g / scale)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PinModel:
    """A sensor on the paths it was made for, as arrays: goes through jit and grad."""

    log_ratio: Array  # () the sensor's own log(skin modulus : gel modulus)
    compliances: Compliances
    nodes: Array  # (N, 3)
    centre_mm: Array
    tips: Array  # (P, 3) pin tips at rest
    obstacles: Obstacles
    obstacle_index: Array  # (B,)
    shares: Array  # (B, T + 1, K) of the way points in each pose of the path
    # nodes of a scene that touch at once, probably
    max_touching: int = field(metadata={"static": True})


class PinPositions(NamedTuple):
    pins: Array  # (B, P, 3) mm in the sensor frame
    margin_mm: Array  # (B,) to the nearest switch
    residual_mm: Array  # (B,) of the worst increment


class PinGradient(NamedTuple):
    """Derivatives of B scenes' pins (numpy, mm in the sensor frame).

    They are exact for changes that move no node past a switch: between touching and parting, or
    stick and slip. `margin_mm` is how far the nearest one was in any increment: in mm of a node's
    gap or slip, or of the displacement that the missing force would give to its node. A finite
    difference agrees as long as its step moves the skin by less. `at_switch` means below SWITCH_MM:
    the derivative is then the one of the side on which the node was found, and a step to the other
    side has another. Two cases are always one-sided: friction 0 answers to more friction only, and
    infinite friction to no change at all.
    """

    pins: np.ndarray  # (B, P, 3)
    d_points: np.ndarray  # (B, P, 3, K, 6) per mm and per degree of the way points
    d_friction: np.ndarray  # (B, P, 3)
    d_log_ratio: np.ndarray  # (B, P, 3) by log(skin modulus : gel modulus)
    margin_mm: np.ndarray  # (B,)
    at_switch: np.ndarray  # (B,) bool
    converged: np.ndarray  # (B,) bool; where it is not, the derivatives say nothing


def make_pin_model(
    sensor: Sensor,
    stimuli: Stimuli,
    paths: Paths,
    level: str | Level = "auto",
    ratios: tuple[float, ...] = (),
) -> PinModel:
    """Make a model of the sensor on these paths. Call under `jax.enable_x64(True)`.

    The paths are cut into increments as at `level`. The compliance is known at the sensor's own
    ratio of skin to gel modulus, and nearby to first order; or at rising `ratios`, and in between
    by interpolation in the logarithm.
    """
    simulation = Simulation(sensor, stimuli, get_level(level))
    check_paths(sensor, len(stimuli), paths)
    if list(ratios) != sorted(set(ratios)) or any(not 0 < ratio < np.inf for ratio in ratios):
        raise UserError(f"ratios {ratios}: give rising numbers above zero")
    sensor_ratio = sensor.skin_modulus_mpa / sensor.gel_modulus_mpa
    rest = domes.load_dome(sensor)
    reachable, usual = (find_reachable_nodes(simulation, paths, wide) for wide in (True, False))
    index = np.flatnonzero(reachable.any(axis=0))
    index = index if len(index) else np.arange(1)
    return PinModel(
        log_ratio=jnp.asarray(np.log(sensor_ratio)),
        compliances=_load_compliances(sensor, ratios or (sensor_ratio,), index),
        nodes=jnp.asarray(rest.nodes[index]),
        centre_mm=jnp.asarray(sensor.dome_radius_mm),
        tips=jnp.asarray(rest.pins),
        obstacles=simulation.obstacles,
        obstacle_index=jnp.asarray(paths.stimulus, jnp.int32),
        shares=jnp.asarray(compute_path_shares(paths, simulation.level, sensor.dome_radius_mm)),
        max_touching=int(TOUCHING_SHARE * usual.sum(axis=1).max(initial=0)) + 1,
    )


def _load_compliances(sensor: Sensor, ratios: tuple[float, ...], index: np.ndarray) -> Compliances:
    """Load the compliances of the contact nodes `index`."""
    rows = (3 * index[:, None] + np.arange(3)).ravel()
    square = np.ix_(rows, rows)
    parts = []
    for ratio in ratios:
        other = replace(sensor, skin_modulus_mpa=ratio * sensor.gel_modulus_mpa)
        full, (dw, dg) = domes.load_dome(other), domes.load_sensitivity(other)
        parts.append((full.w[square], dw[square], full.g[:, rows], dg[:, rows]))
    fields = (jnp.asarray(np.stack(field)) for field in zip(*parts, strict=True))
    return Compliances(jnp.asarray(np.log(ratios)), *fields)


def compute_path_shares(paths: Paths, level: Level, radius_mm: float) -> Float[np.ndarray, "B T K"]:
    """Compute the poses that `scheduler.cut_increments` makes, as means of the way points.

    A leg without length has no increments: its end carries no derivative, as what would come of it
    depends on where to.
    """
    legs = range(paths.points.shape[1] - 1)
    counts = []
    for leg in legs:
        alone = Paths(paths.stimulus, paths.friction, paths.points[:, leg : leg + 2])
        counts.append(cut_increments(alone, level, radius_mm)[1])
    number = np.arange(int(np.sum(counts, axis=0).max(initial=0)) + 1)
    shares = np.zeros((len(paths), len(number), len(legs) + 1))
    for row, count in zip(shares, np.transpose(counts), strict=True):
        points = np.flatnonzero(np.append(1, count))
        ends = np.append(0, np.cumsum(count))[points]
        hats = [np.interp(number, ends, hat) for hat in np.eye(len(points))]
        row[:, points] = np.stack(hats, -1)
    return shares


def simulate_pins(
    model: PinModel,
    points: Float[Array, "B K 6"],
    friction: Float[Array, "B"],
    log_ratio: Float[Array, ""] | None = None,
) -> PinPositions:
    """Simulate the pins at the ends of paths through way points in mm and degrees.

    `log_ratio` is log(skin : gel modulus). Differentiable by all three, for points not far from the
    model's own, whose nodes and increments it keeps.
    """
    turns = jnp.zeros(6, bool).at[jnp.array(TURNS)].set(True)
    path = jnp.einsum(
        "btk,bkc->tbc", model.shares, points * jnp.where(turns, jnp.pi / 180, 1.0)[None, None]
    )
    w, g = model.compliances.interpolate(model.log_ratio if log_ratio is None else log_ratio)
    inverse = jnp.linalg.inv(jax.lax.stop_gradient(w) + RHO * jnp.eye(len(w), dtype=w.dtype))
    problem = ContactProblem(
        System(w, inverse, w, model.nodes, model.centre_mm),
        model.obstacles,
        model.obstacle_index,
        friction,
        tilted=True,
        max_touching=model.max_touching,
    )
    skin = make_undeformed_skins(problem.system, path[0])
    state = compute_pin_state(problem, g.T, path, skin)
    return PinPositions(model.tips[None] + state.motion, state.margin_mm, state.residual_mm)


def compute_pin_gradient(
    sensor: Sensor,
    stimuli: Stimuli,
    paths: Paths,
    level: str | Level = "auto",
    batch: int = 16,
) -> PinGradient:
    """Compute the pins of B scenes and their derivatives by everything, in float64."""
    check_batch(batch)
    if not len(paths):
        raise UserError("paths: no scene is given, so there is nothing to differentiate")
    parts = []
    with jax.enable_x64(True):
        for first in range(0, len(paths), batch):
            part = paths.take(np.arange(first, min(first + batch, len(paths))))
            model = make_pin_model(sensor, stimuli, part, level)
            points, friction = jnp.asarray(part.points), jnp.asarray(part.friction)
            parts.append(jax.device_get(_differentiate_pins(model, points, friction)))
    merged = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    positions = merged.positions
    return PinGradient(
        positions.pins,
        merged.by_points,
        merged.by_friction,
        merged.by_ratio,
        positions.margin_mm,
        positions.margin_mm < SWITCH_MM,
        positions.residual_mm <= GOAL_MM["float64"],
    )


class _PinDerivatives(NamedTuple):
    positions: PinPositions
    by_points: Array  # (B, P, 3, K, 6)
    by_friction: Array  # (B, P, 3)
    by_ratio: Array  # (B, P, 3)


@jax.jit
def _differentiate_pins(model: PinModel, points: Array, friction: Array) -> _PinDerivatives:
    """Differentiate the pins with one tangent for all scenes at once.

    No scene depends on another, and all tangents share each increment's matrix.
    """
    count, ways = points.shape[0], points.shape[1] * 6
    tangents = (
        jnp.broadcast_to(
            jnp.eye(ways + 2, ways).reshape(-1, 1, points.shape[1], 6), (ways + 2, *points.shape)
        ),
        jnp.zeros((ways + 2, count)).at[ways].set(1.0),
        jnp.zeros(ways + 2).at[ways + 1].set(1.0),
    )

    def simulate(*inputs: Array) -> tuple[Array, PinPositions]:
        positions = simulate_pins(model, *inputs)
        return positions.pins, positions

    def push(*tangent: Array) -> tuple[PinPositions, Array]:
        inputs = (points, friction, model.log_ratio)
        _, slope, positions = jax.jvp(simulate, inputs, tangent, has_aux=True)
        return positions, slope

    positions, slopes = jax.vmap(push, out_axes=(None, -1))(*tangents)
    by_points = slopes[..., :ways].reshape(*slopes.shape[:-1], *points.shape[1:])
    return _PinDerivatives(positions, by_points, slopes[..., ways], slopes[..., ways + 1])
