"""Linear elasticity of a body of revolution: compliance of its contact nodes and pins.

The body is axisymmetric, its load is not: loads and displacements are expanded in exp(i m theta),
and every harmonic m is a small 2-D problem on the (r, z) mesh (Wilson 1965, AIAA J. 3(12)). With
u_r = U, u_theta = -i V, u_z = W the stiffness is real, K_m = K_0 + m K_1 + m^2 K_2. Elements are
8-node quadrilaterals with 2 x 2 reduced integration, which do not lock up to a Poisson ratio of
0.4999.

Contact nodes stand in rings 1 + 6 + 12 + ... A unit force at a node is spread with a hat function
along the ring's meridian and another around the axis, and a node's displacement is the mean with
the same weights. The condensed compliance W is then symmetric positive definite by construction, if
there are at least as many harmonics as nodes in a ring.

A mesh of a few thousand unknowns in the plane has a narrow band (about 240 here), which dense
blocks use at the speed of matrix products: `factorise` is four times faster than a general sparse
LU. There is no pivoting, so that a symmetric problem keeps a symmetric solution to rounding.

`compute_response` solves the harmonics, `sum_harmonics` sums them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse.csgraph import reverse_cuthill_mckee
from threadpoolctl import threadpool_limits

from jaxunshear.errors import UserError
from jaxunshear.progress import Counter
from jaxunshear.simulator.harmonics import (
    compute_node_compliance,
    compute_point_compliance,
    compute_ring_sizes,
    make_ring_lattice,
)
from jaxunshear.simulator.mesh import (
    GAUSS,
    Mesh,
    PinLevers,
    compute_edge_shapes,
    compute_interpolation,
    sample_elements,
)

_SAMPLES = 40  # of a surface edge
_MIN_ROWS = 64  # of a block


@dataclass(frozen=True)
class Compliance:
    """Displacements of N contact nodes and P pins per nodal force, mm/N for moduli in MPa.

    Forces and displacements are ordered node by node, (x, y, z).
    """

    nodes: np.ndarray  # (N, 3) mm
    pins: np.ndarray  # (P, 3) mm
    w: np.ndarray  # (3N, 3N) of the nodes
    g: np.ndarray  # (3P, 3N) of the pins


@dataclass(frozen=True)
class HarmonicResponse:
    """A `Compliance` before its harmonics are summed, a tenth of its size.

    Pins stand at Q places of the half-plane; displacements (U, V, W) are per unit load on each of R
    rings.
    """

    nodes: np.ndarray  # (N, 3) mm
    pins: np.ndarray  # (P, 3) mm
    positions: np.ndarray  # (P,) the place of each pin
    rings: np.ndarray  # (M, 3R, 3R) mean displacement of each ring
    fields: np.ndarray  # (M, 3Q, 3R) displacement of the pins


class Pins(NamedTuple):
    """P pins, each a rigid lever from a face of the body to its tip, along the face's normal.

    A tip moves with the face's rotation too. A pin without length moves with the gel around it.
    """

    tips: np.ndarray  # (P, 3) mm
    levers: np.ndarray  # (P, 3) mm from the face to the tip


class HarmonicStiffness(NamedTuple):
    """K_0, K_1, K_2 of the module's docstring (per 2 pi); unknowns U, V, W node by node."""

    k0: sp.csc_matrix
    k1: sp.csc_matrix
    k2: sp.csc_matrix

    def compute_harmonic(self, m: int) -> sp.csc_matrix:
        return self.k0 + m * self.k1 + m * m * self.k2


def compute_lame_constants(modulus: float, poisson: float) -> tuple[float, float]:
    """Compute Lame's constants mu and lambda in MPa."""
    return modulus / (2 * (1 + poisson)), modulus * poisson / ((1 + poisson) * (1 - 2 * poisson))


def compute_isotropic_stiffness(modulus: float, poisson: float) -> Float[np.ndarray, "6 6"]:
    """Compute the stiffness in MPa for strains (rr, theta theta, zz, rz, r theta, theta z).

    The last three are engineering shears.
    """
    shear, first = compute_lame_constants(modulus, poisson)
    d = np.diag([2 * shear] * 3 + [shear] * 3)
    d[:3, :3] += first
    return d


def assemble_stiffness(mesh: Mesh, materials: Float[np.ndarray, "E 6 6"]) -> HarmonicStiffness:
    """Assemble the stiffness of the body's elements."""
    values, slopes, area, r = sample_elements(mesh, GAUSS)
    over_r = values[None] / r[..., None]
    in_r, in_z = slopes[..., 0], slopes[..., 1]

    fixed = np.zeros((*r.shape, 6, 8, 3))
    fixed[..., 0, :, 0] = in_r
    fixed[..., 1, :, 0] = over_r
    fixed[..., 2, :, 2] = in_z
    fixed[..., 3, :, 0], fixed[..., 3, :, 2] = in_z, in_r
    fixed[..., 4, :, 1] = in_r - over_r
    fixed[..., 5, :, 1] = in_z
    growing = np.zeros_like(fixed)  # times m
    growing[..., 1, :, 1] = over_r
    growing[..., 4, :, 0] = -over_r
    growing[..., 5, :, 2] = -over_r
    fixed, growing = fixed.reshape(*r.shape, 6, 24), growing.reshape(*r.shape, 6, 24)

    weight = area * r
    unknowns = (3 * mesh.elements[:, :, None] + np.arange(3)).reshape(len(mesh.elements), 24)
    rows, columns = np.repeat(unknowns, 24, axis=1).ravel(), np.tile(unknowns, (1, 24)).ravel()
    size = 3 * len(mesh.nodes)

    def assemble(left: np.ndarray, right: np.ndarray) -> sp.csc_matrix:
        stress = np.einsum("exy,eqyj->eqxj", materials, right)
        blocks = np.einsum("eq,eqxi,eqxj->eij", weight, left, stress, optimize=True)
        return sp.coo_matrix((blocks.ravel(), (rows, columns)), shape=(size, size)).tocsc()

    mixed = assemble(fixed, growing)
    return HarmonicStiffness(
        assemble(fixed, fixed), (mixed + mixed.T).tocsc(), assemble(growing, growing)
    )


class _SurfaceSamples(NamedTuple):
    """Q points of each of S surface edges."""

    shapes: np.ndarray  # (Q, 3) shape functions
    points: np.ndarray  # (S, Q, 2) mm
    speeds: np.ndarray  # (S, Q) mm per unit of the edge's coordinate


def _sample_surface(mesh: Mesh, samples: np.ndarray) -> _SurfaceSamples:
    """Sample the surface edges at `samples` (Q,) in [-1, 1]."""
    shapes, slope = compute_edge_shapes(samples)
    ends = mesh.nodes[mesh.surface]
    speeds = np.linalg.norm(np.einsum("qn,snx->sqx", slope, ends), axis=-1)
    return _SurfaceSamples(shapes, np.einsum("qn,snx->sqx", shapes, ends), speeds)


def compute_ring_loads(
    mesh: Mesh, arcs: Float[np.ndarray, "_"]
) -> tuple[Float[np.ndarray, "V R"], Float[np.ndarray, "R 2"]]:
    """Compute how a unit force on a ring spreads over mesh nodes, and the rings' r and z.

    `arcs` (R + 1,) are lengths along the surface from the axis, rising from 0; the last one only
    ends the last hat.
    """
    middles = _sample_surface(mesh, (np.arange(_SAMPLES) + 0.5) / _SAMPLES * 2 - 1)
    lengths = 2 * middles.speeds / _SAMPLES
    ends = np.cumsum(lengths.ravel()).reshape(lengths.shape)
    hats = np.stack(
        [np.interp(ends - lengths / 2, arcs, row, right=0.0) for row in np.eye(len(arcs))[:-1]], -1
    )
    weight = hats * (middles.points[..., 0] * lengths)[..., None]
    weight /= weight.sum(axis=(0, 1))
    loads = np.zeros((len(mesh.nodes), len(arcs) - 1))
    np.add.at(loads, mesh.surface, np.einsum("qn,sqk->snk", middles.shapes, weight))

    outline = _sample_surface(mesh, np.arange(1, _SAMPLES + 1) / _SAMPLES * 2 - 1).points
    outline = np.concatenate([mesh.nodes[mesh.surface[:1, 0]], outline.reshape(-1, 2)])
    arc = np.concatenate([[0.0], ends.ravel()])
    return loads, np.stack([np.interp(arcs[:-1], arc, axis) for axis in outline.T], -1)


def _make_axis_constraints(mesh: Mesh, m: int) -> sp.csc_matrix:
    """Make the matrix whose columns are the free unknowns of harmonic m.

    On the axis a field is finite and single-valued only if U = V = 0 (m = 0), U + V = 0 and W = 0
    (m = 1), or all are zero (m > 1).
    """
    size = 3 * len(mesh.nodes)
    keep = np.ones(size, bool)
    keep[(3 * mesh.clamped[:, None] + np.arange(3)).ravel()] = False
    axis = np.setdiff1d(mesh.axis, mesh.clamped)
    keep[3 * axis + 1] = False
    if m != 1:
        keep[3 * axis] = False
    if m != 0:
        keep[3 * axis + 2] = False
    free = np.flatnonzero(keep)
    select = sp.csc_matrix(
        (np.ones(len(free)), (free, np.arange(len(free)))), shape=(size, len(free))
    )
    if m == 1:
        ties = sp.csc_matrix(
            (-np.ones(len(axis)), (3 * axis + 1, np.searchsorted(free, 3 * axis))),
            shape=select.shape,
        )
        select = select + ties
    return select.tocsc()


def _stand_pins(mesh: Mesh, pins: Pins) -> tuple[PinLevers, np.ndarray]:
    """Stand the pins on the mesh; those of equal place in the half-plane share one lever.

    The place (P,) of each pin comes second.
    """
    ends = []
    for points in (pins.tips - pins.levers, pins.tips):
        ends.append(np.stack([np.hypot(*points.T[:2]), points[:, 2]], -1))
    rounded = np.round(np.concatenate(ends, -1), 9)
    places, positions = np.unique(rounded, axis=0, return_inverse=True)
    feet, tips = places[:, :2], places[:, 2:]
    return PinLevers(feet, tips - feet, compute_interpolation(mesh, feet)), positions.ravel()


def compute_response(
    mesh: Mesh,
    materials: Float[np.ndarray, "E 6 6"],
    ring_arcs: Float[np.ndarray, "_"],
    pins: Pins,
    harmonics: int,
    varied: Bool[np.ndarray, "E"] | None = None,
    progress: Counter | None = None,
) -> HarmonicResponse:
    """Compute the response of each harmonic to loads on rings.

    `materials` are as from `compute_isotropic_stiffness`, `ring_arcs` as for `compute_ring_loads`.
    At most as many `harmonics` are used as the outer ring has nodes, and as many are needed for a
    compliance that is positive definite. A ring bears as many harmonics as it has nodes: what its
    hats hold beyond is less than a thousandth of W, and what a mesh answers to waves shorter than
    its elements is wrong. With `varied` the result is its derivative by the logarithm of a factor
    on the moduli of these elements.
    """
    loads, outline = compute_ring_loads(mesh, ring_arcs)
    sizes = compute_ring_sizes(len(loads.T))
    harmonics = min(harmonics, sizes[-1])
    ring, angle = make_ring_lattice(len(sizes))
    around = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], -1)
    nodes = outline[ring][:, [0, 0, 1]] * around
    levers, positions = _stand_pins(mesh, pins)
    spatial = sp.kron(sp.csr_matrix(loads), sp.eye(3)).tocsc()  # (3V, 3R)
    stiffness = assemble_stiffness(mesh, materials)
    slope = None
    if varied is not None:
        slope = assemble_stiffness(mesh, np.where(varied[:, None, None], materials, 0.0))
    rings = np.zeros((harmonics + 1, spatial.shape[1], spatial.shape[1]))
    fields = np.zeros((harmonics + 1, 3 * len(levers.places), spatial.shape[1]))
    # on several busy cores thousands of small products took ten times longer
    with threadpool_limits(1, "blas"):
        for m in range(harmonics + 1):
            bears = np.flatnonzero(np.repeat(sizes >= m, 3))
            load = spatial[:, bears]
            field = _solve_harmonic(_make_axis_constraints(mesh, m), stiffness, slope, load, m)
            rings[m][np.ix_(bears, bears)] = load.T @ field
            fields[m][:, bears] = levers.motion(field, m)
            if progress is not None:
                progress.advance(1)
    return HarmonicResponse(nodes, pins.tips, positions, rings, fields)


def _solve_harmonic(
    free: sp.csc_matrix,
    stiffness: HarmonicStiffness,
    slope: HarmonicStiffness | None,
    load: sp.csc_matrix,
    m: int,
) -> np.ndarray:
    """Solve harmonic m for the displacements under loads, or for their derivative by `slope`."""
    try:
        solve = factorise(free.T @ stiffness.compute_harmonic(m) @ free)
    except np.linalg.LinAlgError:
        raise UserError(
            "the dome's stiffness is singular to rounding: bring the moduli of skin and gel closer "
            "together, or Poisson's ratios away from 0.5"
        ) from None
    field: np.ndarray = free @ solve((free.T @ load).toarray())
    if slope is not None:
        field = free @ solve(-free.T @ (slope.compute_harmonic(m) @ field))
    return field


def sum_harmonics(response: HarmonicResponse) -> Compliance:
    """Sum the harmonics."""
    angle = np.arctan2(response.pins[:, 1], response.pins[:, 0])
    with threadpool_limits(1, "blas"):
        g = compute_point_compliance(response.fields, response.positions, angle)
        return Compliance(response.nodes, response.pins, compute_node_compliance(response.rings), g)


def factorise(matrix: sp.csr_matrix) -> Callable[[np.ndarray], np.ndarray]:
    """Make a function that solves matrix (n, n) x = b for b (n, k).

    It is a block-tridiagonal Cholesky factorisation in the order of Cuthill and McKee (1969, Proc.
    24th ACM Conf., 157-172): every row couples with its own block and the next. Raises
    numpy.linalg.LinAlgError where the matrix is not definite.
    """
    order = reverse_cuthill_mckee(matrix, symmetric_mode=True)
    banded = matrix[order][:, order].tocsr()
    blocks = _find_blocks(banded)
    lower: list[np.ndarray] = []
    coupling: list[np.ndarray] = []  # with the block before, already divided by its factor
    for number, here in enumerate(blocks):
        diagonal = banded[here, here].toarray()
        if number:
            before = banded[blocks[number - 1], here].toarray()
            coupling.append(solve_triangular(lower[-1], before, lower=True, check_finite=False))
            diagonal -= coupling[-1].T @ coupling[-1]
        lower.append(cholesky(diagonal, lower=True))

    def solve(right: np.ndarray) -> np.ndarray:
        parts = [right[order[here]] for here in blocks]
        for number, factor in enumerate(lower):
            if number:
                parts[number] = parts[number] - coupling[number - 1].T @ parts[number - 1]
            parts[number] = solve_triangular(factor, parts[number], lower=True, check_finite=False)
        for number in reversed(range(len(lower))):
            if number + 1 < len(lower):
                parts[number] = parts[number] - coupling[number] @ parts[number + 1]
            parts[number] = solve_triangular(
                lower[number], parts[number], lower=True, trans="T", check_finite=False
            )
        solution = np.empty_like(right)
        solution[order] = np.concatenate(parts)
        return solution

    return solve


def _find_blocks(banded: sp.csr_matrix) -> list[slice]:
    """Slice the rows so that each block reaches as far as the one before couples."""
    furthest = np.maximum.accumulate(np.maximum.reduceat(banded.indices, banded.indptr[:-1]))
    slices, start = [], 0
    while start < len(furthest):
        stop = max(start + _MIN_ROWS, furthest[start - 1] + 1 if start else 0)
        slices.append(slice(start, min(stop, len(furthest))))
        start = slices[-1].stop
    return slices
