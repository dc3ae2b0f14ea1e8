"""The elements alone: patches that must bear a homogeneous strain exactly, and fields made up to measure the order.

Displacements are written as in `elasticity`: u_r = U cos m theta, u_theta = V sin m theta, u_z = W cos m theta.
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
from verification.verification_rows import Row, fit_order, make_zero_row

GROUP = "elements"
CHUNK = 4096
Array = Any  # of NumPy or of JAX
_LINE = np.sqrt(0.6) * np.array([-1, 0, 1])
_WEIGHT = np.array([5, 8, 5]) / 9
GAUSS_3 = np.stack(np.meshgrid(_LINE, _LINE, indexing="ij"), -1).reshape(-1, 2)
WEIGHT_3 = np.outer(_WEIGHT, _WEIGHT).ravel()


def make_irregular_patch(cells: int = 4, seed: int = 0) -> Mesh:
    """A square r, z in [0, 1] cut into quadrilaterals with straight sides, whose inner corners lie anywhere near their place."""
    line = np.linspace(0, 1, cells + 1)
    corners = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    corners[1:-1, 1:-1] += (
        np.random.default_rng(seed).uniform(-0.25, 0.25, (cells - 1, cells - 1, 2)) / cells
    )
    points: list[np.ndarray] = []
    index: dict[tuple[int, int], int] = {}

    def node(i: int, j: int) -> int:
        """In half cells."""
        if (i, j) not in index:
            index[i, j] = len(points)
            ends = corners[i // 2, j // 2], corners[(i + 1) // 2, (j + 1) // 2]
            points.append((ends[0] + ends[1]) / 2)
        return index[i, j]

    around = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    elements = [
        [node(2 * i + a, 2 * j + b) for a, b in around] for i in range(cells) for j in range(cells)
    ]
    none = np.zeros(0, int)
    return Mesh(np.array(points), np.array(elements), np.zeros(len(elements), bool), none, none)


def run_patch_test() -> list[Row]:
    """Prescribed at its boundary, a homogeneous strain must be found inside to rounding."""
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
    k0, k1, k2 = assemble_stiffness(mesh, materials)
    worst = 0.0
    for m, field in fields.values():
        exact = np.stack(field, -1)
        found = _solve_prescribed(
            k0 + m * k1 + m * m * k2, np.repeat(edge, 3), exact.ravel(), np.zeros(exact.size)
        )
        worst = max(worst, np.abs(found - exact.ravel()).max() / np.abs(exact).max())
    words = "patch test on distorted elements: worst of 6 homogeneous strains"
    return [make_zero_row(GROUP, words, worst, 1.0, 1e-9)]


def _solve_prescribed(
    matrix: sp.csc_matrix, fixed: np.ndarray, values: np.ndarray, load: np.ndarray
) -> np.ndarray:
    """Displacements that are `values` where `fixed` (both (n,))."""
    found = np.where(fixed, values, 0.0)
    free = ~fixed
    found[free] = spsolve(matrix[free][:, free].tocsc(), (load - matrix @ found)[free])
    return found


def compute_manufactured(m: int, r: jax.Array, z: jax.Array) -> jax.Array:
    """(3,) U, V, W of a displacement that is smooth on the axis too."""
    swirl, push, lift = _parts(r**2, z)
    both, one = swirl * r ** (m + 1), push * r ** (m - 1) if m else 0 * r
    return jnp.stack([both + one, both - one if m else 0 * r, lift * r**m])


def _parts(square: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    return (
        jnp.cos(2 * z + 0.3) * jnp.exp(-square),
        jnp.sin(2 * z + 1),
        jnp.cos(1.5 * z) * (1 + square),
    )


def _cartesian(m: int, point: jax.Array) -> jax.Array:
    """The same displacement (3,) in x, y, z at a point (3,): strains of it need no cylindrical coordinates."""
    x, y, z = point
    swirl, push, lift = _parts(x**2 + y**2, z)
    plane = x + 1j * y
    low = jnp.conj(plane) ** (m - 1) if m else plane * 0
    flat = swirl * plane ** (m + 1) + push * low
    return jnp.stack([flat.real, flat.imag, lift * (plane**m).real])


def compute_body_force(
    m: int, modulus: float, poisson: float, r: jax.Array, z: jax.Array
) -> jax.Array:
    """(3,) that bears the made-up field: minus the divergence of its stress, radial, tangential and axial as U, V, W are."""
    shear, first = compute_lame_constants(modulus, poisson)

    def at(angle: float) -> jax.Array:
        point = jnp.stack([r * np.cos(angle), r * np.sin(angle), z])
        second = jax.jacfwd(jax.jacfwd(lambda p: _cartesian(m, p)))(point)
        return -(first + shear) * jnp.einsum("jij->i", second) - shear * jnp.einsum(
            "ijj->i", second
        )

    along = at(0.0)
    around = 0.0 * r
    if m:
        quarter = np.pi / (2 * m)
        x, y, _ = at(quarter)
        around = -np.sin(quarter) * x + np.cos(quarter) * y
    return jnp.stack([along[0], around, along[2]])


class _Sample(NamedTuple):
    """Of n points: displacement (n, 3), its slopes in r and z (n, 3, 2), and the body force (n, 3)."""

    field: Array
    slopes: Array
    force: Array


@partial(jax.jit, static_argnames=("m", "poisson"))
def _sample(m: int, poisson: float, r: jax.Array, z: jax.Array) -> _Sample:
    field = partial(compute_manufactured, m)
    slopes = lambda r, z: jnp.stack([jax.jacfwd(field, i)(r, z) for i in (0, 1)], -1)  # noqa: E731
    return _Sample(
        *(jax.vmap(f)(r, z) for f in (field, slopes, partial(compute_body_force, m, 1.0, poisson)))
    )


def _everywhere(m: int, poisson: float, r: np.ndarray, z: np.ndarray) -> _Sample:
    """At points r, z of any one shape; by the thousand, so that meshes share a compiled program."""
    place = np.stack([r.ravel(), z.ravel()])
    parts = np.array_split(place, range(CHUNK, place.shape[1], CHUNK), axis=1)
    padded = [np.pad(part, ((0, 0), (0, CHUNK - part.shape[1])), mode="edge") for part in parts]
    with jax.enable_x64(True):
        made = [jax.device_get(_sample(m, poisson, *jnp.asarray(part))) for part in padded]
    full = [np.concatenate(field)[: r.size] for field in zip(*made, strict=True)]
    return _Sample(*(field.reshape(*r.shape, *field.shape[1:]) for field in full))


def measure_manufactured_errors(mesh: Mesh, m: int, poisson: float) -> tuple[float, float]:
    """Relative errors of displacement and of its slopes, in the mean square over the body."""
    values, slopes, area, r = sample_elements(mesh, GAUSS_3)
    z = np.einsum("qn,en->eq", values, mesh.nodes[mesh.elements][..., 1])
    weight = area * WEIGHT_3 * r
    exact, at_nodes = _everywhere(m, poisson, r, z), _everywhere(m, poisson, *mesh.nodes.T).field
    load = np.zeros((len(mesh.nodes), 3))
    np.add.at(load, mesh.elements, np.einsum("eq,qn,eqi->eni", weight, values, exact.force))
    k0, k1, k2 = assemble_stiffness(
        mesh, np.broadcast_to(compute_isotropic_stiffness(1.0, poisson), (len(mesh.elements), 6, 6))
    )
    edge = np.zeros(len(mesh.nodes), bool)
    edge[np.unique(mesh.surface)] = True
    edge[mesh.clamped] = True
    edge[mesh.axis] = True
    found = _solve_prescribed(
        k0 + m * k1 + m * m * k2, np.repeat(edge, 3), at_nodes.ravel(), load.ravel()
    ).reshape(-1, 3)
    here = np.einsum("qn,eni->eqi", values, found[mesh.elements])
    sloping = np.einsum("eqnx,eni->eqix", slopes, found[mesh.elements])

    def share(miss: np.ndarray, full: np.ndarray) -> float:
        axes = tuple(range(2, miss.ndim))
        return float(
            np.sqrt(np.sum(weight * np.sum(miss**2, axes)) / np.sum(weight * np.sum(full**2, axes)))
        )

    return share(here - exact.field, exact.field), share(sloping - exact.slopes, exact.slopes)


def measure_manufactured_orders() -> list[Row]:
    """On the dome's own meshes, curved sides included. Q8 should converge with h^3, its slopes with h^2."""
    sizes = np.array([0.25, 0.125, 0.0625])
    rows = []
    for m in (0, 1, 2):
        errors = np.array(
            [measure_manufactured_errors(make_dome_mesh(1.0, 0.25, h), m, 0.49) for h in sizes]
        )
        for error, name, least in zip(
            errors.T, ("displacement", "slopes"), (2.7, 1.7), strict=True
        ):
            words, order = f"made-up field, m = {m}, nu = 0.49: {name}", fit_order(sizes, error)
            more = {"order": order, "least_order": least, "note": "order in h"}
            rows.append(make_zero_row(GROUP, words, error[-1], 1.0, 0.01, **more))
    return rows
