"""Sums over the harmonics of rings, for single nodes of the ring lattice 1 + 6 + 12 + ...

A unit force at a node is spread with a hat of the angle, as wide as the node's two neighbours. In
the node's own frame (radial, tangential, up) harmonic m of it is diag(1, i, 1)-times real, and so
is every displacement in the frame of its own angle. Two points at angles a and b depend on each
other through cos m(a - b) and sin m(a - b) alone.
"""

import numpy as np
from jaxtyping import Float, Int

# Which pairs (displacement, force) of radial, tangential, up go with sin m(a - b), and its sign.
# The others go with the cosine.
_ODD = np.array([[0, -1, 0], [1, 0, 1], [0, -1, 0]])


def compute_ring_sizes(rings: int) -> Int[np.ndarray, "{rings}"]:
    """Compute the number of nodes of each ring."""
    return np.maximum(6 * np.arange(rings), 1)


def make_ring_lattice(rings: int) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Make the ring and angle (rad) of each of the N nodes, ring by ring, from +x to +y."""
    sizes = compute_ring_sizes(rings)
    angles = [np.arange(size) * 2 * np.pi / size for size in sizes]
    return np.repeat(np.arange(rings), sizes), np.concatenate(angles)


def spread_forces(rings: int, harmonics: int) -> Float[np.ndarray, "{harmonics+1} {rings} 3 3"]:
    """Compute the real part of harmonic m, (U, V, W) per unit force, at angle 0.

    Forces are radial, tangential, up.
    """

    def compute_hat(order: np.ndarray) -> np.ndarray:
        width = 2 * np.pi / compute_ring_sizes(rings)[1:]
        around = np.sinc(order[:, None] * width / (2 * np.pi)) ** 2
        # the apex has no angle
        return np.concatenate([(order == 0)[:, None], around], axis=1) / (2 * np.pi)

    m = np.arange(harmonics + 1)
    before, after = compute_hat(m - 1), compute_hat(m + 1)
    along = (before + after) / 2  # times the cosine of the angle
    across = (before - after) / 2  # times its sine
    forces = np.zeros((*along.shape, 3, 3))
    forces[..., 0, 0] = forces[..., 1, 1] = along
    forces[..., 0, 1] = forces[..., 1, 0] = -across
    forces[..., 2, 2] = compute_hat(m)
    return forces


def make_sixfold_permutations(count: int) -> Int[np.ndarray, "6 {count}"]:
    """Make the permutations of the ring lattice 1 + 6 + 12 + ... by turns of 60 degrees.

    [k, i] is the node where node i comes to lie when the lattice turns by +60 k degrees. Raises
    ValueError where `count` nodes do not fill complete rings.
    """
    rings = (1 + np.sqrt(max(4 * count - 1, 1) / 3)) / 2
    if rings != round(rings) or count < 1:
        raise ValueError(f"{count} nodes do not fill complete rings 1 + 6 + 12 + ...")
    permutations = [np.zeros((6, 1), int)]
    for k in range(1, round(rings)):
        first, sixths = 1 + 3 * k * (k - 1), np.arange(6)[:, None]
        permutations.append(first + (np.arange(6 * k) + k * sixths) % (6 * k))
    return np.concatenate(permutations, axis=1)


def compute_node_compliance(between: Float[np.ndarray, "M R3 R3"]) -> Float[np.ndarray, "N3 N3"]:
    """Compute the symmetric compliance of nodes from that between rings.

    `between` is the rings' mean displacement (U, V, W) per load (U, V, W) on rings. Only forces on
    one sixth of the nodes are summed; the other columns are these, turned.
    """
    rings = between.shape[1] // 3
    forces = spread_forces(rings, len(between) - 1)
    blocks = between.reshape(-1, rings, 3, rings, 3)
    mean = 2 * np.pi * np.einsum("mkap,mkalb->mkplb", forces, blocks)
    ring, angle = make_ring_lattice(rings)
    sector = np.flatnonzero(angle < np.pi / 3 - 1e-9)
    part = _sum_at_points(mean, ring, angle, forces, sector)
    w = np.empty((len(ring), 3, len(ring), 3))
    permutations = make_sixfold_permutations(len(ring))
    for sixth in range(6):
        columns = _turn(part, sixth * np.pi / 3, sixth * np.pi / 3)
        columns = np.moveaxis(columns, (0, 1), (1, 3))[permutations[-sixth]]
        images = permutations[sixth][sector]
        for number in range(rings):  # neighbours stay neighbours: copied in one piece
            here = np.flatnonzero(ring[sector] == number)[[0, -1]]
            first, last = images[here]
            w[:, :, first : last + 1] = columns[:, :, here[0] : here[1] + 1]
    between_nodes = w.reshape(3 * len(ring), -1)
    return (between_nodes + between_nodes.T) / 2


def compute_point_compliance(
    fields: Float[np.ndarray, "M Q3 R3"], place: Int[np.ndarray, "P"], angle: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "3*P N3"]:
    """Compute the compliance of points from displacements at Q places of the half-plane.

    Point p is at place[p], angle[p].
    """
    rings = fields.shape[2] // 3
    blocks = fields.reshape(len(fields), -1, 3, rings, 3)
    g = _sum_at_points(blocks, place, angle, spread_forces(rings, len(fields) - 1), slice(None))
    return np.moveaxis(g, (0, 1), (1, 3)).reshape(3 * len(place), -1)


def _sum_at_points(
    fields: np.ndarray,
    place: np.ndarray,
    angle: np.ndarray,
    forces: np.ndarray,
    nodes: np.ndarray | slice,
) -> np.ndarray:
    """Sum the displacements of P points at (place, angle) under unit forces at K `nodes`.

    `fields` (M, Q, 3, R, 3) are the harmonics at Q places. The result is (3, 3, P, K): directions
    of the points, directions of the forces, points, nodes.
    """
    fields = np.einsum("mqalb,mlbc->qacml", fields, forces)
    fields[..., 1:, :] *= 2  # m and -m
    ring, source = make_ring_lattice(forces.shape[1])
    ring, source = ring[nodes], source[nodes]
    m = np.arange(len(forces))[:, None]
    cos, sin = np.cos(m * source), np.sin(m * source)
    even, odd = np.stack([cos, sin]), np.stack([-sin, cos])
    total = np.empty((3, 3, len(place), len(source)))
    for number in np.unique(place):
        here = np.flatnonzero(place == number)
        waves = np.concatenate([np.cos(m * angle[here]), np.sin(m * angle[here])]).T
        local = np.empty((3, 3, len(here), len(source)))
        for a, b in np.ndindex(3, 3):
            partners = fields[number, a, b][:, ring] * (_ODD[a, b] * odd if _ODD[a, b] else even)
            local[a, b] = waves @ partners.reshape(-1, len(source))
        total[:, :, here] = _turn(local, angle[here][:, None], source)
    return total


def _turn(vectors: np.ndarray, first: np.ndarray | float, second: np.ndarray | float) -> np.ndarray:
    """Turn both directions of (3, 3, P, K) about z, by angles that broadcast against (P, K)."""
    for angle in (first, second):
        cos, sin = np.cos(angle), np.sin(angle)
        x, y, z = vectors
        vectors = np.stack([cos * x - sin * y, sin * x + cos * y, z]).swapaxes(0, 1)
    return vectors
