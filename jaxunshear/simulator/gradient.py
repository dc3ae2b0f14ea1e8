"""Pins as a differentiable function of way points, friction and the ratio of the moduli.

    with jax.enable_x64(True):
        model = make_pin_model(TACTIP_331, ("disk",), paths)

        def compute_loss(friction):
            pins = simulate_pins(model, paths.points, friction).pins
            return jnp.sum((pins - measured_pins) ** 2)

        jax.jit(jax.value_and_grad(compute_loss))(paths.friction)

All derivatives are those of the converged contact (see `implicit`), along a path whose increments
are cut as for the model's paths. They do not see the kinks of a sampled obstacle's distance, whose
slope changes by about 1 % at its grid lines. No scene depends on another, so a tangent may move all
scenes at once, and tangents under `jax.vmap` share each increment's matrix.
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
from jaxunshear.simulator.contact_problem import RHO, ContactProblem, System, make_undeformed_skins
from jaxunshear.simulator.contacts import check_paths
from jaxunshear.simulator.implicit import compute_pin_state
from jaxunshear.simulator.level import Level, get_level
from jaxunshear.simulator.paths import TURNS, Paths, cut_increments
from jaxunshear.simulator.scheduler import Simulation, Stimuli, find_reachable_nodes
from jaxunshear.simulator.stimuli import Obstacles

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
    radius_mm: Array
    tips: Array  # (P, 3) pin tips at rest
    obstacles: Obstacles
    obstacle_index: Array  # (B,)
    shares: Array  # (B, T + 1, K) of the way points in each pose of the path
    # nodes of a scene that touch at once, probably
    max_touching: int = field(metadata={"static": True})


class PinPositions(NamedTuple):
    """Pins of B scenes, and how far their derivatives can be trusted.

    Derivatives are exact for changes that move no node past a switch: between touching and parting,
    or stick and slip. `margin_mm` is how far the nearest one was in any increment: in mm of a
    node's gap or slip, or of the displacement that the missing force would give to its node. A
    finite difference agrees as long as its step moves the skin by less. Two cases are always
    one-sided: friction 0 answers to more friction only, and infinite friction to no change at all.
    """

    pins: Array  # (B, P, 3) mm in the sensor frame
    margin_mm: Array  # (B,) below 1e-6 rounding decides on which side of a switch a node is
    residual_mm: Array  # (B,) of the worst increment; solved up to `implicit.GOAL_MM`


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
    usual = find_reachable_nodes(simulation, paths, wide=False)
    index = np.flatnonzero(find_reachable_nodes(simulation, paths, wide=True).any(axis=0))
    index = index if len(index) else np.arange(1)
    return PinModel(
        log_ratio=jnp.asarray(np.log(sensor_ratio)),
        compliances=_load_compliances(sensor, ratios or (sensor_ratio,), index),
        nodes=jnp.asarray(rest.nodes[index]),
        centre_mm=jnp.asarray(sensor.pivot_mm),
        radius_mm=jnp.asarray(sensor.radius_mm),
        tips=jnp.asarray(rest.pins),
        obstacles=simulation.obstacles,
        obstacle_index=jnp.asarray(paths.stimulus, jnp.int32),
        shares=jnp.asarray(compute_path_shares(paths, simulation.level, sensor.radius_mm)),
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
        System(w, inverse, w, model.nodes, model.centre_mm, model.radius_mm),
        model.obstacles,
        model.obstacle_index,
        friction,
        tilted=True,
        max_touching=model.max_touching,
    )
    skin = make_undeformed_skins(problem.system, path[0])
    state = compute_pin_state(problem, g.T, path, skin)
    return PinPositions(model.tips[None] + state.motion, state.margin_mm, state.residual_mm)
