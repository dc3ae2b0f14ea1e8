"""The dome's elasticity, and that part of it which a batch of contacts solves with. Side effect: the dome's cache."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import get_lapack_funcs
from threadpoolctl import threadpool_limits

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator import dome as domes
from jaxunshear.simulator.elasticity import Compliance
from jaxunshear.simulator.friction import RHO, System
from jaxunshear.simulator.scheduler import NODE_COUNTS, pad_count


@lru_cache(maxsize=4)
def load_shared_dome(sensor: Sensor) -> Compliance:
    """The sensor's dome, kept in memory."""
    return domes.load_dome(sensor)


@lru_cache(maxsize=4)
def build_matrices(sensor: Sensor, precision: str) -> tuple[np.ndarray, np.ndarray]:
    """w of the dome, scaled to a unit mean diagonal, and g transposed, in one precision."""
    full = load_shared_dome(sensor)
    scaled = (full.w / (np.trace(full.w) / len(full.w))).astype(precision)
    return scaled, np.ascontiguousarray(full.g.T.astype(precision))


@lru_cache(maxsize=16)
def build_system(
    sensor: Sensor, node_bytes: bytes, friction: bool, precision: str
) -> tuple[System, float]:
    """The contact nodes `node_bytes` (int64 bytes), padded by nodes far from any stimulus; newtons per scaled force."""
    full = load_shared_dome(sensor)
    index = np.frombuffer(node_bytes, np.int64)
    size = pad_count(len(index), NODE_COUNTS)
    parts = np.arange(3) if friction else np.array([2])
    rows, all_rows = (
        (3 * index[:, None] + parts).ravel(),
        (3 * index[:, None] + np.arange(3)).ravel(),
    )
    found, count = len(rows), len(parts) * size
    matrix, _ = build_matrices(sensor, precision)
    scale = np.trace(full.w) / len(full.w)
    w = np.zeros((count, count), precision)
    w[:found, :found] = matrix.take(rows, 0).take(rows, 1)
    w[np.arange(found, count), np.arange(found, count)] = 1
    inverse = w.copy()
    inverse[np.diag_indices(count)] += RHO
    spread = np.zeros((count, 0 if friction else 3 * size), precision)
    if not friction:
        spread[:found, : len(all_rows)] = matrix[np.ix_(rows, all_rows)]
    nodes = np.full((size, 3), 1e3)
    nodes[: len(index)] = full.nodes[index]
    as_array = partial(jnp.asarray, dtype=precision)
    shared = as_array(w)
    system = System(
        shared,
        _both_halves(as_array(_inverse(inverse))),
        shared if friction else as_array(spread),
        as_array(nodes),
        as_array(sensor.dome_radius_mm),
    )
    return system, 1 / scale


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """The upper triangle of a positive definite matrix' inverse, in its precision: the condition is that of W over RHO.

    Overwrites the matrix. On one thread: two BLAS threads on a busy machine wait for each other a hundred times longer than
    they work.
    """
    factorise, invert = get_lapack_funcs(("potrf", "potri"), dtype=matrix.dtype)
    with threadpool_limits(1, "blas"):
        lower, _ = factorise(matrix.T, lower=True, clean=True, overwrite_a=True)
        return invert(lower, lower=True, overwrite_c=True)[0].T


@jax.jit
def _both_halves(upper: jax.Array) -> jax.Array:
    return jnp.triu(upper) + jnp.triu(upper, 1).T
