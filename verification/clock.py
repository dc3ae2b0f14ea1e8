"""Wall-clock time, and the time of a matrix product as a yardstick.

The product is timed in the same minutes, so that figures of other machines and loads compare.

    product = make_matrix_product()
    laps = time_repeats(work, product, repeats=5)  # work: a function without arguments
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
        """The ratio of the medians."""
        return float(np.median(self.work) / np.median(self.product))


def make_matrix_product() -> Callable[[], None]:
    """Make a 2048 x 2048 float32 product on JAX' device, compiled and warm."""
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
    """Time `repeats` of the work, or fewer once `budget_s` is spent.

    After each, the median of three matrix products is taken.
    """
    work_s: list[float] = []
    product_s: list[float] = []
    while len(work_s) < max(repeats, 1) and (not work_s or sum(work_s) < budget_s):
        work_s.append(time_call(work))
        product_s.append(float(np.median([time_call(product) for _ in range(3)])))
    return Laps(np.array(work_s), np.array(product_s))
