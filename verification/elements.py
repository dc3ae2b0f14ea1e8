"""Tests of the elements alone: the patch test, and made-up fields that measure the order.

A patch must bear a homogeneous strain exactly. Displacements are written as in `elasticity`: u_r =
U cos m theta, u_theta = V sin m theta, u_z = W cos m theta.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from jaxunshear.simulator.elasticity import (
    assemble_stiffness,
    compute_isotropic_stiffness,
    compute_lame_constants,
)
from jaxunshear.simulator.mesh import Mesh, make_dome_mesh, sample_elements
from verification.verification_rows import Row, Rows, fit_order

GROUP = "elements"
CHUNK = 4096
Array = Any  # of NumPy or of JAX
_LINE = np.sqrt(0.6) * np.array([-1, 0, 1])
_WEIGHT = np.array([5, 8, 5]) / 9
GAUSS_3 = np.stack(np.meshgrid(_LINE, _LINE, indexing="ij"), -1).reshape(-1, 2)
WEIGHT_3 = np.outer(_WEIGHT, _WEIGHT).ravel()


def make_irregular_patch(cells: int = 4, seed: int = 0) -> Mesh:
    """Make a square r, z in [0, 1] of irregular quadrilaterals with straight sides.

    Inner corners lie at random near their regular place.
    """
    line = np.linspace(0, 1, cells + 1)
    corners = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    shift = np.random.default_rng(seed).uniform(-0.25, 0.25, (cells - 1, cells - 1, 2))
    corners[1:-1, 1:-1] += shift / cells
    points: list[np.ndarray] = []
    index: dict[tuple[int, int], int] = {}

    def add_node(i: int, j: int) -> int:
        """Add the node at i, j half cells, unless it is there."""
        if (i, j) not in index:
            index[i, j] = len(points)
            ends = corners[i // 2, j // 2], corners[(i + 1) // 2, (j + 1) // 2]
            points.append((ends[0] + ends[1]) / 2)
        return index[i, j]

    around = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    elements = []
    for i, j in np.ndindex(cells, cells):
        elements.append([add_node(2 * i + a, 2 * j + b) for a, b in around])
    none = np.zeros(0, int)
    return Mesh(np.array(points), np.array(elements), np.zeros(len(elements), bool), none, none)


def run_patch_test() -> list[Row]:
    """Check that a homogeneous strain, prescribed at the boundary, holds inside to rounding."""
    mesh = make_irregular_patch()
    r, z = mesh.nodes.T
    zero = np.zeros_like(r)
    fields = {
        "stretch in z": (0, [zero, zero, z]),
        "stretch in the plane": (0, [r, zero, zero]),
        "shear of planes along x": (1, [z, -z, zero]),
        "shear along z": (1, [zero, zero, r]),
        "stretch x, shrink y": (2, [r, -r, zero]),
        "rotation": (1, [z, -z, -r]),
    }
    edge = np.any((mesh.nodes < 1e-9) | (mesh.nodes > 1 - 1e-9), axis=-1)
    materials = np.broadcast_to(compute_isotropic_stiffness(1.0, 0.49), (len(mesh.elements), 6, 6))
    stiffness = assemble_stiffness(mesh, materials)
    worst = 0.0
    for m, field in fields.values():
        exact = np.stack(field, -1)
        no_load = np.zeros(exact.size)
        solution = _solve_displacement(
            stiffness.compute_harmonic(m), np.repeat(edge, 3), exact.ravel(), no_load
        )
        worst = max(worst, np.abs(solution - exact.ravel()).max() / np.abs(exact).max())
    rows = Rows(GROUP)
    words = "patch test on distorted elements: worst of 6 homogeneous strains"
    rows.expect_zero(words, worst, 1.0, 1e-9)
    return rows


def _solve_displacement(
    matrix: sp.csc_matrix, fixed: np.ndarray, values: np.ndarray, load: np.ndarray
) -> np.ndarray:
    """Solve for displacements under a load that are `values` where `fixed` (both (n,))."""
    solution = np.where(fixed, values, 0.0)
    free = ~fixed
    solution[free] = spsolve(matrix[free][:, free].tocsc(), (load - matrix @ solution)[free])
    return solution


def compute_made_up_field(m: int, r: jax.Array, z: jax.Array) -> jax.Array:
    """Compute U, V, W (3,) of a displacement that is smooth on the axis too."""
    swirl, push, lift = _compute_terms(r**2, z)
    both, one = swirl * r ** (m + 1), push * r ** (m - 1) if m else 0 * r
    return jnp.stack([both + one, both - one if m else 0 * r, lift * r**m])


class _Terms(NamedTuple):
    swirl: jax.Array
    push: jax.Array
    lift: jax.Array


def _compute_terms(square: jax.Array, z: jax.Array) -> _Terms:
    return _Terms(
        jnp.cos(2 * z + 0.3) * jnp.exp(-square),
        jnp.sin(2 * z + 1),
        jnp.cos(1.5 * z) * (1 + square),
    )


def _compute_cartesian_field(m: int, point: jax.Array) -> jax.Array:
    """Compute the made-up displacement (3,) in x, y, z at a point (3,).

    Its strains need no cylindrical coordinates.
    """
    x, y, z = point
    swirl, push, lift = _compute_terms(x**2 + y**2, z)
    plane = x + 1j * y
    low = jnp.conj(plane) ** (m - 1) if m else plane * 0
    flat = swirl * plane ** (m + 1) + push * low
    return jnp.stack([flat.real, flat.imag, lift * (plane**m).real])


def compute_body_force(
    m: int, modulus: float, poisson: float, r: jax.Array, z: jax.Array
) -> jax.Array:
    """Compute the body force (3,) that bears the made-up field.

    It is minus the divergence of the field's stress; radial, tangential and axial as U, V, W are.
    """
    shear, first = compute_lame_constants(modulus, poisson)

    def compute_at(angle: float) -> jax.Array:
        point = jnp.stack([r * np.cos(angle), r * np.sin(angle), z])
        second = jax.jacfwd(jax.jacfwd(lambda p: _compute_cartesian_field(m, p)))(point)
        return -(first + shear) * jnp.einsum("jij->i", second) - shear * jnp.einsum(
            "ijj->i", second
        )

    along = compute_at(0.0)
    around = 0.0 * r
    if m:
        quarter = np.pi / (2 * m)
        x, y, _ = compute_at(quarter)
        around = -np.sin(quarter) * x + np.cos(quarter) * y
    return jnp.stack([along[0], around, along[2]])


class _Sample(NamedTuple):
    """The made-up field at n points."""

    field: Array  # (n, 3) displacement
    slopes: Array  # (n, 3, 2) of it, in r and z
    force: Array  # (n, 3) body force


@partial(jax.jit, static_argnames=("m", "poisson"))
def _sample_chunk(m: int, poisson: float, r: jax.Array, z: jax.Array) -> _Sample:
    compute_field = partial(compute_made_up_field, m)

    def sample(r: jax.Array, z: jax.Array) -> _Sample:
        slopes = jnp.stack([jax.jacfwd(compute_field, i)(r, z) for i in (0, 1)], -1)
        return _Sample(compute_field(r, z), slopes, compute_body_force(m, 1.0, poisson, r, z))

    return jax.vmap(sample)(r, z)


def _sample_field(m: int, poisson: float, r: np.ndarray, z: np.ndarray) -> _Sample:
    """Sample the field at r, z of one shape, in chunks for which one program is compiled."""
    place = np.stack([r.ravel(), z.ravel()])
    parts = np.array_split(place, range(CHUNK, place.shape[1], CHUNK), axis=1)
    padded = [np.pad(part, ((0, 0), (0, CHUNK - part.shape[1])), mode="edge") for part in parts]
    with jax.enable_x64(True):
        chunks = [jax.device_get(_sample_chunk(m, poisson, *jnp.asarray(part))) for part in padded]

    def merge(*arrays: np.ndarray) -> np.ndarray:
        return np.concatenate(arrays)[: r.size].reshape(*r.shape, *arrays[0].shape[1:])

    merged: _Sample = jax.tree.map(merge, *chunks)
    return merged


def measure_manufactured_errors(mesh: Mesh, m: int, poisson: float) -> tuple[float, float]:
    """Measure the relative rms errors over the body, of displacement and of its slopes."""
    values, slopes, area, r = sample_elements(mesh, GAUSS_3)
    z = np.einsum("qn,en->eq", values, mesh.nodes[mesh.elements][..., 1])
    weight = area * WEIGHT_3 * r
    exact = _sample_field(m, poisson, r, z)
    at_nodes = _sample_field(m, poisson, *mesh.nodes.T).field
    load = np.zeros((len(mesh.nodes), 3))
    np.add.at(load, mesh.elements, np.einsum("eq,qn,eqi->eni", weight, values, exact.force))
    material = compute_isotropic_stiffness(1.0, poisson)
    materials = np.broadcast_to(material, (len(mesh.elements), 6, 6))
    matrix = assemble_stiffness(mesh, materials).compute_harmonic(m)
    edge = np.zeros(len(mesh.nodes), bool)
    edge[np.unique(mesh.surface)] = True
    edge[mesh.clamped] = True
    edge[mesh.axis] = True
    solution = _solve_displacement(matrix, np.repeat(edge, 3), at_nodes.ravel(), load.ravel())
    in_elements = solution.reshape(-1, 3)[mesh.elements]
    field = np.einsum("qn,eni->eqi", values, in_elements)
    field_slopes = np.einsum("eqnx,eni->eqix", slopes, in_elements)

    def compute_error(miss: np.ndarray, full: np.ndarray) -> float:
        axes = tuple(range(2, miss.ndim))
        total = np.sum(weight * np.sum(full**2, axes))
        return float(np.sqrt(np.sum(weight * np.sum(miss**2, axes)) / total))

    return (
        compute_error(field - exact.field, exact.field),
        compute_error(field_slopes - exact.slopes, exact.slopes),
    )


def measure_manufactured_orders() -> list[Row]:
    """Measure the orders of convergence on the dome's own meshes, curved sides included.

    Displacements of Q8 elements should converge with h^3, their slopes with h^2.
    """
    sizes = np.array([0.25, 0.125, 0.0625])
    rows = Rows(GROUP)
    for m in (0, 1, 2):
        errors = np.array(
            [measure_manufactured_errors(make_dome_mesh(1.0, 0.25, h), m, 0.49) for h in sizes]
        )
        for column, name, least in ((0, "displacement", 2.7), (1, "slopes", 1.7)):
            error = errors[:, column]
            convergence = {"order": fit_order(sizes, error), "least_order": least}
            words = f"made-up field, m = {m}, nu = 0.49: {name}"
            rows.expect_zero(words, error[-1], 1.0, 0.01, note="order in h", **convergence)
    return rows
