"""How the pins answer to each way point of a motion, to friction and to the ratio of the moduli.

    found = compute_pin_gradient(TACTIP_331, ("disk",), paths)
    found.d_points  # (B, P, 3, K, 6) mm of pin motion per mm or degree of each way point
    found.at_switch  # (B,) there a derivative is one-sided

and, to put pins into a loss of one's own:

    with jax.enable_x64(True):
        model = make_pin_model(TACTIP_331, ("disk",), paths)
        loss = lambda friction: jnp.sum((simulate_pins(model, paths.points, friction).pins - seen) ** 2)
        jax.jit(jax.value_and_grad(loss))(paths.friction)

All derivatives are those of the converged contact (see `implicit`), along a path whose increments are cut as for the model's
paths. They do not see the kinks of a sampled obstacle's distance, at whose grid lines it bends by about 1 %.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator import dome as domes
from jaxunshear.simulator.batches import Stimuli, sample_obstacles
from jaxunshear.simulator.contact_results import Skins
from jaxunshear.simulator.friction import RHO, Skin, System
from jaxunshear.simulator.implicit import GOAL_MM, compute_pin_state
from jaxunshear.simulator.input_checks import check_batch, check_paths, check_start, get_level
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.obstacle import Obstacles
from jaxunshear.simulator.paths import TURNS, Paths
from jaxunshear.simulator.scheduler import cut_increments, find_reachable_nodes

SWITCH_MM = 1e-6  # nearer to a switch than this, rounding decides on which side a node is found
TOUCHING_SHARE = 0.75  # of the nodes within reach: about as many as ever touch at once


@partial(jax.tree_util.register_dataclass)
@dataclass(frozen=True)
class PinModel:
    """A sensor on the paths it was made for, as arrays: goes through jit and grad.

    The compliance is known, with its slope, at M ratios of the moduli (`knots`), mm/N for the sensor's gel.
    """

    log_ratio: Array  # () the sensor's own log(skin modulus : gel modulus)
    knots: Array  # (M,) of it
    w: Array  # (M, 3N, 3N), and its slope
    w_slope: Array
    g: Array  # (M, 3P, 3N)
    g_slope: Array
    nodes: Array  # (N, 3)
    centre_mm: Array
    tips: Array  # (P, 3) pin tips at rest
    obstacles: Obstacles
    which: Array  # (B,)
    shares: Array  # (B, T + 1, K) of the way points in each pose of the path
    force_n: Array  # (B, N, 3) at the first point
    max_touching: int = field(
        metadata={"static": True}
    )  # nodes of a scene that touch at once, probably


class PinPositions(NamedTuple):
    pins: Array  # (B, P, 3) mm in the sensor frame
    margin_mm: Array  # (B,) to the nearest switch
    residual_mm: Array  # (B,) of the worst increment


class PinGradient(NamedTuple):
    """Derivatives of B scenes' pins (numpy, mm in the sensor frame).

    They are exact for changes that move no node past a switch: between touching and parting, or stick and slip. `margin_mm` is
    how far the nearest one was in any increment: in mm of a node's gap or slip, or of the displacement that the missing force
    would give to its node. A finite difference agrees as long as its step moves the skin by less. `at_switch`: below SWITCH_MM;
    the derivative is then the one of the side on which the node was found, and a step to the other side sees another.
    Two cases are one-sided by nature: friction 0 answers to more friction only, and infinite friction to no change at all.
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
    names: Stimuli,
    paths: Paths,
    level: str | Level = "auto",
    ratios: tuple[float, ...] = (),
    start: Skins | None = None,
    wide: bool = True,
) -> PinModel:
    """The sensor on these paths, cut into increments as at `level`. Call under `jax.enable_x64(True)`.

    Skin and gel are known at the sensor's own ratio, and nearby to first order; or at rising `ratios` and, by cubic Hermite
    interpolation in the logarithm, in between. With `start`, each path goes on from its first point with that skin. `wide`
    False keeps about half of the nodes, those that usually suffice: faster, but nothing shows where they do not.
    """
    level = get_level(level)
    check_paths(sensor, len(names), paths)
    if list(ratios) != sorted(set(ratios)) or any(not 0 < ratio < np.inf for ratio in ratios):
        raise UserError(f"ratios {ratios}: give rising numbers above zero")
    own = sensor.skin_modulus_mpa / sensor.gel_modulus_mpa
    obstacles = sample_obstacles(names)
    rest = domes.load_dome(sensor)
    within = lambda wide: find_reachable_nodes(
        obstacles, rest.nodes, sensor.dome_radius_mm, paths, wide
    )
    touched = within(wide)
    if start is not None:
        check_start(paths, start, len(rest.nodes))
        touched |= np.any(start.force_n != 0, axis=-1)
    index = np.flatnonzero(touched.any(axis=0))
    index = index if len(index) else np.arange(1)
    rows = (3 * index[:, None] + np.arange(3)).ravel()
    parts = []
    for ratio in ratios or (own,):
        other = replace(sensor, skin_modulus_mpa=ratio * sensor.gel_modulus_mpa)
        full, (dw, dg) = domes.load_dome(other), domes.load_sensitivity(other)
        parts.append(
            (full.w[np.ix_(rows, rows)], dw[np.ix_(rows, rows)], full.g[:, rows], dg[:, rows])
        )
    force = np.zeros((len(paths), len(index), 3)) if start is None else start.force_n[:, index]
    w, w_slope, g, g_slope = (jnp.asarray(np.stack(part)) for part in zip(*parts, strict=True))
    return PinModel(
        log_ratio=jnp.asarray(np.log(own)),
        knots=jnp.asarray(np.log(ratios or (own,))),
        w=w,
        w_slope=w_slope,
        g=g,
        g_slope=g_slope,
        nodes=jnp.asarray(rest.nodes[index]),
        centre_mm=jnp.asarray(sensor.dome_radius_mm),
        tips=jnp.asarray(rest.pins),
        obstacles=obstacles,
        which=jnp.asarray(paths.stimulus, jnp.int32),
        shares=jnp.asarray(compute_path_shares(paths, level, sensor.dome_radius_mm)),
        force_n=jnp.asarray(force),
        max_touching=int(TOUCHING_SHARE * within(False).sum(axis=1).max(initial=0)) + 1,
    )


def compute_path_shares(paths: Paths, level: Level, radius_mm: float) -> Float[np.ndarray, "B T K"]:
    """Poses as `scheduler.cut_increments` cuts them, as means of the way points.

    A leg without length has no increments: its end carries no derivative, as what would come of it depends on where to.
    """
    legs = range(paths.points.shape[1] - 1)
    counts = [
        cut_increments(
            Paths(paths.stimulus, paths.friction, paths.points[:, k : k + 2]), level, radius_mm
        )[1]
        for k in legs
    ]
    number = np.arange(int(np.sum(counts, axis=0).max(initial=0)) + 1)
    shares = np.zeros((len(paths), len(number), len(legs) + 1))
    for row, count in zip(shares, np.transpose(counts), strict=True):
        kept = np.flatnonzero(np.append(1, count))
        ends = np.append(0, np.cumsum(count))[kept]
        row[:, kept] = np.stack([np.interp(number, ends, only) for only in np.eye(len(kept))], -1)
    return shares


def interpolate_compliance(
    model: PinModel, log_ratio: Float[Array, ""]
) -> tuple[Float[Array, "N3 N3"], Float[Array, "P3 N3"], Float[Array, ""]]:
    """w (3N, 3N) and g (3P, 3N) at this ratio of the moduli, over the mean diagonal of w, which comes third."""
    if len(model.knots) == 1:
        step = log_ratio - model.knots[0]
        w, g = model.w[0] + step * model.w_slope[0], model.g[0] + step * model.g_slope[0]
    else:
        left = jnp.clip(jnp.searchsorted(model.knots, log_ratio) - 1, 0, len(model.knots) - 2)
        width = model.knots[left + 1] - model.knots[left]
        s = (log_ratio - model.knots[left]) / width
        weights = (
            (1 + 2 * s) * (1 - s) ** 2,
            s**2 * (3 - 2 * s),
            width * s * (1 - s) ** 2,
            width * s**2 * (s - 1),
        )

        def between(values: Array, slopes: Array) -> Array:
            ends = jnp.stack([values[left], values[left + 1], slopes[left], slopes[left + 1]])
            return jnp.tensordot(jnp.stack(weights), ends, 1)

        w, g = between(model.w, model.w_slope), between(model.g, model.g_slope)
    scale = jax.lax.stop_gradient(jnp.trace(w) / len(w))
    return w / scale, g / scale, scale


def simulate_pins(
    model: PinModel,
    points: Float[Array, "B K 6"],
    friction: Float[Array, "B"],
    log_ratio: Float[Array, ""] | None = None,
) -> PinPositions:
    """Pins at the ends of paths through way points mm and degrees, at friction and log(skin : gel modulus).

    Differentiable by all three; for points not far from the model's own, whose nodes and increments it keeps.
    """
    turns = jnp.zeros(6, bool).at[jnp.array(TURNS)].set(True)
    path = jnp.einsum(
        "btk,bkc->tbc", model.shares, points * jnp.where(turns, jnp.pi / 180, 1.0)[None, None]
    )
    w, g, scale = interpolate_compliance(model, model.log_ratio if log_ratio is None else log_ratio)
    inverse = jnp.linalg.inv(jax.lax.stop_gradient(w) + RHO * jnp.eye(len(w), dtype=w.dtype))
    system = System(w, inverse, w, model.nodes, model.centre_mm)
    force = model.force_n * scale
    skin = Skin(
        force,
        jnp.zeros_like(force),
        (force.reshape(len(force), -1) @ w).reshape(force.shape),
        path[0],
    )
    state = compute_pin_state(
        system, g.T, model.obstacles, model.which, friction, path, skin, model.max_touching
    )
    return PinPositions(model.tips[None] + state.motion, state.margin_mm, state.residual_mm)


def compute_pin_gradient(
    sensor: Sensor,
    names: Stimuli,
    paths: Paths,
    level: str | Level = "auto",
    start: Skins | None = None,
    batch: int = 16,
) -> PinGradient:
    """Pins of B scenes and their derivatives by everything, in float64."""
    check_batch(batch)
    if not len(paths):
        raise UserError("paths: no scene is given, so there is nothing to differentiate")
    parts = []
    with jax.enable_x64(True):
        for first in range(0, len(paths), batch):
            rows = np.arange(first, min(first + batch, len(paths)))
            part, before = paths.take(rows), None if start is None else start.take(rows)
            model = make_pin_model(sensor, names, part, level, start=before)
            parts.append(
                jax.device_get(
                    _derivatives(model, jnp.asarray(part.points), jnp.asarray(part.friction))
                )
            )
    answer, by_points, by_friction, by_ratio = jax.tree.map(
        lambda *fields: np.concatenate(fields), *parts
    )
    return PinGradient(
        answer.pins,
        by_points,
        by_friction,
        by_ratio,
        answer.margin_mm,
        answer.margin_mm < SWITCH_MM,
        answer.residual_mm <= GOAL_MM["float64"],
    )


@jax.jit
def _derivatives(
    model: PinModel, points: Array, friction: Array
) -> tuple[PinPositions, Array, Array, Array]:
    """One tangent for all scenes at once, as none knows of another; all tangents share each increment's matrix."""
    count, ways = points.shape[0], points.shape[1] * 6
    tangents = (
        jnp.broadcast_to(
            jnp.eye(ways + 2, ways).reshape(-1, 1, points.shape[1], 6), (ways + 2, *points.shape)
        ),
        jnp.zeros((ways + 2, count)).at[ways].set(1.0),
        jnp.zeros(ways + 2).at[ways + 1].set(1.0),
    )
    at = (points, friction, model.log_ratio)

    def push(*tangent: Array) -> tuple[PinPositions, Array]:
        def both(*x: Array) -> tuple[Array, PinPositions]:
            answer = simulate_pins(model, *x)
            return answer.pins, answer

        _, slope, answer = jax.jvp(both, at, tangent, has_aux=True)
        return answer, slope

    answer, slopes = jax.vmap(push, out_axes=(None, -1))(*tangents)
    by_points = slopes[..., :ways].reshape(*slopes.shape[:-1], *points.shape[1:])
    return answer, by_points, slopes[..., ways], slopes[..., ways + 1]
