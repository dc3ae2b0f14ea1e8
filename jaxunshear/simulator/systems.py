"""The dome's elasticity, and the part of it that a batch of contacts solves with.

Side effect: loading a dome writes the dome's cache.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import get_lapack_funcs
from threadpoolctl import threadpool_limits

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator import dome as domes
from jaxunshear.simulator.admm import RHO
from jaxunshear.simulator.contact_problem import System
from jaxunshear.simulator.elasticity import Compliance
from jaxunshear.simulator.scheduler import NODE_COUNTS, pad_count

FAR_MM = 1e3  # where padding nodes stand: no stimulus reaches them


class ScaledMatrices(NamedTuple):
    """A dome's compliance in one precision."""

    w: np.ndarray  # (3N, 3N) scaled to a unit mean diagonal
    g_transposed: np.ndarray  # (3N, 3P) mm/N


class ScaledSystem(NamedTuple):
    system: System
    newtons: float  # per unit of scaled force


@lru_cache(maxsize=4)
def load_shared_dome(sensor: Sensor) -> Compliance:
    """Load the sensor's dome and keep it in memory."""
    return domes.load_dome(sensor)


@lru_cache(maxsize=4)
def build_matrices(sensor: Sensor, precision: str) -> ScaledMatrices:
    """Convert the dome's compliance to one precision."""
    full = load_shared_dome(sensor)
    scaled = (full.w / (np.trace(full.w) / len(full.w))).astype(precision)
    return ScaledMatrices(scaled, np.ascontiguousarray(full.g.T.astype(precision)))


@lru_cache(maxsize=16)
def build_system(sensor: Sensor, node_bytes: bytes, friction: bool, precision: str) -> ScaledSystem:
    """Build the system of contact nodes (int64, as bytes), padded by nodes far away."""
    full = load_shared_dome(sensor)
    index = np.frombuffer(node_bytes, np.int64)
    size = pad_count(len(index), NODE_COUNTS)
    directions = np.arange(3) if friction else np.array([2])
    rows = (3 * index[:, None] + directions).ravel()
    all_rows = (3 * index[:, None] + np.arange(3)).ravel()
    used, count = len(rows), len(directions) * size
    matrix = build_matrices(sensor, precision).w
    scale = np.trace(full.w) / len(full.w)
    w = np.zeros((count, count), precision)
    w[:used, :used] = matrix.take(rows, 0).take(rows, 1)
    w[np.arange(used, count), np.arange(used, count)] = 1
    inverse = w.copy()
    inverse[np.diag_indices(count)] += RHO
    spread = np.zeros((count, 0 if friction else 3 * size), precision)
    if not friction:
        spread[:used, : len(all_rows)] = matrix[np.ix_(rows, all_rows)]
    nodes = np.full((size, 3), FAR_MM)
    nodes[: len(index)] = full.nodes[index]
    as_array = partial(jnp.asarray, dtype=precision)
    shared_w = as_array(w)
    system = System(
        shared_w,
        _mirror_triangle(as_array(_invert(inverse))),
        shared_w if friction else as_array(spread),
        as_array(nodes),
        as_array(sensor.dome_radius_mm),
    )
    return ScaledSystem(system, 1 / scale)


def _invert(matrix: np.ndarray) -> np.ndarray:
    """Compute the upper triangle of a positive definite matrix' inverse, in its precision.

    Overwrites the matrix. It runs on one thread: two BLAS threads on a busy machine wait for each
    other a hundred times longer than they work.
    """
    factorise, invert = get_lapack_funcs(("potrf", "potri"), dtype=matrix.dtype)
    with threadpool_limits(1, "blas"):
        lower, _ = factorise(matrix.T, lower=True, clean=True, overwrite_a=True)
        return invert(lower, lower=True, overwrite_c=True)[0].T


@jax.jit
def _mirror_triangle(upper: jax.Array) -> jax.Array:
    return jnp.triu(upper) + jnp.triu(upper, 1).T
