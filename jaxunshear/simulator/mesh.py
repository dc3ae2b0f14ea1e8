"""Meshes of a body of revolution: 8-node quadrilaterals in the half-plane (r, z), and pins on them.

The dome is a quarter disk: a square core on the axis, then layers out to the arc, so that no
element degenerates. A pad is a rectangle. Read `make_dome_mesh` first.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxunshear.errors import UserError

# corners, then mid-sides, counter-clockwise in the reference square [-1, 1]^2
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
_SIDES = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float)
_EDGES = [[0, 4, 1], [1, 5, 2], [2, 6, 3], [3, 7, 0]]  # of an element: end, middle, end
GAUSS = _CORNERS[[0, 1, 3, 2]] / np.sqrt(3)  # 2 x 2 points of reduced integration
_PLACES = (np.concatenate([_CORNERS, _SIDES]) + 1).astype(int)  # in half sides of an element
_ON_AXIS_MM = 1e-9
MIN_SKIN_LAYERS, MIN_GEL_LAYERS = 2, 6  # of a pad: a thin layer bends and shears


@dataclass(frozen=True)
class Mesh:
    """V nodes and E elements of a half-plane."""

    nodes: np.ndarray  # (V, 2) r, z in mm
    elements: np.ndarray  # (E, 8)
    skin: np.ndarray  # (E,) bool
    clamped: np.ndarray  # node indices
    surface: np.ndarray  # (S, 3) edges (end, middle, end) from the axis outwards

    @property
    def axis(self) -> np.ndarray:
        return np.flatnonzero(self.nodes[:, 0] < 1e-9)


def compute_shape_functions(
    local: Float[np.ndarray, "Q 2"],
) -> tuple[Float[np.ndarray, "Q 8"], Float[np.ndarray, "Q 8 2"]]:
    """Compute the serendipity shape functions: values and local gradients."""
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
    gradients = np.stack([np.concatenate(in_x, 1), np.concatenate(in_y, 1)], -1)
    return np.concatenate(values, 1), gradients


class Samples(NamedTuple):
    """Q points of each of E elements."""

    values: np.ndarray  # (Q, 8) shape functions
    slopes: np.ndarray  # (E, Q, 8, 2) of these, in r and z
    area: np.ndarray  # (E, Q) of the half-plane per unit of the reference square
    r: np.ndarray  # (E, Q)


def sample_elements(mesh: Mesh, local: Float[np.ndarray, "Q 2"]) -> Samples:
    """Sample every element at points of the reference square."""
    corners = mesh.nodes[mesh.elements]
    values, gradients = compute_shape_functions(local)
    jacobian = np.einsum("qnl,enx->eqlx", gradients, corners)
    slopes = np.einsum("eqxl,qnl->eqnx", np.linalg.inv(jacobian), gradients)
    r = np.einsum("qn,en->eq", values, corners[..., 0])
    return Samples(values, slopes, np.abs(np.linalg.det(jacobian)), r)


def compute_edge_shapes(
    s: Float[np.ndarray, "S"],
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Compute shape functions and slopes of an edge (end, middle, end) at s in [-1, 1]."""
    values = np.stack([s * (s - 1) / 2, 1 - s**2, s * (s + 1) / 2], -1)
    return values, np.stack([s - 0.5, -2 * s, s + 0.5], -1)


def make_dome_mesh(radius: float, skin: float, h: float) -> Mesh:
    """Make a hemisphere of `radius` under a skin, clamped at its base plane.

    Elements have about the size h. Lengths are in mm; z runs from the apex (z = 0) to the base (z =
    radius). Elements crowd at the rim, where stresses have no bound: that removes three quarters of
    the error, at no cost.
    """
    inner = radius - skin
    core = max(round(0.61 * radius / h), 2)
    layers = max(round(0.5 * inner / h), 2)
    skin_layers = max(round(skin / h), 1)
    radii = np.linspace(0.5 * inner, inner, layers + 1)[1:]
    skin_radii = inner + skin * (np.arange(skin_layers) + 1) / skin_layers
    disk = QuarterDisk(0.5 * inner, core, radii, skin_radii, crowding=0.9)
    points, elements, layer = disk.make_elements()
    nodes = np.stack([points[:, 0], radius - points[:, 1]], -1)
    skin_elements = layer >= layers
    on_arc = np.abs(np.hypot(*points.T) - radius) < 1e-6 * radius
    clamped = np.flatnonzero(points[:, 1] < 1e-9)
    return Mesh(nodes, elements, skin_elements, clamped, find_edges(points, elements, on_arc))


def make_pad_mesh(radius: float, thickness: float, skin: float, h: float) -> Mesh:
    """Make a round pad of `radius` under a skin, clamped at the plate behind it.

    Elements have at most about the size h, and there are at least two in the skin and six in the
    gel. Lengths are in mm; z runs from the face (z = 0) to the plate (z = `thickness`).
    """
    gel = thickness - skin
    layers = max(round(skin / h), MIN_SKIN_LAYERS), max(round(gel / h), MIN_GEL_LAYERS)
    heights = np.concatenate(
        [np.linspace(0, skin, layers[0] + 1)[:-1], np.linspace(skin, thickness, layers[1] + 1)]
    )
    across = np.linspace(0, radius, max(round(radius / h), 2) + 1)
    r, z = _insert_middles(across), _insert_middles(heights)
    corner = np.stack(np.meshgrid(np.arange(len(across) - 1), np.arange(len(heights) - 1)), -1)
    corner = 2 * corner.reshape(-1, 2)
    nodes, number = np.unique(
        (corner[:, None] + _PLACES).reshape(-1, 2), axis=0, return_inverse=True
    )
    points = np.stack([r[nodes[:, 0]], z[nodes[:, 1]]], axis=-1)
    elements = number.reshape(-1, 8)
    return Mesh(
        points,
        elements,
        corner[:, 1] < 2 * layers[0],
        np.flatnonzero(nodes[:, 1] == len(z) - 1),
        find_edges(points, elements, nodes[:, 1] == 0),
    )


def _insert_middles(ends: np.ndarray) -> np.ndarray:
    return np.insert(ends, np.arange(1, len(ends)), (ends[1:] + ends[:-1]) / 2)


class DiskElements(NamedTuple):
    points: np.ndarray  # (V, 2)
    elements: np.ndarray  # (E, 8)
    layer: np.ndarray  # (E,) -1 in the core


@dataclass(frozen=True)
class QuarterDisk:
    """A quarter disk: a core of `core` x `core` elements, then layers of 2 x `core` elements.

    Elements where the second coordinate is zero are narrower along the arc by the share `crowding`.
    """

    core_mm: float
    core: int
    radii: np.ndarray  # where each layer ends, mm
    skin_radii: np.ndarray  # where each layer of a skin beyond them ends, mm
    crowding: float = 0.0

    def make_elements(self) -> DiskElements:
        # the corners and mid-sides of an element, as shares of it
        offsets = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5)]
        corners, layers = [], []
        for i in range(self.core):
            for j in range(self.core):
                corners += [self._place_in_core(i + a, j + b) for a, b in offsets]
                layers.append(-1)
        for layer, (inner, outer) in enumerate(pairwise(self._compute_shares())):
            share = {0: inner, 0.5: 0.5 * (inner + outer), 1: outer}
            for t in range(2 * self.core):
                corners += [self._place_in_layer(t + b, share[a]) for a, b in offsets]
                layers.append(layer)
        # each place once, numbered as they first occur
        rounded = np.round(corners, 7) + 0.0
        _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        elements = np.argsort(order)[number.ravel()].reshape(-1, 8)
        return DiskElements(np.array(corners)[first[order]], elements, np.array(layers))

    def _compute_shares(self) -> np.ndarray:
        """Compute where layers end, between the core (0) and the last radius (1), or beyond it."""
        last = self.radii[-1]
        inner = (self.radii - self.core_mm) / (last - self.core_mm)
        return np.concatenate([[0.0], inner, self.skin_radii / last])

    def _place_in_core(self, i: float, j: float) -> np.ndarray:
        roundness = 0.6  # 0 a square, 1 a quarter disk with a flat (degenerate) corner
        square = np.array([i / self.core, j / self.core])
        length = np.hypot(*square)
        circle = square * square.max() / length if length else square
        return self.core_mm * ((1 - roundness) * square + roundness * circle)

    def _place_in_layer(self, t: float, share: float) -> np.ndarray:
        """Place a point `t` elements along the arc; true circles where share >= 1."""
        core = self.core
        plain, crowded = t / (2 * core), self._crowd(t)
        angle = (plain + min(share, 1.0) * (crowded - plain)) * np.pi / 2
        circle = self.radii[-1] * np.array([np.cos(angle), np.sin(angle)])
        if share >= 1:
            return share * circle
        rim = self._place_in_core(core, t) if t <= core else self._place_in_core(2 * core - t, core)
        return (1 - share) * rim + share * circle

    def _crowd(self, t: float) -> float:
        """Compute where along the arc the end of element `t` lies; mid-sides stay in the middle."""
        along = np.arange(2 * self.core + 1) / (2 * self.core)
        shifted = along - self.crowding * along * (1 - along) ** 6
        return float(np.interp(t, np.arange(2 * self.core + 1), shifted))


def find_edges(
    points: Float[np.ndarray, "V 2"],
    elements: Int[np.ndarray, "E 8"],
    on_surface: Bool[np.ndarray, "V"],
) -> Int[np.ndarray, "S 3"]:
    """Find the elements' edges on the surface, from the axis outwards."""
    edges = elements[:, _EDGES].reshape(-1, 3)
    return _sort_edges(points, edges[on_surface[edges].all(axis=1)])


def find_inner_face(mesh: Mesh) -> Int[np.ndarray, "S 3"]:
    """Find the edges between skin and gel, from the axis outwards."""
    skin_edges = mesh.elements[mesh.skin][:, _EDGES].reshape(-1, 3)
    gel_edges = mesh.elements[~mesh.skin][:, _EDGES].reshape(-1, 3)
    return _sort_edges(mesh.nodes, skin_edges[np.isin(skin_edges[:, 1], gel_edges[:, 1])])


def _sort_edges(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Sort the edges (S, 3) of one line outwards, each with the end nearer to the axis first."""
    r = points[:, 0]
    edges = np.where((r[edges[:, 0]] > r[edges[:, 2]])[:, None], edges[:, ::-1], edges)
    return edges[np.argsort(r[edges[:, 1]])]


def compute_interpolation(
    mesh: Mesh, points: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "3 P V"]:
    """Compute the shape functions at points of the half-plane, and their slopes.

    Slopes are in r and in z. Newton's method finds the point in each near element. Where elements
    meet, the result is their mean; their slopes along the line where they meet agree.
    """
    centres = mesh.nodes[mesh.elements[:, :4]].mean(1)
    at = np.zeros((3, len(points), len(mesh.nodes)))
    for p, point in enumerate(points):
        near = mesh.elements[np.argsort(np.sum((centres - point) ** 2, -1))[:32]]
        local = np.zeros((len(near), 2))
        for _ in range(20):
            values, gradients = compute_shape_functions(local)
            jacobian = np.einsum("enl,enx->exl", gradients, mesh.nodes[near])
            miss = point - np.einsum("en,enx->ex", values, mesh.nodes[near])
            local = np.clip(local + np.linalg.solve(jacobian, miss[..., None])[..., 0], -1.5, 1.5)
        inside = np.abs(local).max(axis=1) < 1 + 1e-6
        if not inside.any():
            raise UserError(
                f"pin at r = {point[0]:.2f} mm, z = {point[1]:.2f} mm lies outside the gel: "
                "check the sensor's pins"
            )
        slopes = np.einsum("enl,elx->xen", gradients, np.linalg.inv(jacobian))
        for entries, matrix in zip((values, *slopes), at, strict=True):
            np.add.at(matrix[p], near[inside], entries[inside] / inside.sum())
    return at


@dataclass(frozen=True)
class PinLevers:
    """Rigid pins at Q places of a face, along its normal."""

    places: np.ndarray  # (Q, 2) r, z
    levers: np.ndarray  # (Q, 2) from the place to the tip
    at: np.ndarray  # (3, Q, V) as `compute_interpolation` returns it

    def motion(self, field: Float[np.ndarray, "V3 K"], m: int) -> Float[np.ndarray, "Q3 K"]:
        """Compute harmonic m of the tips' displacement from displacements `field`.

        With length L, normal n and linearised rotation a tip moves by
        u - L [(n . du/ds) t + (n . du/ds_theta) theta], t being the tangent in the half-plane. On
        the axis the face turns with harmonic 1 alone, and 1/r becomes a slope.
        """
        value, in_r, in_z = np.einsum(
            "xqv,vuk->xuqk", self.at, field.reshape(-1, 3, field.shape[1]), optimize=True
        )
        r, length = self.places[:, :1], np.linalg.norm(self.levers, axis=1)[:, None]
        n_r, n_z = np.divide(
            self.levers, length, out=np.zeros_like(self.levers), where=length > 0
        ).T[..., None]
        on_axis = r < _ON_AXIS_MM
        over_r = np.where(on_axis, in_r, value / np.where(on_axis, 1.0, r))
        turned = length * (~on_axis | (m == 1))
        along = turned * (
            n_r * (n_z * in_r[0] - n_r * in_z[0]) + n_z * (n_z * in_r[2] - n_r * in_z[2])
        )
        around = turned * (n_r * (m * over_r[0] + over_r[1]) + n_z * m * over_r[2])
        tips = value + np.stack([-along * n_z, around, along * n_r])
        return tips.swapaxes(0, 1).reshape(-1, field.shape[1])
