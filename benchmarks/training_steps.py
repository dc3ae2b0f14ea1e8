"""Makes trainings to be timed: step, first state and inputs."""

from collections.abc import Callable

import jax
import numpy as np

from jaxunshear.config.training import Training
from jaxunshear.models.weights import Variables
from jaxunshear.training.step import State, make_optimiser, make_step
from jaxunshear.training.tasks import Batch, Task
from jaxunshear.training.trainer import get_compile_options, jit_first_state


def init_variables(init: Callable[[jax.Array], Variables], seed: int = 0) -> Variables:
    """Initialise the variables of a network."""
    return jax.jit(init, compiler_options=get_compile_options())(jax.random.key(seed))


def make_timed_step(
    task: Task, training: Training
) -> tuple[Callable[[State, Batch], tuple[State, dict[str, jax.Array]]], State]:
    """Make a training step, not yet compiled, and the state before the first step."""
    optimiser = make_optimiser(training, 1000, 100)
    step = make_step(task, training, optimiser, jax.random.key(1))
    return step, jit_first_state(task, optimiser)(jax.random.key(0))


def make_noise_images(images: int, size: int) -> np.ndarray:
    """Make noise instead of taps and slides, (2, images, size, size, 1) uint8 of {0, 255}."""
    return 255 * np.random.default_rng(0).integers(0, 2, (2, images, size, size, 1), np.uint8)
