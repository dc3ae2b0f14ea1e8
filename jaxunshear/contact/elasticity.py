"""From a body of revolution to the compliance of its contact nodes and pins: linear elasticity by Fourier harmonics.

The body is axisymmetric, its load is not: loads and displacements are expanded in exp(i m theta), and every harmonic m is a
small 2-D problem on the (r, z) mesh (Wilson 1965, AIAA J. 3(12)). With u_r = U, u_theta = -i V, u_z = W the stiffness is
real, K_m = K_0 + m K_1 + m^2 K_2. Elements are 8-node quadrilaterals with 2 x 2 reduced integration, which do not lock up to
a Poisson ratio of 0.4999.

Contact nodes stand in rings 1 + 6 + 12 + ... A unit force at a node is spread with a hat function along the ring's
meridian and another around the axis, and a node's displacement is the mean with the same weights, so that the condensed
compliance W is symmetric positive definite by construction.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from jaxunshear.contact.mesh import Mesh, shape_functions
from jaxunshear.errors import UserError

_GAUSS = np.array([[x, y] for y in (-1, 1) for x in (-1, 1)]) / np.sqrt(3)


@dataclass(frozen=True)
class Compliance:
    """`nodes` (N, 3) contact nodes and `pins` (P, 3) in mm; forces and displacements are ordered node by node, (x, y, z).

    `w` (3N, 3N) is displacement of the nodes per nodal force, `g` (3P, 3N) of the pins, mm/N for moduli in MPa.
    """

    nodes: np.ndarray
    pins: np.ndarray
    w: np.ndarray
    g: np.ndarray


def isotropic(modulus: float, poisson: float) -> np.ndarray:
    """Stiffness (6, 6) in MPa for strains (rr, theta theta, zz, rz, r theta, theta z), the last three engineering shears."""
    first = modulus * poisson / ((1 + poisson) * (1 - 2 * poisson))
    shear = modulus / (2 * (1 + poisson))
    d = np.diag([2 * shear] * 3 + [shear] * 3)
    d[:3, :3] += first
    return d


def stiffness(mesh: Mesh, materials: np.ndarray) -> tuple[sp.csc_matrix, sp.csc_matrix, sp.csc_matrix]:
    """K_0, K_1, K_2 of the module's docstring (per 2 pi); materials (E, 6, 6); unknowns ordered U, V, W node by node."""
    corners = mesh.nodes[mesh.elements]
    values, gradients = shape_functions(_GAUSS)
    jacobian = np.einsum("qnl,enx->eqlx", gradients, corners)
    determinant = np.abs(np.linalg.det(jacobian))
    slopes = np.einsum("eqxl,qnl->eqnx", np.linalg.inv(jacobian), gradients)
    r = np.einsum("qn,en->eq", values, corners[..., 0])
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

    weight = determinant * r
    unknowns = (3 * mesh.elements[:, :, None] + np.arange(3)).reshape(len(mesh.elements), 24)
    rows, columns = np.repeat(unknowns, 24, axis=1).ravel(), np.tile(unknowns, (1, 24)).ravel()
    size = 3 * len(mesh.nodes)

    def assemble(left: np.ndarray, right: np.ndarray) -> sp.csc_matrix:
        stress = np.einsum("exy,eqyj->eqxj", materials, right)
        blocks = np.einsum("eq,eqxi,eqxj->eij", weight, left, stress, optimize=True)
        return sp.coo_matrix((blocks.ravel(), (rows, columns)), shape=(size, size)).tocsc()

    mixed = assemble(fixed, growing)
    return assemble(fixed, fixed), (mixed + mixed.T).tocsc(), assemble(growing, growing)


def ring_loads(mesh: Mesh, radii: np.ndarray) -> np.ndarray:
    """(V, R): how one unit of force on a ring spreads over the mesh nodes; radii (R + 1,) rise from 0, the last one is open."""
    samples = (np.arange(40) + 0.5) / 40 * 2 - 1
    line = np.stack([samples * (samples - 1) / 2, 1 - samples**2, samples * (samples + 1) / 2], -1)
    line_slope = np.stack([samples - 0.5, -2 * samples, samples + 0.5], -1)
    ends = mesh.nodes[mesh.surface]
    points = np.einsum("qn,snx->sqx", line, ends)
    lengths = np.linalg.norm(np.einsum("qn,snx->sqx", line_slope, ends), axis=-1) / 20  # 40 midpoints over 2 units
    r = points[..., 0]
    hats = np.stack([np.interp(r, radii, row, right=0.0) for row in np.eye(len(radii))[:-1]], -1)
    weight = hats * (r * lengths)[..., None]
    weight /= weight.sum(axis=(0, 1))
    loads = np.zeros((len(mesh.nodes), len(radii) - 1))
    np.add.at(loads, mesh.surface, np.einsum("qn,sqk->snk", line, weight))
    return loads


def interpolation(mesh: Mesh, points: np.ndarray) -> sp.csr_matrix:
    """(P, V) values of the shape functions at points (P, 2) of the half-plane, by Newton's method in each near element."""
    corners = mesh.nodes[mesh.elements]
    centres = corners[:, :4].mean(1)
    rows, columns, entries = [], [], []
    for p, point in enumerate(points):
        for e in np.argsort(np.sum((centres - point) ** 2, -1))[:12]:
            local = np.zeros((1, 2))
            for _ in range(20):
                value, slope = shape_functions(local)
                step = np.linalg.solve(np.einsum("nl,nx->xl", slope[0], corners[e]), point - value[0] @ corners[e])
                local = np.clip(local + step, -1.5, 1.5)
            if np.abs(local).max() < 1 + 1e-6:
                rows += [p] * 8
                columns += list(mesh.elements[e])
                entries += list(shape_functions(local)[0][0])
                break
        else:
            raise UserError(
                f"pin at r = {point[0]:.2f} mm, z = {point[1]:.2f} mm lies outside the gel: check the sensor's pins"
            )
    return sp.csr_matrix((entries, (rows, columns)), shape=(len(points), len(mesh.nodes)))


def _axis_constraints(mesh: Mesh, m: int) -> sp.csc_matrix:
    """Columns: the free unknowns of harmonic m. On the axis a field is finite and single-valued only if
    U = V = 0 (m = 0), U + V = 0 and W = 0 (m = 1), all zero (m > 1)."""
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
    select = sp.csc_matrix((np.ones(len(free)), (free, np.arange(len(free)))), shape=(size, len(free)))
    if m == 1:
        ties = sp.csc_matrix((-np.ones(len(axis)), (3 * axis + 1, np.searchsorted(free, 3 * axis))), shape=select.shape)
        select = select + ties
    return select.tocsc()


def _load_coefficients(m: int, spread: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Harmonic m of unit forces in x, y, z at nodes: (N, 3 directions, 3 unknowns (U, V, W)).

    `spread` (N,) is the half-width of each node's angular hat (0: no dependence on the angle).
    """

    def hat(order: int) -> np.ndarray:
        around = np.where(spread > 0, np.sinc(order * spread / (2 * np.pi)) ** 2, float(order == 0))
        return around * np.exp(-1j * order * angle) / (2 * np.pi)

    below, above, here = hat(m - 1), hat(m + 1), hat(m)
    along = (below + above) / 2  # harmonic m of cos(theta) times the hat
    across = (below - above) / 2j  # and of sin(theta)
    zero = np.zeros_like(here)
    x = np.stack([along, -1j * across, zero], -1)
    y = np.stack([across, 1j * along, zero], -1)
    return np.stack([x, y, np.stack([zero, zero, here], -1)], axis=1)


def condense(
    mesh: Mesh, materials: np.ndarray, ring_radii: np.ndarray, pins: np.ndarray, harmonics: int, progress=None
) -> Compliance:
    """Compliance of contact rings at lateral radii `ring_radii` (R + 1,) (the last only ends the last hat) and of pins (P, 3)."""
    rings = len(ring_radii) - 1
    count = np.array([1] + [6 * k for k in range(1, rings)])
    ring_of = np.repeat(np.arange(rings), count)
    angle = np.concatenate([np.arange(n) * 2 * np.pi / n for n in count])
    spread = np.where(ring_of > 0, 2 * np.pi / count[ring_of], 0.0)
    face = mesh.nodes[mesh.surface]
    outline = np.concatenate([face[:, :2].reshape(-1, 2), face[-1:, 2]])
    height = np.interp(ring_radii[:-1], outline[:, 0], outline[:, 1])
    lateral = ring_radii[ring_of][:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    nodes = np.concatenate([lateral, height[ring_of][:, None]], -1)

    pin_r = np.hypot(pins[:, 0], pins[:, 1])
    places, place_of = np.unique(np.round(np.stack([pin_r, pins[:, 2]], -1), 9), axis=0, return_inverse=True)
    place_of = place_of.ravel()
    pin_angle = np.arctan2(pins[:, 1], pins[:, 0])
    at_pins = interpolation(mesh, places)

    spatial = sp.kron(sp.csr_matrix(ring_loads(mesh, ring_radii)), sp.eye(3)).tocsc()  # (3V, 3R)
    k0, k1, k2 = stiffness(mesh, materials)
    n, p = len(nodes), len(pins)
    w, g = np.zeros((3 * n, 3 * n)), np.zeros((3 * p, 3 * n))
    for m in range(harmonics + 1):
        free = _axis_constraints(mesh, m)
        matrix = (free.T @ (k0 + m * k1 + m * m * k2) @ free).tocsc()
        loads = (free.T @ spatial).toarray()
        response = splu(matrix, permc_spec="COLAMD").solve(loads)
        between = loads.T @ response  # (3R, 3R)
        to_pins = sp.kron(at_pins, sp.eye(3)) @ (free @ response)  # (3 places, 3R)

        shares = _load_coefficients(m, spread, angle)
        by_ring = np.zeros((rings, 3, n, 3), complex)
        by_ring[ring_of, :, np.arange(n), :] = shares.transpose(0, 2, 1)
        node_map = by_ring.reshape(3 * rings, 3 * n)  # ring unknowns per nodal force
        weight = 2 * np.pi * (1 if m == 0 else 2)
        middle = between @ node_map
        w += weight * (node_map.real.T @ middle.real + node_map.imag.T @ middle.imag)

        fields = (to_pins @ node_map).reshape(len(places), 3, 3 * n)[place_of] * np.exp(1j * m * pin_angle)[
            :, None, None
        ]
        radial, around, up = fields[:, 0].real, (-1j * fields[:, 1]).real, fields[:, 2].real
        cos, sin = np.cos(pin_angle)[:, None], np.sin(pin_angle)[:, None]
        here = np.stack([cos * radial - sin * around, sin * radial + cos * around, up], axis=1)
        g += (1 if m == 0 else 2) * here.reshape(3 * p, 3 * n)
        if progress is not None:
            progress.advance(1)
    return Compliance(nodes, pins, (w + w.T) / 2, g)
