"""Sums over harmonics against integrals over the angle, done by brute force."""

import numpy as np
import pytest

from jaxunshear.simulator.harmonics import (
    compute_node_compliance,
    compute_point_compliance,
    compute_ring_sizes,
    make_ring_lattice,
    make_sixfold_permutations,
    spread_forces,
)

RINGS, HARMONICS, PLACES = 3, 14, 2
FINE = 2 * np.pi * np.arange(4000) / 4000


@pytest.fixture(scope="module")
def made_up():
    """Real, symmetric responses of rings, arbitrary ones of places; the apex bears m = 0 and 1."""
    generator = np.random.default_rng(0)
    between = generator.normal(size=(HARMONICS + 1, 3 * RINGS, 3 * RINGS))
    fields = generator.normal(size=(HARMONICS + 1, 3 * PLACES, 3 * RINGS))
    between[2:, :3] = between[2:, :, :3] = fields[2:, :, :3] = 0
    return between + between.swapaxes(1, 2), fields


def hat(node: int) -> np.ndarray:
    """Density in angle of a node's force, at FINE; its integral is 1."""
    ring, angle = (values[node] for values in make_ring_lattice(RINGS))
    width = 2 * np.pi / compute_ring_sizes(RINGS)[ring]
    away = (FINE - angle + np.pi) % (2 * np.pi) - np.pi
    shape = np.maximum(1 - np.abs(away) / width, 0) if ring else np.ones_like(FINE)
    return shape / shape.mean() / (2 * np.pi)


def cylindrical(direction: np.ndarray) -> np.ndarray:
    """A constant direction in radial, tangential, up at FINE, (3, 4000)."""
    cos, sin = np.cos(FINE), np.sin(FINE)
    x, y, z = direction
    return np.stack([cos * x + sin * y, -sin * x + cos * y, z * np.ones_like(FINE)])


def displacement(response: np.ndarray, source: int, direction: np.ndarray) -> np.ndarray:
    """Responses (targets, 3, 4000) around the axis to a unit force at a node, by harmonics."""
    ring = make_ring_lattice(RINGS)[0][source]
    total = np.zeros((response.shape[1] // 3, 3, len(FINE)), complex)
    for m in range(HARMONICS + 1):
        wave = np.exp(-1j * m * FINE)
        load = (cylindrical(direction) * hat(source) * wave).mean(-1)  # of exp(i m theta)
        load = load * np.array([1, 1j, 1])  # u_theta = -i V
        answer = response[m].reshape(-1, 3, RINGS, 3)[:, :, ring] @ load
        answer = answer * np.array([1, -1j, 1]) * (1 if m == 0 else 2)
        total += answer[..., None] * np.exp(1j * m * FINE)
    return total.real


@pytest.mark.parametrize("source", [0, 3, 12])
def test_sums_are_integrals(made_up, source):
    between, fields = made_up
    w = compute_node_compliance(between).reshape(-1, 3, 19, 3)
    angle = np.array([0.0, 0.7, 2.0])
    g = compute_point_compliance(fields, np.array([0, 1, 1]), angle).reshape(3, 3, 19, 3)
    for axis in range(3):
        around = displacement(between, source, np.eye(3)[axis])
        for target in range(19):
            seen = around[make_ring_lattice(RINGS)[0][target]] * hat(target) * 2 * np.pi
            mean = [(cylindrical(unit) * seen).sum(0).mean() for unit in np.eye(3)]
            np.testing.assert_allclose(w[target, :, source, axis], mean, atol=1e-4)
        around = displacement(fields, source, np.eye(3)[axis])
        for point, place in enumerate([0, 1, 1]):
            radial, tangential, up = (np.interp(angle[point], FINE, line) for line in around[place])
            cos, sin = np.cos(angle[point]), np.sin(angle[point])
            there = [cos * radial - sin * tangential, sin * radial + cos * tangential, up]
            np.testing.assert_allclose(g[point, :, source, axis], there, atol=1e-4)


def test_a_nodes_force_adds_up_to_one_newton():
    """Its mean over the angle is harmonic 0 (up) or 1 (sideways)."""
    forces = spread_forces(RINGS, HARMONICS)
    np.testing.assert_allclose(2 * np.pi * forces[0, :, 2, 2], 1)
    sideways = forces[1, :, 0, 0] - forces[1, :, 1, 0]  # x of radial and tangential parts
    np.testing.assert_allclose(2 * np.pi * sideways, 1)


def test_sixfold_turns_the_lattice():
    ring, angle = make_ring_lattice(4)
    turned = make_sixfold_permutations(37)
    for sixth in range(6):
        image = turned[sixth]
        np.testing.assert_array_equal(ring[image], ring)
        apart = (angle[image] - angle - sixth * np.pi / 3)[1:]
        np.testing.assert_allclose(np.exp(1j * apart), 1, atol=1e-12)
        np.testing.assert_array_equal(np.sort(image), np.arange(37))
    for count in (0, 2, 8, 36):
        with pytest.raises(ValueError, match="do not fill complete rings"):
            make_sixfold_permutations(count)
