"""Estimate one quantity from a code by probes: regressors of several families.

>>> task = prepare_task(codes, quantity, test_codes, groups)   # (N, F), (N, K), (M, F), (N,)
>>> estimates = task.unscale(FAMILIES["kernel ridge"](task))   # (M, K)
>>> mean, deviation = fit_gaussian(task)                       # with its uncertainty

A code can hide a quantity in directions of small variance, so probes see whitened codes. A quantity
that no family finds may still be there: report the strongest family, and compare it with what the
same families find in the network's input.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

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

from jaxunshear.evaluation.pose_estimators import MAX_SEARCH_EXAMPLES, fit_ridge
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
Choice = TypeVar("Choice", int, float)


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


def compute_r2(squares: Float[np.ndarray, "*N"], scatter: Float[np.ndarray, "*N"]) -> float:
    """Compute R2 = 1 - SSE / SST from squared errors and squared distances from the mean.

    NaN if nothing varies.
    """
    total = float(np.sum(scatter, dtype=np.float64))
    return 1 - float(np.sum(squares, dtype=np.float64)) / total if total > 0 else float("nan")


class MLP(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(LAYERS):
            x = nn.gelu(nn.Dense(HIDDEN)(x))
        # zeros: an untrained network predicts the mean
        return nn.Dense(self.outputs, kernel_init=nn.initializers.zeros)(x)


class ProbeTask(NamedTuple):
    """Codes of training and test slides, and one quantity to estimate from them.

    Codes are whitened and quantities standardised; `prepare_task` makes both.
    """

    x: np.ndarray  # (N, D)
    y: np.ndarray  # (N, K)
    test_x: np.ndarray  # (M, D)
    held_out: np.ndarray  # (N,) bool: examples that choose among fits
    raw_codes: np.ndarray  # (N, F)
    raw_test_codes: np.ndarray  # (M, F)
    centre: np.ndarray  # (K,)
    spread: np.ndarray  # (K,)

    def unscale(self, y: np.ndarray) -> np.ndarray:
        return self.centre + self.spread * y


def prepare_task(
    codes: Codes,
    targets: Float[np.ndarray, "N K"],
    test_codes: Float[np.ndarray, "M F"],
    groups: Int[np.ndarray, "N"],
) -> ProbeTask:
    """Prepare the estimation of `targets`; every fifth group is held out."""
    whitening = fit_whitening(codes)
    centre = targets.mean(axis=0, dtype=np.float64)
    spread = targets.std(axis=0, dtype=np.float64)
    spread = np.where(spread > MIN_SPREAD, spread, 1)
    return ProbeTask(
        whitening.apply(codes),
        (targets - centre) / spread,
        whitening.apply(test_codes),
        np.unique(groups, return_inverse=True)[1].reshape(-1) % 5 == 4,
        np.asarray(codes, np.float64),
        test_codes,
        centre,
        spread,
    )


def fit_linear(task: ProbeTask) -> np.ndarray:
    """Predict by ridge regression; held-out groups choose the ridge, times the examples."""

    def make_model(ridge: float, examples: int) -> Ridge:
        return Ridge(ridge * examples, fit_intercept=False)

    return _predict_by_best(task, RIDGES, make_model)


def fit_neighbours(task: ProbeTask) -> np.ndarray:
    """Predict by the mean of the nearest codes; held-out groups choose how many."""
    most = np.count_nonzero(~task.held_out)
    counts = [count for count in NEIGHBOURS if count <= most] or [1]
    return _predict_by_best(task, counts, lambda count, _: KNeighborsRegressor(count))


def _predict_by_best(
    task: ProbeTask,
    choices: Sequence[Choice],
    make_model: Callable[[Choice, int], Ridge | KNeighborsRegressor],
) -> np.ndarray:
    """Predict by the choice that errs least on the held-out groups."""
    errors = {}
    for choice in choices:
        x, y = task.x[~task.held_out], task.y[~task.held_out]
        predicted = make_model(choice, len(x)).fit(x, y).predict(task.x[task.held_out])
        errors[choice] = _compute_error(predicted.reshape(-1, y.shape[1]), task)
    model = make_model(min(errors, key=errors.__getitem__), len(task.x))
    predicted = model.fit(task.x, task.y).predict(task.test_x)
    return predicted.reshape(len(task.test_x), -1)


def fit_kernel_ridge(task: ProbeTask) -> np.ndarray:
    """Predict by kernel ridge regression; held-out groups choose raw or whitened codes."""
    fitting = np.flatnonzero(~task.held_out)
    some = fitting[select_evenly(len(fitting), MAX_SEARCH_EXAMPLES)]
    errors = []
    for features in (task.x, task.raw_codes):
        ridge = fit_ridge(features[some], task.y[some])
        errors.append(_compute_error(ridge.predict(features[task.held_out]), task))
    if errors[1] < errors[0]:
        return fit_ridge(task.raw_codes, task.y).predict(task.raw_test_codes)
    return fit_ridge(task.x, task.y).predict(task.test_x)


def fit_trees(task: ProbeTask) -> np.ndarray:
    """Predict each column by gradient-boosted trees; held-out groups stop them early."""
    fitting, held_out = ~task.held_out, task.held_out

    def predict(column: np.ndarray) -> np.ndarray:
        trees = HistGradientBoostingRegressor(max_iter=TREES, early_stopping=True, random_state=0)
        held = {"X_val": task.x[held_out], "y_val": column[held_out]}
        return trees.fit(task.x[fitting], column[fitting], **held).predict(task.test_x)

    # threads that wait for each other on busy cores take many times as long
    with threadpool_limits(1, "openmp"):
        return np.stack([predict(column) for column in task.y.T], axis=-1)


def fit_mlp(task: ProbeTask, gaussian: bool = False) -> np.ndarray:
    """Predict by a network with two hidden layers; held-out groups stop its training early.

    A `gaussian` network predicts mean and log deviation (M, 2 K).
    """
    fitting, held_out = ~task.held_out, task.held_out
    parts = (task.x[fitting], task.y[fitting], task.x[held_out], task.y[held_out], task.test_x)
    arrays = [jnp.asarray(part, jnp.float32) for part in parts]
    return np.asarray(_train_mlp(*arrays, gaussian=gaussian), np.float64)


FAMILIES: dict[str, Callable[[ProbeTask], np.ndarray]] = {  # -> standardised quantity (M, K)
    "linear": fit_linear,
    "kernel ridge": fit_kernel_ridge,
    "mlp": fit_mlp,
    "trees": fit_trees,
    "neighbours": fit_neighbours,
}


def fit_gaussian(task: ProbeTask) -> tuple[np.ndarray, np.ndarray]:
    """Predict mean and standard deviation (M, K) by an MLP that maximises a normal likelihood.

    The deviation is not calibrated.
    """
    mean, log_deviation = np.split(fit_mlp(task, gaussian=True), 2, axis=1)
    return task.unscale(mean), np.exp(log_deviation) * task.spread


def _compute_error(predicted: np.ndarray, task: ProbeTask) -> float:
    return float(np.mean((predicted - task.y[task.held_out]) ** 2))


class _Best(NamedTuple):
    """State of a training, with the parameters that did best on the held-out groups."""

    state: _State
    error: jax.Array
    params: VariableDict


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
