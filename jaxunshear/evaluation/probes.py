"""Estimate one quantity from a code by probes: regressors of several families.

>>> probe = FAMILIES["kernel ridge"]
>>> estimates = probe(codes, quantity, others, groups)         # (N, F), (N, K), (M, F) -> (M, K)
>>> mean, deviation = fit_gaussian(codes, quantity, others, groups)  # with its uncertainty

A code can hide a quantity in directions of small variance, so probes see whitened codes. A quantity
that no family finds may still be there: report the strongest family, and compare it with what the
same families find in the network's input.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.typing import VariableDict
from jaxtyping import Float, Int
from sklearn.decomposition import PCA
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.linear_model import Ridge
from sklearn.neighbors import KNeighborsRegressor
from threadpoolctl import threadpool_limits

from jaxunshear.evaluation import kernel_ridge
from jaxunshear.selection import select_evenly

HIDDEN, LAYERS = 128, 2
STEPS, BATCH, RATE, DECAY = 1000, 128, 2e-3, 1e-3
CHECKS = 20  # how often the held-out groups choose among the states of a training
RIDGES = (1e-6, 1e-4, 1e-2, 1.0)  # times the number of examples
NEIGHBOURS = (5, 10, 20, 40, 80, 160)
TREES = 300
LOG_DEVIATIONS = (-6.0, 2.0)  # least and most, of what is scaled to a deviation of one
MIN_SPREAD = 1e-12  # spread of a number that does not vary
NOISE_FLOOR = 1e-5  # of the widest direction's deviation: below it lies the rounding of float32
MAX_DIRECTIONS = 256
_State = tuple[VariableDict, optax.OptState]
Codes = Float[np.ndarray, "N F"]
Probe = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Whitening(NamedTuple):
    """Principal directions of a code, each scaled to a deviation of one."""

    mean: np.ndarray  # (F,)
    directions: np.ndarray  # (F, D)

    def apply(self, codes: Codes) -> Float[np.ndarray, "N D"]:
        return (codes - self.mean) @ self.directions


def fit_whitening(codes: Codes) -> Whitening:
    """Compute the whitening of the codes' widest principal directions, MAX_DIRECTIONS at most."""
    codes = np.asarray(codes, np.float64)
    pca = PCA(min(MAX_DIRECTIONS, *codes.shape), random_state=0).fit(codes)
    deviations = np.sqrt(pca.explained_variance_)
    varied = deviations > max(MIN_SPREAD, NOISE_FLOOR * deviations[0])
    return Whitening(pca.mean_, (pca.components_[varied] / deviations[varied, None]).T)


class MLP(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(LAYERS):
            x = nn.gelu(nn.Dense(HIDDEN)(x))
        # zeros: an untrained network predicts the mean
        return nn.Dense(self.outputs, kernel_init=nn.initializers.zeros)(x)


def fit_linear(
    codes: Codes, targets: np.ndarray, test_codes: Codes, groups: np.ndarray
) -> np.ndarray:
    """Predict by ridge regression; held-out groups choose the ridge."""
    data = _prepare(codes, targets, test_codes, groups)
    fitting, held_out = ~data.held_out, data.held_out

    def predict(ridge: float, x: np.ndarray, y: np.ndarray, others: np.ndarray) -> np.ndarray:
        model = Ridge(ridge * len(x), fit_intercept=False).fit(x, y)
        return model.predict(others).reshape(len(others), -1)

    def compute_error(ridge: float) -> float:
        predicted = predict(ridge, data.x[fitting], data.y[fitting], data.x[held_out])
        return float(np.mean((predicted - data.y[held_out]) ** 2))

    best = min(RIDGES, key=compute_error)
    return data.unscale(predict(best, data.x, data.y, data.others))


def fit_kernel_ridge(
    codes: Codes, targets: np.ndarray, test_codes: Codes, groups: np.ndarray
) -> np.ndarray:
    """Predict by kernel ridge regression; held-out groups choose raw or whitened codes."""
    data = _prepare(codes, targets, test_codes, groups)
    choices = ((data.x, data.others), (np.asarray(codes, np.float64), test_codes))
    fitting, held_out = np.flatnonzero(~data.held_out), data.held_out
    some = fitting[select_evenly(len(fitting), kernel_ridge.MAX_SEARCH_EXAMPLES)]

    def compute_error(choice: tuple[np.ndarray, np.ndarray]) -> float:
        features, _ = choice
        ridge = kernel_ridge.fit(features[some], data.y[some])
        predicted = kernel_ridge.predict(ridge, features[held_out])
        return float(np.mean((predicted - data.y[held_out]) ** 2))

    features, test_features = min(choices, key=compute_error)
    return data.unscale(kernel_ridge.predict(kernel_ridge.fit(features, data.y), test_features))


def fit_mlp(codes: Codes, targets: np.ndarray, test_codes: Codes, groups: np.ndarray) -> np.ndarray:
    """Predict by a network with two hidden layers; held-out groups stop its training early."""
    data = _prepare(codes, targets, test_codes, groups)
    return data.unscale(_train(data, gaussian=False))


def fit_trees(
    codes: Codes, targets: np.ndarray, test_codes: Codes, groups: np.ndarray
) -> np.ndarray:
    """Predict each column by gradient-boosted trees; held-out groups stop them early."""
    data = _prepare(codes, targets, test_codes, groups)
    # threads that wait for each other on busy cores take many times as long
    with threadpool_limits(1, "openmp"):
        columns = [_fit_forest(data, column) for column in data.y.T]
    return data.unscale(np.stack(columns, axis=-1))


def fit_neighbours(
    codes: Codes, targets: np.ndarray, test_codes: Codes, groups: np.ndarray
) -> np.ndarray:
    """Predict by the mean of the nearest codes; held-out groups choose how many."""
    data = _prepare(codes, targets, test_codes, groups)
    fitting, held_out = ~data.held_out, data.held_out

    def compute_error(count: int) -> float:
        nearest = KNeighborsRegressor(count).fit(data.x[fitting], data.y[fitting])
        return float(np.mean((nearest.predict(data.x[held_out]) - data.y[held_out]) ** 2))

    possible = [count for count in NEIGHBOURS if count <= np.count_nonzero(fitting)]
    best = min(possible or [1], key=compute_error)
    return data.unscale(KNeighborsRegressor(best).fit(data.x, data.y).predict(data.others))


FAMILIES: dict[str, Probe] = {
    "linear": fit_linear,
    "kernel ridge": fit_kernel_ridge,
    "mlp": fit_mlp,
    "trees": fit_trees,
    "neighbours": fit_neighbours,
}


def fit_gaussian(
    codes: Codes, targets: np.ndarray, test_codes: Codes, groups: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Predict mean and standard deviation by an MLP that is trained by a normal likelihood.

    The deviation is not calibrated.
    """
    data = _prepare(codes, targets, test_codes, groups)
    mean, log_deviation = np.split(_train(data, gaussian=True), 2, axis=1)
    return data.unscale(mean), np.exp(log_deviation) * data.spread


def _fit_forest(data: "_Data", column: np.ndarray) -> np.ndarray:
    """Predict one column: (N,) -> (M,)."""
    fitting, held = ~data.held_out, data.held_out
    trees = HistGradientBoostingRegressor(max_iter=TREES, early_stopping=True, random_state=0)
    trees.fit(data.x[fitting], column[fitting], X_val=data.x[held], y_val=column[held])
    return trees.predict(data.others)


class _Best(NamedTuple):
    """State of a training, with the parameters that did best on the held-out groups."""

    state: _State
    error: jax.Array
    params: VariableDict


class _Data(NamedTuple):
    """Whitened codes and standardised quantities."""

    x: np.ndarray  # (N, D)
    y: np.ndarray  # (N, K)
    others: np.ndarray  # (M, D)
    held_out: np.ndarray  # (N,) bool
    centre: np.ndarray  # (K,)
    spread: np.ndarray  # (K,)

    def unscale(self, y: np.ndarray) -> np.ndarray:
        return self.centre + self.spread * y


def _prepare(
    codes: Codes, targets: np.ndarray, others: Codes, groups: Int[np.ndarray, "N"]
) -> _Data:
    whitening = fit_whitening(codes)
    centre = targets.mean(axis=0, dtype=np.float64)
    spread = targets.std(axis=0, dtype=np.float64)
    spread = np.where(spread > MIN_SPREAD, spread, 1)
    x, z = whitening.apply(codes), whitening.apply(others)
    return _Data(x, (targets - centre) / spread, z, mark_held_out(groups), centre, spread)


def mark_held_out(groups: Int[np.ndarray, "N"]) -> np.ndarray:
    """Mark the examples (N,) of every fifth group."""
    return np.unique(groups, return_inverse=True)[1].reshape(-1) % 5 == 4


def _train(data: _Data, gaussian: bool) -> np.ndarray:
    fitting, held = ~data.held_out, data.held_out
    parts = (data.x[fitting], data.y[fitting], data.x[held], data.y[held], data.others)
    arrays = [jnp.asarray(part, jnp.float32) for part in parts]
    return np.asarray(_train_mlp(*arrays, gaussian=gaussian), np.float64)


@partial(jax.jit, static_argnames="gaussian")
def _train_mlp(
    x: jax.Array,
    y: jax.Array,
    x_held: jax.Array,
    y_held: jax.Array,
    others: jax.Array,
    gaussian: bool,
) -> jax.Array:
    """Train on (x, y) and predict for `others`: (M, K), or mean and log deviation (M, 2 K)."""
    net = MLP(y.shape[1] * (2 if gaussian else 1))
    key = jax.random.key(0)
    params: VariableDict = net.init(key, x[:1])
    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, STEPS), weight_decay=DECAY)

    def predict(params: VariableDict, x: jax.Array) -> jax.Array:
        outputs = jnp.asarray(net.apply(params, x))
        if not gaussian:
            return outputs
        mean, log_deviation = jnp.split(outputs, 2, axis=-1)
        return jnp.concatenate([mean, jnp.clip(log_deviation, *LOG_DEVIATIONS)], -1)

    def error(params: VariableDict, x: jax.Array, y: jax.Array) -> jax.Array:
        if not gaussian:
            return jnp.mean((predict(params, x) - y) ** 2)
        mean, log_deviation = jnp.split(predict(params, x), 2, axis=-1)
        return jnp.mean(0.5 * ((y - mean) / jnp.exp(log_deviation)) ** 2 + log_deviation)

    def loss(params: VariableDict, rows: jax.Array) -> jax.Array:
        return error(params, x[rows], y[rows])

    def step(state: _State, step_key: jax.Array) -> tuple[_State, None]:
        params, opt_state = state
        rows = jax.random.randint(step_key, (min(BATCH, len(x)),), 0, len(x))
        updates, opt_state = optimiser.update(jax.grad(loss)(params, rows), opt_state, params)
        return (optax.apply_updates(params, updates), opt_state), None

    def check(carry: _Best, keys: jax.Array) -> tuple[_Best, None]:
        state, _ = jax.lax.scan(step, carry.state, keys)
        held_error = error(state[0], x_held, y_held)
        better = held_error < carry.error
        params = jax.tree.map(partial(jnp.where, better), state[0], carry.params)
        return _Best(state, jnp.minimum(held_error, carry.error), params), None

    keys = jax.random.split(jax.random.fold_in(key, 1), (CHECKS, STEPS // CHECKS))
    start = _Best((params, optimiser.init(params)), error(params, x_held, y_held), params)
    best, _ = jax.lax.scan(check, start, keys)
    return predict(best.params, others)
