"""Wall-clock time, and the time of a matrix product in the same minutes: a yardstick that other machines and other loads share.

product = make_matrix_product()
spent = time_repeats(work, product, repeats=5)          # work: a function without arguments
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

SIZE = 2048  # of the product, float32


class Laps(NamedTuple):
    """Seconds: of each repeat of a piece of work, and of the matrix product timed after each."""

    work: np.ndarray  # (R,)
    product: np.ndarray  # (R,)

    @property
    def ratio(self) -> float:
        """Of the medians."""
        return float(np.median(self.work) / np.median(self.product))


def make_matrix_product() -> Callable[[], None]:
    """A 2048 x 2048 float32 product on JAX' device, compiled and warm."""
    left = jnp.asarray(np.random.default_rng(0).random((SIZE, SIZE)), jnp.float32)
    run = jax.jit(lambda a, b: a @ b)

    def product() -> None:
        run(left, left).block_until_ready()

    product()
    return product


def time_call(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def time_repeats(
    work: Callable[[], object], product: Callable[[], None], repeats: int, budget_s: float = np.inf
) -> Laps:
    """`repeats` of the work, or fewer once `budget_s` is spent; after each, the median of three matrix products."""
    spent: list[float] = []
    yard: list[float] = []
    while len(spent) < max(repeats, 1) and (not spent or sum(spent) < budget_s):
        spent.append(time_call(work))
        yard.append(float(np.median([time_call(product) for _ in range(3)])))
    return Laps(np.array(spent), np.array(yard))
