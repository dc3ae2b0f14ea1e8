"""The training step as a pure function: gradient, optimiser, statistics and moving averages."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float, Int

from jaxunshear.config.training import Training
from jaxunshear.models.weights import Variables, list_leaves
from jaxunshear.training.muon import muon
from jaxunshear.training.tasks import Batch, Task, Tree


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
    if not training.drops:
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
    return make(schedule, training.beta1)


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
        decay = jnp.minimum(training.ema_decay, (1.0 + state.step) / (10.0 + state.step))
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
