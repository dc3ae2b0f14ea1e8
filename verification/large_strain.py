"""The dome at large strain, pressed by a flat plate without friction.

It is a reference for the linear dome.

    presses = press_dome(TACTIP_331, (1.0, 3.0, 6.0))
    presses.force_n[presses.converged], presses.pins  # (D,) N, (D, 331, 3) mm

Equilibrium is a stationary point of energy - sum_c l_c gap_c with l_c >= 0, gap_c >= 0, l_c gap_c =
0 at two points c of each surface edge. The plate pushes along z only, so skin slides on it.
Displacement and active set are found together by a semismooth Newton method (Hueber & Wohlmuth
2005, CMAME 194, 3147), each increment of depth starting from the line through the last two.
Newton's steps are cut where they would squeeze an element; where that does not help, the increment
is halved.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float
from scipy.sparse.linalg import splu

from jaxunshear.config.sensor import Sensor
from jaxunshear.progress import Progress
from jaxunshear.simulator.elasticity import compute_lame_constants
from jaxunshear.simulator.mesh import Mesh, compute_edge_shapes, find_inner_face, make_dome_mesh
from jaxunshear.simulator.pin_layout import compute_pin_lattice, compute_pin_tips
from verification.hyperelastic import (
    Body,
    Density,
    compute_deformation,
    compute_forces,
    compute_tangent,
    make_body,
    neo_hookean,
)

STEP_MM = 0.25  # largest increment of depth
SMALLEST_STEP_MM = STEP_MM / 32
ITERATIONS = 20
TOLERANCE = 1e-9  # unbalanced force over the largest nodal force
GAP_MM = 1e-9  # by which a touching point may miss the plate
SMALLEST_VOLUME = 0.5  # of its own to which an iterate may squeeze matter
SMALLEST_SHARE = 1 / 8  # of a Newton step: below it a smaller increment of depth is worth more
LARGE_STRAIN = 0.2

_EDGE_GAUSS = np.array([-1, 1]) / np.sqrt(3)


class LargeStrain(NamedTuple):
    """Presses to D depths (numpy). The physical fields of one that did not converge are NaN."""

    force_n: np.ndarray  # (D,) along z, on the sensor
    contact_radius_mm: np.ndarray  # (D,) on the plate
    pins: np.ndarray  # (D, P, 3) mm, displaced pin tips in the sensor frame
    # (D,) share of the gel's volume with a principal strain (stretch - 1) beyond LARGE_STRAIN
    strained: np.ndarray
    converged: np.ndarray  # (D,) bool


class Face(NamedTuple):
    """Points of the surface where the plate may press."""

    rows: sp.csr_matrix  # (C, V) from the nodes' displacement to theirs
    place: np.ndarray  # (C, 2) mm, at rest


class State(NamedTuple):
    displacement: np.ndarray  # (V, 2) mm
    push: np.ndarray  # (C,) N at the points of the face
    iterations: int
    converged: bool


def press_dome(
    sensor: Sensor,
    depths_mm: Sequence[float],
    mesh_mm: float = 1.0,
    density: Density = neo_hookean,
    progress: Progress | None = None,
) -> LargeStrain:
    """Press the dome to D rising depths in mm, below half its radius.

    `density` is as `hyperelastic.neo_hookean`.
    """
    body = make_dome_body(sensor, mesh_mm, density)
    face = make_face(body.mesh)
    states = follow_depths(body, face, np.asarray(depths_mm, float), progress)
    rows = [
        _describe_press(sensor, body, face, state, depth)
        for state, depth in zip(states, depths_mm, strict=True)
    ]
    return LargeStrain(*map(np.array, zip(*rows, strict=True)))


def make_dome_body(sensor: Sensor, mesh_mm: float, density: Density = neo_hookean) -> Body:
    """Make the body of the sensor's gel under its skin."""
    mesh = make_dome_mesh(sensor.dome_radius_mm, sensor.skin_mm, mesh_mm)
    skin = compute_lame_constants(sensor.skin_modulus_mpa, sensor.skin_poisson)
    gel = compute_lame_constants(sensor.gel_modulus_mpa, sensor.gel_poisson)
    shear, first = np.where(mesh.skin[:, None], skin, gel).T
    return make_body(mesh, shear, first, density)


def make_face(mesh: Mesh) -> Face:
    """Make the face with two points per edge.

    Those are as many as the nodes that an edge adds, so that pressures are neither under- nor
    overdetermined.
    """
    line, _ = compute_edge_shapes(_EDGE_GAUSS)
    columns = np.repeat(mesh.surface, len(line), axis=0)
    rows = np.repeat(np.arange(len(columns)), 3)
    entries = np.tile(line, (len(mesh.surface), 1)).ravel()
    matrix = sp.csr_matrix(
        (entries, (rows, columns.ravel())), shape=(len(columns), len(mesh.nodes))
    )
    return Face(matrix, matrix @ mesh.nodes)


def follow_depths(
    body: Body, face: Face, depths: Float[np.ndarray, "D"], progress: Progress | None = None
) -> list[State]:
    """Follow rising `depths` (mm of the plate's z); after one that fails, all fail."""
    state = State(np.zeros_like(body.mesh.nodes), np.zeros(len(face.place)), 0, True)
    # per mm of depth
    moving, pushing = np.zeros_like(state.displacement), np.zeros_like(state.push)
    at, step, states = min(float(depths[0]), 0.0), STEP_MM, []
    for end in depths:
        first = True
        while state.converged and (at < end or first):
            there = min(at + step, end)
            moved = state.displacement + (there - at) * moving
            guess = State(moved, state.push + (there - at) * pushing, 0, False)
            after = solve_equilibrium(body, face, there, guess, body.fixed_unknowns)
            first = False
            if after.converged:
                if there > at:
                    moving = (after.displacement - state.displacement) / (there - at)
                    pushing = (after.push - state.push) / (there - at)
                state, at, step = after, there, min(2 * step, STEP_MM)
            elif (step := step / 2) < SMALLEST_STEP_MM:
                state = after
        states.append(state)
        if progress is not None:
            progress.advance(1)
    return states


def solve_equilibrium(
    body: Body, face: Face, depth: float, start: State, fixed: np.ndarray
) -> State:
    """Solve for equilibrium with the plate at z = `depth` mm by Newton's method.

    It begins at `start`. The unknowns `fixed` keep their displacement.
    """
    free = np.setdiff1d(np.arange(2 * len(body.mesh.nodes)), fixed)
    normal = sp.kron(face.rows, sp.csr_matrix([[0.0, 1.0]])).tocsr()  # (C, 2V)
    # N/mm, weighs a gap against a push
    stiff = float(np.median(body.shear_modulus) * np.ptp(body.mesh.nodes[:, 0]))
    moved, push = start.displacement, start.push
    for count in range(ITERATIONS + 1):
        inner = compute_forces(body, moved)
        gap = face.place[:, 1] + face.rows @ moved[:, 1] - depth
        active = push - stiff * gap > 0
        unbalanced = np.abs((inner - normal.T @ push)[free]).max()
        residual = unbalanced / max(np.abs(inner).max(), stiff * GAP_MM)
        wrong = np.where(active, np.abs(gap), np.abs(push) / stiff).max(initial=0.0)
        if residual < TOLERANCE and wrong < GAP_MM:
            return State(moved, push, count, True)
        if count == ITERATIONS or not np.isfinite(residual):
            break
        touching = normal[active][:, free]
        tangent = compute_tangent(body, moved)[free][:, free]
        matrix = sp.bmat([[tangent, -touching.T], [-touching, None]], format="csc")
        right = np.concatenate([-inner[free], gap[active]])
        try:
            solution = splu(matrix, permc_spec="COLAMD").solve(right)
        except RuntimeError:  # singular
            break
        step, goal = np.zeros(moved.size), np.zeros_like(push)
        step[free], goal[active] = solution[: len(free)], solution[len(free) :]
        share = _choose_share(body, moved, step.reshape(moved.shape))
        if share < SMALLEST_SHARE:
            break
        moved, push = moved + share * step.reshape(moved.shape), push + share * (goal - push)
    return State(moved, push, count, False)


def _choose_share(body: Body, moved: np.ndarray, step: np.ndarray) -> float:
    """Choose the largest share 1, 1/2, 1/4 ... of a step that squeezes nothing too much."""
    share = 1.0
    while share >= SMALLEST_SHARE:
        _, volume_ratios = compute_deformation(body, moved + share * step)
        if not volume_ratios.min() < SMALLEST_VOLUME:
            break
        share /= 2
    return share


def _describe_press(
    sensor: Sensor, body: Body, face: Face, state: State, depth: float
) -> LargeStrain:
    """Compute the fields at one depth, without their first axis."""
    if not state.converged:
        pins = np.full((sensor.pins, 3), np.nan)
        return LargeStrain(np.nan, np.nan, pins, np.nan, False)  # type: ignore[arg-type]
    stretches, _ = compute_deformation(body, state.displacement)
    volume = body.volume[~body.mesh.skin]
    beyond = np.any(np.abs(stretches[~body.mesh.skin] - 1) > LARGE_STRAIN, axis=-1)
    place = face.place + face.rows @ state.displacement
    radius = fit_contact_radius(place[:, 0], place[:, 1] - depth, state.push > 0)
    pins = compute_deformed_tips(sensor, body.mesh, state.displacement)
    strained = np.sum(volume * beyond) / np.sum(volume)
    return LargeStrain(state.push.sum(), radius, pins, strained, True)  # type: ignore[arg-type]


def fit_contact_radius(
    radius: Float[np.ndarray, "C"], gap: Float[np.ndarray, "C"], touching: Bool[np.ndarray, "C"]
) -> float:
    """Fit the radius in mm at which the gap closes, from points in rising radius.

    Past the rim the gap opens as (r - a)^1.5 (Johnson 1985, Contact Mechanics, sec. 4.2), so its
    power 2/3 is a line through the first two points that do not touch.
    """
    if not touching.any():
        return 0.0
    last = np.flatnonzero(touching)[-1]
    if last + 2 >= len(radius):
        return float(radius[last])
    near, far = np.maximum(gap[last + 1 : last + 3], 0.0) ** (2 / 3)
    inner, outer = radius[last + 1 : last + 3]
    rim = inner - near * (outer - inner) / (far - near) if far > near else inner
    return float(np.clip(rim, radius[last], inner))


def compute_deformed_tips(
    sensor: Sensor, mesh: Mesh, moved: Float[np.ndarray, "V 2"]
) -> Float[np.ndarray, "P 3"]:
    """Compute the displaced pin tips in mm: rigid levers on the skin's inner face."""
    flat = compute_pin_lattice(sensor)
    arc = np.linalg.norm(flat, axis=-1)
    arcs, index = np.unique(np.round(arc, 9), return_inverse=True)
    deformed = _place_tips(sensor, mesh, mesh.nodes + moved, arcs)
    change = (deformed - _place_tips(sensor, mesh, mesh.nodes, arcs))[index.ravel()]
    around = np.divide(flat, arc[:, None], out=np.zeros_like(flat), where=arc[:, None] > 0)
    return compute_pin_tips(sensor) + np.concatenate([change[:, :1] * around, change[:, 1:]], -1)


def _place_tips(sensor: Sensor, mesh: Mesh, nodes: np.ndarray, arcs: np.ndarray) -> np.ndarray:
    """Place the tips (A, 2) of pins at `arcs` (A,) mm of arc on the outer surface."""
    edges = find_inner_face(mesh)
    rest = mesh.nodes[edges]
    # (S, 3), evenly spaced on each edge
    angles = np.arctan2(rest[..., 0], sensor.dome_radius_mm - rest[..., 1])
    angle = arcs / sensor.dome_radius_mm
    edge = np.clip(np.searchsorted(angles[:, 0], angle, side="right") - 1, 0, len(edges) - 1)
    along_edge = 2 * (angle - angles[edge, 0]) / (angles[edge, 2] - angles[edge, 0]) - 1
    values, slopes = compute_edge_shapes(along_edge)
    base = np.einsum("an,anx->ax", values, nodes[edges[edge]])
    tangent = np.einsum("an,anx->ax", slopes, nodes[edges[edge]])
    inward = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    inward /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    return base + sensor.pin_length_mm * inward
