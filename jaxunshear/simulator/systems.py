"""The part of a dome's compliance that a batch of contacts solves with.

The nodes of a batch lie on a lattice that is turned, scene by scene, by sixths of a turn.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import get_lapack_funcs
from threadpoolctl import threadpool_limits

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.contact_problem import RHO, System
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.scheduler import NODE_COUNTS, ContactBatch, pad_count

FAR_MM = 1e3  # where padding nodes stand: no stimulus reaches them


class ScaledMatrices(NamedTuple):
    """A dome's compliance in one precision."""

    w: np.ndarray  # (3N, 3N) scaled to a unit mean diagonal
    g_transposed: np.ndarray  # (3N, 3P) mm/N


class ScaledSystem(NamedTuple):
    system: System
    newtons: float  # per unit of scaled force


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
        as_array(sensor.pivot_mm),
        as_array(sensor.radius_mm),
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


class LatticePlacement(NamedTuple):
    """How the scenes of a batch lie on the lattice: each is turned by sixths of a turn."""

    rotation: np.ndarray  # (b, 3, 3) from the turned lattice to the sensor frame
    nodes: np.ndarray  # (b, n) the sensor's node that each node of the batch is

    def gather(self, force_n: np.ndarray) -> np.ndarray:
        """Turn forces (b, N, 3) on the sensor's nodes to forces (b, n, 3) on the batch's."""
        on_batch = np.take_along_axis(force_n, self.nodes[..., None], 1)
        return np.einsum("bji,bnj->bni", self.rotation, on_batch)

    def scatter(self, force_n: np.ndarray, nodes: int) -> np.ndarray:
        """Turn forces (b, n, 3) on the batch's nodes to forces (b, N, 3) on the sensor's."""
        on_sensor = np.zeros((len(force_n), nodes, 3))
        turned = np.einsum("bij,bnj->bni", self.rotation, force_n)
        np.put_along_axis(on_sensor, self.nodes[..., None], turned, 1)
        return on_sensor


def place_on_lattice(batch: ContactBatch, nodes: int) -> LatticePlacement:
    """Place a batch on the lattice of so many contact nodes."""
    angle = np.radians(60.0 * batch.turn)
    rotation = np.zeros((len(angle), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(angle)
    rotation[:, 1, 0] = np.sin(angle)
    rotation[:, 0, 1] = -rotation[:, 1, 0]
    rotation[:, 2, 2] = 1
    return LatticePlacement(rotation, make_sixfold_permutations(nodes)[batch.turn][:, batch.nodes])
