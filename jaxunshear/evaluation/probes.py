"""Probes: what a linear map and a small network can recover of a quantity from a code, learnt on some contacts, asked on others.

>>> answers = PROBES["mlp"](codes, wanted, others, groups)    # (N, F), (N, K), (M, F) -> (M, K)
>>> mean, deviation = gaussian(codes, wanted, others, groups)  # the same network, that says how sure it is: (M, K) each

Both scale each number of the code by its own spread, so that what is whispered counts as what is shouted.
"""

from collections.abc import Callable
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.typing import VariableDict
from scipy import linalg

HIDDEN, LAYERS = 128, 2
STEPS, BATCH, RATE, DECAY = 1000, 128, 2e-3, 1e-3
CHECKS = 20  # at the fifth that is kept out of fitting
RIDGES = (1e-6, 1e-4, 1e-2, 1.0)  # times the number of examples
LOG_DEVIATIONS = (-6.0, 2.0)  # least and most, of what is scaled to a deviation of one
LEAST = 1e-12  # spread of a number that does not vary
_State = tuple[VariableDict, optax.OptState]


class MLP(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(LAYERS):
            x = nn.gelu(nn.Dense(HIDDEN)(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.zeros)(x)  # at first it knows the mean alone


def linear(codes: np.ndarray, wanted: np.ndarray, others: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Ridge regression, its ridge the one that does best on the groups (N,) kept out."""
    x, y, z, back = _scaled(codes, wanted, others)
    kept_out = _kept_out(groups)
    errors = [np.mean((x[kept_out] @ _solved(x[~kept_out], y[~kept_out], r) - y[kept_out]) ** 2) for r in RIDGES]
    return back(z @ _solved(x, y, RIDGES[int(np.argmin(errors))]))


def mlp(codes: np.ndarray, wanted: np.ndarray, others: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Two hidden layers, trained by AdamW; the state that does best on the groups (N,) kept out."""
    x, y, z, back = _scaled(codes, wanted, others)
    kept_out = _kept_out(groups)
    return back(_answers(x, y, z, kept_out, False))


def gaussian(
    codes: np.ndarray, wanted: np.ndarray, others: np.ndarray, groups: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of a normal distribution, by its likelihood; the deviation is not calibrated."""
    x, y, z, back = _scaled(codes, wanted, others)
    answers = _answers(x, y, z, _kept_out(groups), True)
    mean, log_deviation = np.split(answers, 2, axis=1)
    return back(mean), np.abs(back(np.exp(log_deviation)) - back(0.0))


PROBES: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "linear": linear,
    "mlp": mlp,
}


def _scaled(
    codes: np.ndarray, wanted: np.ndarray, others: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Callable[[np.ndarray | float], np.ndarray]]:
    middle, spread = codes.mean(axis=0, dtype=np.float64), codes.std(axis=0, dtype=np.float64)
    spread = np.where(spread > LEAST, spread, 1)
    centre, reach = wanted.mean(axis=0, dtype=np.float64), wanted.std(axis=0, dtype=np.float64)
    reach = np.where(reach > LEAST, reach, 1)
    return (
        (codes - middle) / spread,
        (wanted - centre) / reach,
        (others - middle) / spread,
        lambda y: centre + reach * y,
    )


def _kept_out(groups: np.ndarray) -> np.ndarray:
    """(N,) all of every fifth group."""
    return np.unique(groups, return_inverse=True)[1].reshape(-1) % 5 == 4


def _answers(x: np.ndarray, y: np.ndarray, z: np.ndarray, kept_out: np.ndarray, gaussian: bool) -> np.ndarray:
    parts = (x[~kept_out], y[~kept_out], x[kept_out], y[kept_out], z)
    return np.asarray(_trained(*(jnp.asarray(part, jnp.float32) for part in parts), gaussian=gaussian), np.float64)


def _solved(x: np.ndarray, y: np.ndarray, ridge: float) -> np.ndarray:
    """(F, K): by the smaller of the two systems."""
    if len(x) < x.shape[1]:
        return x.T @ linalg.solve(x @ x.T + ridge * len(x) * np.eye(len(x)), y, assume_a="pos")
    return linalg.solve(x.T @ x + ridge * len(x) * np.eye(x.shape[1]), x.T @ y, assume_a="pos")


@partial(jax.jit, static_argnames="gaussian")
def _trained(
    x: jax.Array, y: jax.Array, x_out: jax.Array, y_out: jax.Array, others: jax.Array, gaussian: bool
) -> jax.Array:
    """What the network, trained on (x, y), says of `others`: (M, K), or (M, 2 K), mean and the deviation's logarithm."""
    net = MLP(y.shape[1] * (2 if gaussian else 1))
    key = jax.random.key(0)
    params: VariableDict = net.init(key, x[:1])
    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, STEPS), weight_decay=DECAY)

    def says(params: VariableDict, x: jax.Array) -> jax.Array:
        answer = jnp.asarray(net.apply(params, x))
        if not gaussian:
            return answer
        mean, log_deviation = jnp.split(answer, 2, axis=-1)
        return jnp.concatenate([mean, jnp.clip(log_deviation, *LOG_DEVIATIONS)], -1)

    def error(params: VariableDict, x: jax.Array, y: jax.Array) -> jax.Array:
        if not gaussian:
            return jnp.mean((says(params, x) - y) ** 2)
        mean, log_deviation = jnp.split(says(params, x), 2, axis=-1)
        return jnp.mean(0.5 * ((y - mean) / jnp.exp(log_deviation)) ** 2 + log_deviation)

    def loss(params: VariableDict, rows: jax.Array) -> jax.Array:
        return error(params, x[rows], y[rows])

    def step(state: _State, step_key: jax.Array) -> tuple[_State, None]:
        params, opt_state = state
        rows = jax.random.randint(step_key, (min(BATCH, len(x)),), 0, len(x))
        updates, opt_state = optimiser.update(jax.grad(loss)(params, rows), opt_state, params)
        return (optax.apply_updates(params, updates), opt_state), None

    def check(
        carry: tuple[_State, jax.Array, VariableDict], keys: jax.Array
    ) -> tuple[tuple[_State, jax.Array, VariableDict], None]:
        state, best, chosen = carry
        state, _ = jax.lax.scan(step, state, keys)
        off = error(state[0], x_out, y_out)
        chosen = jax.tree.map(partial(jnp.where, off < best), state[0], chosen)
        return (state, jnp.minimum(off, best), chosen), None

    keys = jax.random.split(jax.random.fold_in(key, 1), (CHECKS, STEPS // CHECKS))
    carry = ((params, optimiser.init(params)), error(params, x_out, y_out), params)
    (_, _, chosen), _ = jax.lax.scan(check, carry, keys)
    return says(chosen, others)
