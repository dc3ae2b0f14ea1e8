"""Meshes of a body of revolution: 8-node quadrilaterals in the half-plane (r, z), for the dome and for a half-space.

Both are a quarter disk: a square core on the axis, then layers out to the arc, so that no element degenerates. Read
`make_dome_mesh` first; `_quarter_disk` is bookkeeping.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# corners, then mid-sides, counter-clockwise in the reference square [-1, 1]^2
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
_SIDES = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float)
_EDGES = [[0, 4, 1], [1, 5, 2], [2, 6, 3], [3, 7, 0]]  # of an element: end, middle, end
GAUSS = _CORNERS[[0, 1, 3, 2]] / np.sqrt(3)  # 2 x 2 points of reduced integration


@dataclass(frozen=True)
class Mesh:
    """nodes (V, 2) are (r, z) in mm; surface (S, 3) holds edges (end, middle, end) from the axis outwards."""

    nodes: np.ndarray
    elements: np.ndarray  # (E, 8)
    skin: np.ndarray  # (E,) bool
    clamped: np.ndarray  # node indices
    surface: np.ndarray

    @property
    def axis(self) -> np.ndarray:
        return np.flatnonzero(self.nodes[:, 0] < 1e-9)


def compute_shape_functions(
    local: Float[np.ndarray, "Q 2"],
) -> tuple[Float[np.ndarray, "Q 8"], Float[np.ndarray, "Q 8 2"]]:
    """Serendipity shape functions: values and local gradients."""
    x, y = local[:, :1], local[:, 1:]
    cx, cy = _CORNERS.T
    values = [(1 + x * cx) * (1 + y * cy) * (x * cx + y * cy - 1) / 4]
    in_x = [cx * (1 + y * cy) * (2 * x * cx + y * cy) / 4]
    in_y = [cy * (1 + x * cx) * (2 * y * cy + x * cx) / 4]
    for sx, sy in _SIDES:
        if sx == 0:
            values.append((1 - x**2) * (1 + y * sy) / 2)
            in_x.append(-x * (1 + y * sy))
            in_y.append((1 - x**2) * sy / 2)
        else:
            values.append((1 - y**2) * (1 + x * sx) / 2)
            in_x.append((1 - y**2) * sx / 2)
            in_y.append(-y * (1 + x * sx))
    return np.concatenate(values, 1), np.stack(
        [np.concatenate(in_x, 1), np.concatenate(in_y, 1)], -1
    )


class Samples(NamedTuple):
    """Q points of each of E elements."""

    values: np.ndarray  # (Q, 8) shape functions
    slopes: np.ndarray  # (E, Q, 8, 2) of these, in r and z
    area: np.ndarray  # (E, Q) of the half-plane per unit of the reference square
    r: np.ndarray  # (E, Q)


def sample_elements(mesh: Mesh, local: Float[np.ndarray, "Q 2"]) -> Samples:
    """At points of the reference square."""
    corners = mesh.nodes[mesh.elements]
    values, gradients = compute_shape_functions(local)
    jacobian = np.einsum("qnl,enx->eqlx", gradients, corners)
    slopes = np.einsum("eqxl,qnl->eqnx", np.linalg.inv(jacobian), gradients)
    r = np.einsum("qn,en->eq", values, corners[..., 0])
    return Samples(values, slopes, np.abs(np.linalg.det(jacobian)), r)


def compute_edge_shapes(
    s: Float[np.ndarray, "S"],
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Shape functions of an edge (end, middle, end) at s in [-1, 1], and their slopes."""
    return np.stack([s * (s - 1) / 2, 1 - s**2, s * (s + 1) / 2], -1), np.stack(
        [s - 0.5, -2 * s, s + 0.5], -1
    )


def make_dome_mesh(radius: float, skin: float, h: float) -> Mesh:
    """Hemisphere of `radius` under a skin, clamped at its base plane; z from the apex (z = 0) to the base (z = radius), mm.

    Elements crowd at the rim, where stresses have no bound: that takes three quarters of the error, at no cost.
    """
    inner = radius - skin
    core = max(round(0.61 * radius / h), 2)  # 2 x core elements along the arc
    layers = max(round(0.5 * inner / h), 2)
    skin_layers = max(round(skin / h), 1)
    points, elements, block = _quarter_disk(
        0.5 * inner,
        core,
        np.linspace(0.5 * inner, inner, layers + 1)[1:],
        skin_layers,
        skin,
        crowding=0.9,
    )
    nodes = np.stack([points[:, 0], radius - points[:, 1]], -1)
    skin_elements = block >= layers
    on_arc = np.abs(np.hypot(*points.T) - radius) < 1e-6 * radius
    clamped = np.flatnonzero(points[:, 1] < 1e-9)
    return Mesh(nodes, elements, skin_elements, clamped, _surface_edges(points, elements, on_arc))


def make_half_space_mesh(
    contact: float, h: float, growth: float = 1.25, reach: float = 60.0
) -> Mesh:
    """A half ball of radius `reach` x `contact` in z >= 0, flat face at z = 0, fine within `contact`, clamped far away."""
    core = max(round(contact / h), 2)
    radii, step = [contact * 1.0], h
    while radii[-1] < reach * contact:
        step *= growth
        radii.append(radii[-1] + step)
    points, elements, _ = _quarter_disk(contact, core, np.array(radii[1:]), 0, 0.0)
    on_face = points[:, 1] < 1e-9
    clamped = np.flatnonzero(np.abs(np.hypot(*points.T) - radii[-1]) < 1e-6 * radii[-1])
    no_skin = np.zeros(len(elements), bool)
    return Mesh(points, elements, no_skin, clamped, _surface_edges(points, elements, on_face))


def _quarter_disk(
    core_mm: float,
    core: int,
    radii: np.ndarray,
    skin_layers: int,
    skin: float,
    crowding: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (V, 2), elements (E, 8), and for each element the layer it lies in (-1: the core).

    Elements where the second coordinate is zero are narrower along the arc by the share `crowding`.
    """
    along = np.arange(2 * core + 1) / (2 * core)
    shifted = along - crowding * along * (1 - along) ** 6
    roundness = 0.6  # of the core: 0 a square, 1 a quarter disk with a flat (degenerate) corner
    outer = radii[-1]
    skin_radii = outer + skin * (np.arange(skin_layers) + 1) / max(skin_layers, 1)
    shares = np.concatenate(
        [[0.0], (radii - core_mm) / (outer - core_mm), skin_radii / outer]
    )  # above 1: true circles

    def core_point(i: float, j: float) -> np.ndarray:
        square = np.array([i / core, j / core])
        length = np.hypot(*square)
        circle = square * square.max() / length if length else square
        return core_mm * ((1 - roundness) * square + roundness * circle)

    def layer_point(t: float, share: float) -> np.ndarray:
        plain, crowded = (
            t / (2 * core),
            np.interp(t, np.arange(2 * core + 1), shifted),
        )  # mid-sides stay in the middle
        angle = (plain + min(share, 1.0) * (crowded - plain)) * np.pi / 2
        circle = outer * np.array([np.cos(angle), np.sin(angle)])
        if share >= 1:
            return share * circle
        rim = core_point(core, t) if t <= core else core_point(2 * core - t, core)
        return (1 - share) * rim + share * circle

    index: dict[tuple[float, float], int] = {}
    points: list[np.ndarray] = []

    def add(point: np.ndarray) -> int:
        key = (round(point[0], 7) + 0.0, round(point[1], 7) + 0.0)
        if key not in index:
            index[key] = len(points)
            points.append(point)
        return index[key]

    offsets = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5)]
    elements, block = [], []
    for i in range(core):
        for j in range(core):
            elements.append([add(core_point(i + a, j + b)) for a, b in offsets])
            block.append(-1)
    for layer in range(len(shares) - 1):
        share = {
            0: shares[layer],
            0.5: 0.5 * (shares[layer] + shares[layer + 1]),
            1: shares[layer + 1],
        }
        for t in range(2 * core):
            elements.append([add(layer_point(t + b, share[a])) for a, b in offsets])
            block.append(layer)
    return np.array(points), np.array(elements), np.array(block)


def _surface_edges(points: np.ndarray, elements: np.ndarray, on_surface: np.ndarray) -> np.ndarray:
    edges = elements[:, _EDGES].reshape(-1, 3)
    return _from_the_axis(points, edges[on_surface[edges].all(axis=1)])


def find_inner_face(mesh: Mesh) -> Int[np.ndarray, "S 3"]:
    """Edges between skin and gel, from the axis outwards."""
    of_skin, of_gel = (
        mesh.elements[part][:, _EDGES].reshape(-1, 3) for part in (mesh.skin, ~mesh.skin)
    )
    return _from_the_axis(mesh.nodes, of_skin[np.isin(of_skin[:, 1], of_gel[:, 1])])


def _from_the_axis(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Edges (S, 3) of one line in order, each with the end first that is nearer to the axis."""
    r = points[:, 0]
    edges = np.where((r[edges[:, 0]] > r[edges[:, 2]])[:, None], edges[:, ::-1], edges)
    return edges[np.argsort(r[edges[:, 1]])]
