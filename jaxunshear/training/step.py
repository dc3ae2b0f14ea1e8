"""The training step as a pure function: gradient, optimiser, statistics and moving averages.

Muon (Jordan et al. 2024) brings all singular values of the momentum near one. Adam scales every
weight alone; Muon turns the entire update of a kernel towards an orthogonal matrix, so that what
has a weak gradient is learnt as fast as what has a strong one.

The momentum is Jordan's. `optax.contrib.muon` corrects it for its start, which turns the second
update by 8 % and the thirtieth by less than half a per cent; all else is equal to rounding. Its
iteration multiplies the tall matrix of a convolution ten times per step, which takes longer than
the step itself. Here all but two products are between square matrices of the shorter side.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float, Int

from jaxunshear.config.training import Training
from jaxunshear.models.weights import Variables, list_leaves
from jaxunshear.training.tasks import Batch, Task, Tree

# of Jordan's quintic: steep at zero, and between 0.7 and 1.2 after all iterations
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
# of an update at learning rate 1, near Adam's, so that both take the same rates
# (Liu et al. 2025, section 2.2)
RMS = 0.2
MAX_READOUT_WIDTH = 8  # kernels with fewer outputs


class State(NamedTuple):
    """The arrays that a step changes."""

    step: Int[Array, ""]
    params: Tree
    batch_stats: Tree
    optimiser: Tree
    # moving averages of params and batch_stats: the variables that are validated, kept and used
    average: dict[str, Tree]


def make_schedule(training: Training, steps: int, steps_per_epoch: float) -> optax.Schedule:
    """Make the schedule, step -> learning rate."""
    first = training.learning_rate
    if training.schedule == "cosine":
        return optax.cosine_decay_schedule(first, steps)
    factors = (1.0, *(factor for _, factor in training.drops))
    return optax.join_schedules(
        [optax.constant_schedule(first * factor) for factor in factors],
        [epoch * steps_per_epoch for epoch, _ in training.drops],  # may lie between two steps
    )


def make_optimiser(
    training: Training, steps: int, steps_per_epoch: float
) -> optax.GradientTransformation:
    """Make Adam or Muon with the schedule of `training`."""
    make = {"adam": optax.adam, "muon": muon}[training.optimiser]
    schedule = make_schedule(training, steps, steps_per_epoch)
    return make(schedule, training.beta1, training.beta2)


def init_state(variables: Tree, optimiser: optax.GradientTransformation) -> State:
    """Make the state before the first step."""
    params, batch_stats = variables["params"], variables["batch_stats"]
    average = {"params": params, "batch_stats": batch_stats}
    return State(jnp.zeros((), jnp.int32), params, batch_stats, optimiser.init(params), average)


def make_step(
    task: Task, training: Training, optimiser: optax.GradientTransformation, key: Array
) -> Callable[[State, Batch], tuple[State, dict[str, Array]]]:
    """Make the step: (state, batch) -> (state, metrics).

    The metrics are mean terms, regularisation and gradient norm by name.
    """

    def compute_loss(
        params: Tree, batch_stats: Tree, batch: Batch, step_key: Array
    ) -> tuple[Array, tuple[dict[str, Array], Tree]]:
        terms, batch_stats = task.terms(
            {"params": params, "batch_stats": batch_stats}, batch, step_key
        )
        metrics = {name: jnp.mean(values) for name, values in terms.items()}
        kernels = compute_regularisation(params, training.l1, training.l2, training.kernels)
        total = kernels + sum(task.weights[name] * value for name, value in metrics.items())
        return total, (metrics | {"regularisation": kernels}, batch_stats)

    def step(state: State, batch: Batch) -> tuple[State, dict[str, Float[Array, ""]]]:
        step_key = jax.random.fold_in(key, state.step)
        compute_gradient = jax.grad(compute_loss, has_aux=True)
        gradient, (metrics, batch_stats) = compute_gradient(
            state.params, state.batch_stats, batch, step_key
        )
        updates, moments = optimiser.update(gradient, state.optimiser, state.params)
        params = optax.apply_updates(state.params, updates)
        # averages start short, else the first weights would linger in them
        decay = jnp.minimum(training.averaging, (1.0 + state.step) / (10.0 + state.step))
        new = {"params": params, "batch_stats": batch_stats}
        average = jax.tree.map(lambda old, now: decay * old + (1 - decay) * now, state.average, new)
        metrics["gradient"] = optax.tree.norm(gradient)
        return State(state.step + 1, params, batch_stats, moments, average), metrics

    return step


def compute_regularisation(
    params: Variables, l1: float, l2: float, kernels: str = "sum"
) -> Float[Array, ""]:
    """Compute l1 sum |w| + l2 sum w^2 of each kernel, and add these up.

    With `kernels` "mean" the sums over a kernel are means. Biases and normalisation are left out. A
    weight of zero computes nothing.
    """
    reduce = {"sum": jnp.sum, "mean": jnp.mean}[kernels]
    total = jnp.zeros(())
    for kernel in list_kernels(params).values():
        total += l1 * reduce(jnp.abs(kernel)) if l1 else 0.0
        total += l2 * reduce(kernel**2) if l2 else 0.0
    return total


def measure_kernel_sizes(params: Variables) -> dict[str, Float[Array, ""]]:
    """Measure the root mean square of each kernel, by dotted name: 0.02 in fresh networks."""
    return {name: jnp.sqrt(jnp.mean(kernel**2)) for name, kernel in list_kernels(params).items()}


def list_kernels(params: Variables) -> dict[str, Array]:
    """List the kernels of convolution and dense layers, by dotted name."""
    return {
        name.removesuffix(".kernel"): leaf
        for name, leaf in list_leaves(params).items()
        if name.endswith(".kernel")
    }


def muon(
    learning_rate: optax.ScalarOrSchedule, beta1: float, beta2: float
) -> optax.GradientTransformation:
    """Make Muon for the inner kernels, and Adam for all other weights, as is usual.

    These are the kernels of the first and the last layer, biases and normalisation.
    """
    inner = optax.chain(
        optax.trace(MOMENTUM, nesterov=True),
        optax.stateless(lambda updates, _: jax.tree.map(_orthogonalise_kernel, updates)),
        optax.scale_by_learning_rate(learning_rate),
    )
    return optax.partition(
        {"muon": inner, "adam": optax.adam(learning_rate, beta1, beta2)}, _label_weights
    )


def orthogonalise(x: Array) -> Array:
    """Compute U f(S) V' of x = U S V' (m, n), with f near one for all but tiny singular values.

    This is a Newton-Schulz iteration. It maps x to x P with a polynomial P of x'x, so the
    iterations run on (n, n) alone and x is multiplied once.
    """
    if x.shape[0] < x.shape[1]:
        return orthogonalise(x.T).T
    x = x / (jnp.linalg.norm(x) + 1e-8)
    gram = _product(x.T, x)
    factors = jnp.eye(len(gram), dtype=x.dtype)
    a, b, c = COEFFICIENTS
    for iteration in range(ITERATIONS):
        factor = a * jnp.eye(len(gram), dtype=x.dtype) + b * gram + c * _product(gram, gram)
        factors = _product(factors, factor) if iteration else factor
        if iteration < ITERATIONS - 1:
            gram = _product(factor, _product(gram, factor))
    return _product(x, factors)


def _orthogonalise_kernel(kernel: Array) -> Array:
    """Orthogonalise the update of a convolution (k, k, C, N) or a dense layer (C, N).

    The rows of its matrix are all inputs of an output.
    """
    matrix = kernel.reshape(-1, kernel.shape[-1])
    return RMS * max(matrix.shape) ** 0.5 * orthogonalise(matrix).reshape(kernel.shape)


def _label_weights(params: Variables) -> Variables:
    def label(path: tuple, leaf: Array) -> str:
        if path[-1].key != "kernel":
            return "adam"
        is_inner = leaf.shape[-2] > 1 and leaf.shape[-1] >= MAX_READOUT_WIDTH
        return "muon" if is_inner else "adam"

    return jax.tree_util.tree_map_with_path(label, params)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")
