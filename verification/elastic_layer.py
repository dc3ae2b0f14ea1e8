"""A pad against closed forms of an elastic layer on a rigid plate.

Pressure, or a pull, acts on a disk of the face. It is constant there and falls to zero from one
ring of nodes to the next. A wave of stress displaces the face by the stress times a factor, which
depends on the wavenumber k and the layer's thickness h. There is a factor for pressure, for a pull
along the wave, and for a pull across it (Johnson 1985, Contact Mechanics, 5.8). With a = k h, K = 3
- 4 nu and the shear modulus G they are:

    pressure  (1 - nu) / (G k)  (2 K sinh 2a - 4 a) / (2 K cosh 2a + 4 a^2 + 1 + K^2)
    along     (1 - nu) / (G k)  (2 K sinh 2a + 4 a) / (2 K cosh 2a + 4 a^2 + 1 + K^2)
    across    tanh(a) / (G k)

Hankel transforms sum the waves. For long waves the factors tend to h (1 - 2 nu) / (2 G (1 - nu)),
as for a block pressed between plates, and to h / G, as for a sheared block.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import jv

from jaxunshear.config.contact_rings import compute_ring_arcs
from jaxunshear.config.sensor import GEL_PAD, Pad
from jaxunshear.simulator.dome import compute_dome
from jaxunshear.simulator.elasticity import compute_lame_constants
from verification.verification_rows import Row, Rows

WAVES = 4000  # wavenumbers that are summed
SHORTEST = 40.0  # the largest wavenumber, times the spacing of the rings
LOADED_RINGS = 5
LAYERS = (4.0, 0.3), (4.0, 0.49), (2.0, 0.3), (2.0, 0.49)  # mm thick, and Poisson's ratio
SAMPLES = 100  # of a ring's radius
COMPARED_RINGS = 8  # farther out the pad's rim shows, which the layer lacks


class LayerFactors(NamedTuple):
    """Displacement per stress, mm/MPa, of each of K waves."""

    pressure: np.ndarray
    along: np.ndarray
    across: np.ndarray


def make_layer(thickness_mm: float, poisson: float) -> Pad:
    """Make a pad of one material, 1 MPa, that is wide for its thickness."""
    return replace(
        GEL_PAD,
        name="layer",
        pad_mm=thickness_mm,
        skin_modulus_mpa=1.0,
        gel_modulus_mpa=1.0,
        skin_poisson=poisson,
        gel_poisson=poisson,
    )


def compute_layer_factors(
    wavenumber: Float[np.ndarray, "K"], thickness_mm: float, poisson: float
) -> LayerFactors:
    """Compute the factors of the module's docstring for a modulus of 1 MPa, without overflow."""
    shear, _ = compute_lame_constants(1.0, poisson)
    a, k = wavenumber * thickness_mm, 3 - 4 * poisson
    decay = np.exp(-2 * a)  # of numerator and denominator, both divided by exp(2a)
    sinh, cosh = 1 - decay**2, 1 + decay**2  # twice each
    below = k * cosh + (4 * a**2 + 1 + k**2) * decay
    scale = (1 - poisson) / (shear * wavenumber)
    return LayerFactors(
        scale * (k * sinh - 4 * a * decay) / below,
        scale * (k * sinh + 4 * a * decay) / below,
        np.tanh(a) / (shear * wavenumber),
    )


class RingMotion(NamedTuple):
    """Mean motion in mm of each of R rings' hats under 1 MPa on the disk.

    A pull along x moves a place at the angle theta by (mean - lobes cos 2 theta, -lobes sin 2
    theta).
    """

    pressed: np.ndarray
    mean: np.ndarray
    lobes: np.ndarray


def compute_ring_motion(sensor: Pad) -> RingMotion:
    """Compute the closed forms on the rings that are compared."""
    spacing = float(compute_ring_arcs(sensor)[1])
    width = spacing / SAMPLES
    radius = width * (np.arange(SAMPLES * (COMPARED_RINGS + 1)) + 0.5)
    step = SHORTEST / spacing / WAVES
    wavenumber = (np.arange(WAVES) + 0.5) * step
    even, second = (jv(order, wavenumber[:, None] * radius) * radius for order in (0, 2))
    load = np.clip(LOADED_RINGS + 1 - radius / spacing, 0, 1)
    waves = even @ load * wavenumber * width * step
    ring = np.arange(COMPARED_RINGS + 1)
    hats = np.clip(1 - np.abs(radius / spacing - ring[:, None]), 0, 1)
    even, second = (hats @ part.T / (hats @ radius)[:, None] for part in (even, second))
    factors = compute_layer_factors(wavenumber, sensor.pad_mm, sensor.gel_poisson)
    return RingMotion(
        even @ (waves * factors.pressure),
        even @ (waves * (factors.along + factors.across)) / 2,
        second @ (waves * (factors.along - factors.across)) / 2,
    )


def load_disk(sensor: Pad, nodes: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Compute the nodal forces in N of 1 MPa on the disk, on nodes in rings."""
    spacing = float(compute_ring_arcs(sensor)[1])
    ring = np.round(np.linalg.norm(nodes, axis=-1) / spacing).astype(int)
    # of the hat around each ring, shared by its nodes
    area = np.where(ring > 0, 2 * np.pi * ring, np.pi / 3) * spacing**2
    return np.where(ring <= LOADED_RINGS, area / np.maximum(6 * ring, 1), 0)


def check_layer(layers: Sequence[tuple[float, float]] = LAYERS) -> list[Row]:
    """Check pressed and pulled pads, thin and thick, compressible and nearly incompressible."""
    rows = Rows("a pad of one material against an elastic layer on a plate")
    for thickness_mm, poisson in layers:
        sensor = make_layer(thickness_mm, poisson)
        pad, known = compute_dome(sensor), compute_ring_motion(sensor)
        force = load_disk(sensor, pad.nodes)
        ring = np.round(np.linalg.norm(pad.nodes, axis=-1) / compute_ring_arcs(sensor)[1])
        ring = ring[ring <= COMPARED_RINGS].astype(int)  # nodes are ordered ring by ring
        double = 2 * np.arctan2(*pad.nodes[: len(ring), 1::-1].T)
        pressed, pulled = (pad.w[:, axis::3] @ force for axis in (2, 0))
        x = known.mean[ring] - known.lobes[ring] * np.cos(double)
        y = -known.lobes[ring] * np.sin(double)
        for what, moved, wanted, scale in (
            ("pressed, z", pressed[2::3], known.pressed[ring], known.pressed[0]),
            ("pulled, x", pulled[::3], x, known.mean[0]),
            ("pulled, y", pulled[1::3], y, known.mean[0]),
        ):
            words = f"{thickness_mm:g} mm thick, Poisson's ratio {poisson:g}: {what} of the face"
            rows.expect_zero(words, np.abs(moved[: len(ring)] - wanted).max(), scale, 0.02)
    return rows
