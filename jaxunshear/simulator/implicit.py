"""The converged contact as a differentiable function: pins by path, friction and compliance, from the implicit function theorem.

Every increment's force solves f = P(f - c), c = W f + b. Differentiated there, with D = P' (3 x 3 for each node: the identity
where it sticks, the disk's projection where it slips, nothing where it is free),

    (I - D (I - W)) df = -D (dW f + db) + (dP/dmu) dmu,

one dense system a scene and increment, whichever way the solver came to f. It is written as a forward rule
(`jax.custom_jvp`), whose transpose JAX derives, so that few inputs (`jax.jacfwd`) and few outputs (`jax.grad`) are cheap alike;
what an increment inherits from those before it flows through the skin's displacement. Going back, only the forces are kept and
the systems are built again. The same matrix polishes the force by semismooth Newton steps (Qi & Sun 1993, Math. Program. 58),
so that the answer that is differentiated holds to rounding.

At a switch, where a node is about to touch, part, stick or slip, P has a kink and the pins have one-sided derivatives only.
What comes out then belongs to the side on which the node was found. `compute_switch_distance` says how far the nearest switch was.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.ad_checkpoint import checkpoint_name
from jax.custom_batching import custom_vmap
from jaxtyping import Float, Int

from jaxunshear.simulator.frame import compute_increment_length, compute_level_frame, rotate
from jaxunshear.simulator.friction import (
    LEAST_MM,
    MOST_MM,
    PASSES,
    RHO,
    Skin,
    System,
    _times,
    compute_increment_offset,
    project,
    solve_increment,
)
from jaxunshear.simulator.obstacle import Obstacles

TOLERANCE, LIMIT = 1e-3, 2000  # of the solver's first round, before the Newton steps
ROUNDS, NEWTON = 4, 12
GOAL_MM = {"float64": 1e-10, "float32": 2e-6}  # natural residual at which an increment is done


class WarmStart(NamedTuple):
    """What helps to find a force and does not change it; carries no derivative."""

    inverse: Array
    force: Array  # (B, N, 3), in the level frame
    dual: Array
    length_mm: Array  # (B,) of the increment, 0 for skins that stay


class PinState(NamedTuple):
    """After a path. Only `motion` and `skin` carry derivatives."""

    motion: Array  # (B, P, 3) mm that the pin tips moved, sensor frame
    skin: Skin
    margin_mm: Array  # (B,) to the nearest switch of any node in any increment
    residual_mm: Array  # (B,) natural residual of the worst increment


_Search = tuple[Array, Array, Array, Array]
_SolverInputs = tuple[Array, Array, Array, Array, WarmStart]
_Pass = tuple[Array, Array, Array, Array, Array]


def compute_projection_slopes(
    moved: Float[Array, "B N 3"], friction: Float[Array, "B"]
) -> tuple[Float[Array, "B N 3 3"], Float[Array, "B N 3"]]:
    """Derivatives of P: by the force, and by friction.

    Without friction the disk is a point and P is smooth: no tangential force, and none that answers to a tangential move.
    """
    tangential, normal = moved[..., :2], moved[..., 2]
    sticks, mu = jnp.isinf(friction)[:, None], jnp.where(jnp.isinf(friction), 0, friction)[:, None]
    pull = jnp.sqrt(jnp.sum(tangential**2, axis=-1))
    limit = mu * jnp.maximum(normal, 0)
    slips = ~sticks & ((pull > limit) | (mu == 0))
    along = tangential / jnp.where(pull > 0, pull, 1)[..., None]
    share = jnp.where(slips, limit / jnp.where(pull > 0, pull, 1), 1)
    outer = jnp.where(slips[..., None, None], along[..., :, None] * along[..., None, :], 0)
    disk = share[..., None, None] * (jnp.eye(2, dtype=moved.dtype)[None, None] - outer)
    zero, one = jnp.zeros_like(normal), jnp.ones_like(normal)
    by_normal = jnp.where(slips, mu, 0)[..., None] * along
    bottom = jnp.stack([zero, zero, one], -1)[..., None, :]
    matrix = jnp.concatenate([jnp.concatenate([disk, by_normal[..., None]], -1), bottom], -2)
    by_friction = jnp.concatenate(
        [jnp.where(slips, jnp.maximum(normal, 0), 0)[..., None] * along, zero[..., None]], -1
    )
    touches = (normal > 0)[..., None]
    return jnp.where(touches[..., None], matrix, 0), jnp.where(touches, by_friction, 0)


def compute_switch_distance(
    moved: Float[Array, "B N 3"], friction: Float[Array, "B"]
) -> Float[Array, "B"]:
    """In mm, by which f - (W f + b) may change before any node touches, parts, sticks or slips.

    For a free node that is its gap, for a slipping one its slip beyond the last that would stick; forces count in mm of the
    displacement that each would give to its own node.
    """
    tangential, normal = moved[..., :2], moved[..., 2]
    mu = friction[:, None]
    either = (mu > 0) & ~jnp.isinf(mu) & (normal > 0)
    limit = jnp.where(either, mu, 0) * normal
    beyond = jnp.abs(jnp.sqrt(jnp.sum(tangential**2, axis=-1)) - limit)
    return jnp.min(jnp.minimum(jnp.abs(normal), jnp.where(either, beyond, jnp.inf)), axis=-1)


def _solve_linear(w: Array, frame: Array, slope: Array, right: Array, most: int) -> Array:
    """df (B, N, 3) of (I - D (I - W)) df = right, in the level frame; free nodes, D = 0, drop out.

    As long as no scene touches with more than `most` nodes, the systems have that size.
    """
    back = jnp.swapaxes(frame, 1, 2)
    inside = (jnp.einsum("bji,bnjk,bkl->bnil", frame, slope, frame), rotate(back, right))
    touches = jnp.any(slope != 0, axis=(2, 3))
    if most >= touches.shape[1]:
        return rotate(frame, _dense(w, *inside))
    few = _most_touching(jax.lax.stop_gradient(touches)) <= most
    return rotate(frame, jax.lax.cond(few, partial(_on_touching, most), _dense, w, *inside))


@custom_vmap
def _most_touching(touches: Array) -> Array:
    """Of all scenes, of those of a vmap too: the choice that stands on it stays one, or both of its sides would be worked out.

    XLA's CPU client was seen to wait for ever for two such factorisations of one loop.
    """
    return jnp.max(jnp.sum(touches, axis=-1))


@_most_touching.def_vmap
def _most_touching_rule(size: int, batched: list[bool], touches: Array) -> tuple[Array, bool]:
    return _most_touching(touches), False


def _on_touching(most: int, w: Array, slope: Array, right: Array) -> Array:
    touches = jnp.any(slope != 0, axis=(2, 3))
    index = jnp.argsort(~touches, axis=1, stable=True)[:, :most]
    free = jnp.where(touches[..., None], 0, right)
    side = right - jnp.einsum("bnij,bnj->bni", slope, _times(w, free, None))
    pick = lambda field: jax.vmap(lambda row, i: row[i])(field, index)  # noqa: E731
    nodes = right.shape[1]
    blocks = (
        w.T.reshape(nodes, 3, nodes, 3)
        .transpose(0, 2, 1, 3)[index[:, :, None], index[:, None]]
        .transpose(0, 1, 3, 2, 4)
    )
    found = _dense_blocks(blocks, pick(slope), pick(side))
    return jax.vmap(lambda row, i, values: row.at[i].set(values, unique_indices=True))(
        free, index, jnp.where(pick(touches)[..., None], found, pick(free))
    )


def _dense(w: Array, slope: Array, right: Array) -> Array:
    nodes = right.shape[1]
    return _dense_blocks(w.T.reshape(1, nodes, 3, nodes, 3), slope, right)


def _dense_blocks(blocks: Array, slope: Array, right: Array) -> Array:
    """(I - D (I - W)) x = right for W as blocks (B or 1, M, 3, M, 3)."""
    count, nodes = right.shape[:2]
    one = jnp.eye(3 * nodes, dtype=right.dtype).reshape(1, nodes, 3, nodes, 3)
    matrix = one + jnp.einsum("bnij,bnjmk->bnimk", slope, blocks - one)
    factors = jax.scipy.linalg.lu_factor(matrix.reshape(count, 3 * nodes, 3 * nodes))
    return jax.vmap(jax.scipy.linalg.lu_solve)(factors, right.reshape(count, -1)).reshape(
        right.shape
    )


def _compute_shifted_force(w: Array, frame: Array, offset: Array, force: Array) -> Array:
    return force - _times(w, force, frame) - offset


def _size(miss: Array) -> Array:
    return jnp.max(jnp.linalg.norm(miss, axis=-1), axis=-1)


def _find(
    most: int, w: Array, frame: Array, offset: Array, friction: Array, guess: WarmStart
) -> Array:
    """The force by rounds of ADMM, each ten times tighter than the one before, and Newton steps where these help."""
    goal = jnp.where(guess.length_mm > 0, GOAL_MM[offset.dtype.name], jnp.inf).astype(offset.dtype)
    system = System(w, guess.inverse, w, jnp.zeros((0, 3), w.dtype), jnp.zeros((), w.dtype))

    def miss(force: Array) -> Array:
        return force - project(_compute_shifted_force(w, frame, offset, force), friction)

    def newton(state: _Search) -> _Search:
        force, error, _, number = state
        slope, _ = compute_projection_slopes(
            _compute_shifted_force(w, frame, offset, force), friction
        )
        after = force - _solve_linear(w, frame, slope, miss(force), most)
        error_after = _size(miss(after))
        better = (error_after < error) & (error > goal)
        pick = lambda new, old: jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
        return pick(after, force), pick(error_after, error), jnp.any(better), number + 1

    def newton_goes_on(state: _Search) -> Array:
        _, error, improved, number = state
        return jnp.any(error > goal) & improved & (number < NEWTON)

    def one_round(state: _Search) -> _Search:
        force, dual, error, number = state
        length = jnp.clip(guess.length_mm, LEAST_MM, MOST_MM)
        wanted = jnp.where(
            error > goal, TOLERANCE * length * 10.0 ** -number.astype(length.dtype), jnp.inf
        ).astype(offset.dtype)
        warm = (force, dual, _times(w, force, frame))
        force, dual, _, _ = solve_increment(system, frame, offset, friction, warm, wanted, LIMIT)
        start = (force, _size(miss(force)), jnp.ones((), bool), jnp.zeros((), jnp.int32))
        force, error, _, _ = jax.lax.while_loop(newton_goes_on, newton, start)
        return force, -(_times(w, force, frame) + offset) / RHO, error, number + 1

    opening = -(_times(w, guess.force, frame) + offset) / RHO
    dual = jnp.where(guess.force[..., -1:] > 0, guess.dual, opening)
    error = jnp.where(guess.length_mm > 0, _size(miss(guess.force)), 0)
    start = (guess.force, dual, error, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(lambda s: jnp.any(s[2] > goal) & (s[3] < ROUNDS), one_round, start)[0]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def solve_contact_force(
    most: int,
    w: Float[Array, "N3 N3"],
    frame: Float[Array, "B 3 3"],
    offset: Float[Array, "B N 3"],
    friction: Float[Array, "B"],
    guess: WarmStart,
) -> Float[Array, "B N 3"]:
    """Force, in the level frame, of f = P(f - (W f + b)) with offset b; N3 = 3 N.

    Fastest where no more than `most` nodes of a scene touch, and right anyway.
    """
    return _find(most, w, frame, offset, friction, guess)


@solve_contact_force.defjvp
def _contact_force_jvp(
    most: int, primals: _SolverInputs, tangents: _SolverInputs
) -> tuple[Array, Array]:
    w, frame, offset, friction, guess = primals
    force = checkpoint_name(solve_contact_force(most, *primals), "force")
    total, change = jax.jvp(
        lambda *given: _times(given[0], force, given[1]) + given[2],
        (w, frame, offset),
        tangents[:3],
    )
    slope, by_friction = compute_projection_slopes(force - total, friction)
    finite = jnp.where(jnp.isinf(friction), 0, tangents[3])
    right = by_friction * finite[:, None, None] - jnp.einsum("bnij,bnj->bni", slope, change)
    return force, _solve_linear(w, frame, slope, right, most)


def compute_pin_state(
    system: System,
    to_pins: Float[Array, "N3 P3"],
    obstacles: Obstacles,
    which: Int[Array, "B"],
    friction: Float[Array, "B"],
    path: Float[Array, "T B 6"],
    skin: Skin,
    most: int,
) -> PinState:
    """Where the pins are after B skins followed `path`, as `friction.follow_path`, each increment to rounding.

    Differentiable by `system.w`, `to_pins` (both scaled as in `System`), `friction`, `path`, and the displacement of
    `skin`, which is at path[0]. `system` must have three unknowns a node; float64 is advised. Runs under jit;
    the batch is its own. `most`: see `solve_contact_force`.
    """

    def step(
        state: tuple[Skin, Array, Array], pose: Array
    ) -> tuple[tuple[Skin, Array, Array], None]:
        skin, margin, worst = state
        moves = jnp.any(pose != skin.pose, axis=-1)
        length = jnp.where(
            moves, compute_increment_length(skin.pose, pose, system.centre_mm / 4), 0
        )
        frame = compute_level_frame(pose)
        back, keep = jnp.swapaxes(frame, 1, 2), moves[:, None, None]

        @partial(
            jax.checkpoint,
            prevent_cse=False,
            policy=jax.checkpoint_policies.save_only_these_names("force"),
        )
        def one_pass(state: _Pass, _: None) -> tuple[_Pass, None]:
            force, dual, displacement, margin, worst = state
            offset = compute_increment_offset(
                system, obstacles, which, skin, pose, True, displacement
            )
            guess = jax.lax.stop_gradient(WarmStart(system.inverse, force, dual, length))
            force = solve_contact_force(most, system.w, frame, offset, friction, guess)
            total = _times(system.w, force, frame) + offset
            displacement = (rotate(back, force).reshape(len(which), -1) @ system.w).reshape(
                force.shape
            )
            margin = jnp.minimum(
                margin, jnp.where(moves, compute_switch_distance(force - total, friction), jnp.inf)
            )
            worst = jnp.maximum(
                worst, jnp.where(moves, _size(force - project(force - total, friction)), 0)
            )
            return (force, -total / RHO, displacement, margin, worst), None

        start = (
            rotate(frame, skin.force),
            rotate(frame, skin.dual),
            skin.displacement,
            margin,
            worst,
        )
        (force, dual, displacement, margin, worst), _ = jax.lax.scan(one_pass, start, length=PASSES)
        after = Skin(
            jnp.where(keep, rotate(back, force), skin.force),
            jnp.where(keep, rotate(back, dual), skin.dual),
            jnp.where(keep, displacement, skin.displacement),
            pose,
        )
        return (after, margin, worst), None

    none = jnp.zeros(len(which), path.dtype)
    (skin, margin, worst), _ = jax.lax.scan(step, (skin, none + jnp.inf, none), path[1:])
    motion = (skin.force.reshape(len(which), -1) @ to_pins).reshape(len(which), -1, 3)
    return PinState(motion, skin, jax.lax.stop_gradient(margin), jax.lax.stop_gradient(worst))
