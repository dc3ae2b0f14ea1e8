"""Normal contact against tamaas, an independent FFT solver of a periodic half-space.

Tamaas is described in Frerot et al. 2020, JOSS 5(51), 2121. Ours is not periodic. Both are given
the same total force; the copies of the load, with the even load that balances them in a period,
then only lift the entire contact, by 3.900265 P / (pi E* L) for a square period L (the constant is
that of the square Wigner lattice: Bonsall and Maradudin 1977, Phys. Rev. B 15, 1959); their
curvature falls with (a / L)^3.
"""

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import numpy as np

from verification.half_space import SPACING_MM, HalfSpace, make_press_poses, trace_forces
from verification.verification_rows import Row, Rows, fit_order

GROUP = "normal contact against tamaas"
PERIOD_MM, CELLS = 12.0, 480  # of its square grid
LATTICE = 3.900265
Profile = Callable[[np.ndarray, np.ndarray], np.ndarray]


def compute_sphere_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute by how many mm (...) the surface stands back from its highest point."""
    return (x**2 + y**2) / 100.0


def compute_two_sphere_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the height of two spheres of unlike radius and height, off the axis."""
    first = ((x + 0.5) ** 2 + y**2) / 60.0
    second = ((x - 0.52) ** 2 + (y - 0.15) ** 2) / 40.0 + 0.002
    return np.minimum(first, second)


def compute_rippled_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return compute_sphere_height(x, y) + 0.002 * (1 - np.cos(2 * np.pi * x / 1.2))


PROFILES = {
    "sphere": (compute_sphere_height, 0.0196),
    "two spheres": (compute_two_sphere_height, 0.011),
    "rippled sphere": (compute_rippled_height, 0.0185),
}
SCALES = np.array([0.5, 0.7, 1.0])  # of the profile, on the same nodes: smaller is coarser


def compare_with_tamaas(body: HalfSpace) -> list[Row]:
    """Compare pressed profiles; a single row says so if tamaas is not installed."""
    try:
        import tamaas
    except ImportError:
        note = "tamaas is not installed: pip install 'tamaas>=2.8'"
        return [Row(GROUP, "left out", None, float("nan"), float("nan"), note=note)]
    tamaas.set_log_level(tamaas.LogLevel.error)
    rows = []
    for name, (profile, depth) in PROFILES.items():
        rows += _compare_profile(tamaas, body, name, profile, depth)
    return rows


def _compare_profile(
    tamaas: ModuleType, body: HalfSpace, name: str, profile: Profile, depth: float
) -> list[Row]:
    forces, settled = [], True
    for scale in SCALES:
        height = scale * profile(*body.nodes[:, :2].T / scale)
        poses = make_press_poses(np.array([scale * depth]), 0)
        trace = trace_forces(body, height, poses, 0.0, tolerance=1e-6)
        forces.append(trace.force[-1, 0, :, 2])
        settled &= trace.settled
    total = forces[-1].sum()
    exact = _press_with_tamaas(tamaas, body, profile, total)
    line = exact.line
    distances, shapes = [], []
    for scale, force in zip(SCALES, forces, strict=True):
        shapes.append(_interpolate_on_grid(force / force.sum() / body.node_area, scale * line))
        theirs = exact.pressure / (scale**2 * total)
        cell = (scale * (line[1] - line[0])) ** 2
        distances.append(np.abs(shapes[-1] - theirs).sum() / 2 * cell)
    rows = Rows(GROUP, settled)
    rows.compare(f"{name}: depth at the same force, mm", exact.depth, depth, 0.01)
    words = f"{name}: share of the force at another place"
    order = fit_order(1 / SCALES, distances)
    rows.expect_zero(words, distances[-1], 1.0, 0.05, order=order, least_order=1.0)
    ours, theirs = _measure_extent(shapes[-1], line), _measure_extent(exact.pressure, line)
    for i, axis in enumerate("xy"):
        words = f"{name}: extent of the pressure along {axis}, mm"
        rows.compare(words, theirs[i], ours[i], 0.02)
    return rows


class _TamaasPress(NamedTuple):
    depth: float  # mm, of an endless half-space
    line: np.ndarray  # (CELLS,) mm, of the grid
    pressure: np.ndarray  # (CELLS, CELLS) MPa


def _press_with_tamaas(
    tamaas: ModuleType, body: HalfSpace, profile: Profile, total: float
) -> _TamaasPress:
    """Press a profile with a total force in N."""
    model = tamaas.Model(tamaas.model_type.basic_2d, [PERIOD_MM, PERIOD_MM], [CELLS, CELLS])
    model.E, model.nu = 1.0, body.poisson
    line = np.arange(CELLS) * PERIOD_MM / CELLS - PERIOD_MM / 2
    surface = -profile(*np.meshgrid(line, line, indexing="ij"))
    solver = tamaas.PolonskyKeerRey(model, surface, 1e-10)
    solver.solve(total / PERIOD_MM**2)
    pressure, lift = np.asarray(model.traction), np.asarray(model.displacement)
    touching = pressure > 0
    level = np.mean((lift - surface)[touching]) - lift.mean()
    depth = level + LATTICE * total / (np.pi * body.normal_modulus * PERIOD_MM)
    return _TamaasPress(depth, line, pressure)


def _interpolate_on_grid(nodal: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Interpolate nodal values (N,) on the square of `line` (C,).

    Hats of the radius times hats of the angle are those with which a node's force is spread.
    """
    x, y = np.meshgrid(line, line, indexing="ij")
    rings = round((1 + np.sqrt((4 * len(nodal) - 1) / 3)) / 2)
    inside = np.hypot(x, y) < (rings - 1) * SPACING_MM
    radius, angle = np.hypot(x, y)[inside] / SPACING_MM, np.arctan2(y, x)[inside] / (2 * np.pi)
    values = np.zeros(len(radius))
    ring = np.floor(radius).astype(int)
    for number, share in ((ring, 1 - radius + ring), (ring + 1, radius - ring)):
        size = np.maximum(6 * number, 1)
        first = np.where(number > 0, 1 + 3 * number * (number - 1), 0)
        place = (angle % 1.0) * size
        for step, part in ((0, 1 - place % 1), (1, place % 1)):
            values += share * part * nodal[first + (np.floor(place).astype(int) + step) % size]
    grid = np.zeros_like(x)
    grid[inside] = values
    return grid


def _measure_extent(pressure: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Measure the rms distance (2,) mm of the pressure (C, C) from the axis, along x and y."""
    return np.sqrt(np.array([pressure.sum(1), pressure.sum(0)]) @ line**2 / pressure.sum())
