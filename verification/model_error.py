"""The simulator's model error: its linear dome against the large-strain reference.

Both are pressed by a flat plate without friction.

    for row in measure_model_error(TACTIP_331):
        print(row.depth_mm, row.rms_px, row.motion_px)

Errors are of the pins, over all pins. Px are those of the default camera's 256-px frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.progress import Progress
from jaxunshear.simulator.contacts import Contacts, Skins
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import follow
from verification.large_strain import fit_contact_radius, press_dome
from verification.pin_distance import compute_pin_error

DEPTHS_MM = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
INSIDE_MM = 25.0  # of the edge of the disk, so far that no contact reaches it
TINY = 1e-16  # squared difference of squared stretches, below which their directions do not matter


class ModelError(NamedTuple):
    """The error at one depth. If either model has not converged the figures are NaN."""

    depth_mm: float
    converged: bool
    motion_px: float  # rms by which the reference's pins move
    rms_px: float
    p95_px: float
    max_px: float
    # rms that exact kinematics with a linear law (of logarithmic strain) would leave
    material_px: float
    force_ratio: float  # linear over reference
    radius_ratio: float  # of the contact
    strained: float  # share of the gel's volume beyond 20 % of principal strain, in the reference


def measure_model_error(
    sensor: Sensor,
    depths: Sequence[float] = DEPTHS_MM,
    mesh_mm: float = 1.0,
    level: str = "reference",
) -> list[ModelError]:
    """Measure the model's error at each depth.

    The level "reference" keeps the solver's own error out of it.
    """
    with Progress("large strain", 2 * len(depths), unit="presses") as progress:
        exact = press_dome(sensor, depths, mesh_mm, progress=progress)
        hencky = press_dome(sensor, depths, mesh_mm, compute_hencky_energy, progress)
    contacts, skins = _press_linear_dome(sensor, depths, level)
    radii = _fit_radii(sensor, skins)
    rows = []
    for i, depth in enumerate(depths):
        converged = bool(exact.converged[i] and hencky.converged[i] and contacts.converged[i])
        figures = (
            compute_pin_error(sensor, exact.pins[i], compute_pin_tips(sensor)).rms_px,
            *compute_pin_error(sensor, contacts.pins[i], exact.pins[i])[:3],
            compute_pin_error(sensor, hencky.pins[i], exact.pins[i]).rms_px,
            _ratio(contacts.force_n[i, 2], exact.force_n[i]),
            _ratio(radii[i], exact.contact_radius_mm[i]),
            float(exact.strained[i]),
        )
        values = figures if converged else [np.nan] * len(figures)
        rows.append(ModelError._make([float(depth), converged, *values]))
    return rows


def compute_hencky_energy(gradient: jax.Array, shear: jax.Array, first: jax.Array) -> jax.Array:
    """Compute mu |log U|^2 + lambda/2 (ln J)^2 in MPa (Hencky 1928).

    The deformation gradient (3, 3) is axisymmetric. Rotations and stretches are exact and stress is
    linear in the strain, so that it differs from `neo_hookean` only in the law of the material.
    """
    plane = gradient[::2, ::2]
    squared = plane.T @ plane
    mean = jnp.trace(squared) / 2
    spread = jnp.sqrt(((squared[0, 0] - squared[1, 1]) / 2) ** 2 + squared[0, 1] ** 2 + TINY)
    strains = jnp.stack(
        [jnp.log(mean + spread) / 2, jnp.log(mean - spread) / 2, jnp.log(gradient[1, 1])]
    )
    return shear * jnp.sum(strains**2) + first / 2 * jnp.sum(strains) ** 2


def _ratio(value: float, reference: float) -> float:
    return float(value / reference) if reference else np.nan


def _press_linear_dome(
    sensor: Sensor, depths: Sequence[float], level: str
) -> tuple[Contacts, Skins]:
    zeros = np.zeros(len(depths))
    pose = np.stack([zeros - INSIDE_MM, zeros, zeros, np.asarray(depths, float)], -1)
    paths = make_paths(Scenes(zeros.astype(int), pose, np.zeros((len(depths), 2)), zeros))
    return follow(sensor, ("disk",), paths, level)


def _fit_radii(sensor: Sensor, skins: Skins) -> np.ndarray:
    """Fit contact radii (B,) mm from the nodes along +x, one of each ring."""
    full = load_shared_dome(sensor)
    along = np.flatnonzero((np.abs(full.nodes[:, 1]) < 1e-9) & (full.nodes[:, 0] > -1e-9))
    radii = []
    for force, point in zip(skins.force_n, skins.point, strict=True):
        place = full.nodes[along] + (full.w @ force.ravel()).reshape(-1, 3)[along]
        radii.append(fit_contact_radius(place[:, 0], place[:, 2] - point[3], force[along, 2] > 0))
    return np.array(radii)
