"""A half-space, condensed once: the body for which closed forms exist."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.contact.elasticity import Compliance, condense, isotropic
from jaxunshear.contact.friction import RHO, System
from jaxunshear.contact.mesh import half_space_mesh
from jaxunshear.contact.obstacle import Obstacles

FLAT = Obstacles(jnp.full((1, 5, 5), -10.0))


@dataclass(frozen=True)
class HalfSpace:
    """Modulus 1 MPa; the face within 1 mm of the axis is resolved. `scale` turns scaled forces into N (divide)."""

    poisson: float
    compliance: Compliance
    scale: float

    def system(self, sphere_mm: float) -> System:
        """The face with the gap of a sphere's radius, or flat for infinity."""
        count = len(self.compliance.w)
        w = self.compliance.w / self.scale
        nodes = self.compliance.nodes.copy()
        nodes[:, 2] = np.sum(nodes[:, :2] ** 2, -1) / (2 * sphere_mm)
        inverse = np.linalg.inv(w + RHO * np.eye(count))
        return System(*(jnp.asarray(field, jnp.float32) for field in (w, inverse, w, nodes, 0.0)))

    @property
    def normal_modulus(self) -> float:
        return 1 / (1 - self.poisson**2)

    @property
    def shear_modulus(self) -> float:
        return 1 / (2 * (1 + self.poisson))


@pytest.fixture(scope="session")
def half_space() -> HalfSpace:
    """Nearly incompressible, where Cattaneo and Mindlin's theory is exact."""
    poisson = 0.49
    mesh = half_space_mesh(1.0, 0.1)
    materials = np.broadcast_to(isotropic(1.0, poisson), (len(mesh.elements), 6, 6))
    made = condense(mesh, materials, np.arange(12) * 0.09, np.array([[0.3, 0.0, 0.3], [0.0, 0.3, 0.3]]), 64)
    return HalfSpace(poisson, made, float(np.trace(made.w) / len(made.w)))
