"""A contact case: its name, a way to solve it at a level, and what it must be refused for."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.simulator.contacts import Contacts
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.shapes import make_disk, make_stroke
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import Stimulus

# The standard sensor at half its size: the same shape, materials and spacing of nodes with a
# quarter of the nodes. It serves where the solver and not the mesh is tested.
HALF_SIZE = replace(
    TACTIP_331,
    name="half-size",
    rings=8,
    pin_spacing_mm=0.9,
    pin_radius_mm=0.3,
    pin_length_mm=0.5,
    dome_radius_mm=10.0,
    skin_mm=0.5,
)
_ARM = np.array([[(3 + a) * np.cos(a), (3 + a) * np.sin(a)] for a in np.linspace(0, 4 * np.pi, 81)])
_HAIR = np.array([[-40.0, 0.0], [40.0, 0.0]])
_MIDDLE = (0.0, 0.0, 0.0)


def _make_constant(value: float) -> Callable:
    return lambda p: jnp.full(p.shape[:-1], value, p.dtype)


# narrow, extreme and senseless ones: distance function, target and extent
STIMULI = {
    "2-mm spiral arm": (make_stroke(_ARM, 1.0), (3 + 2 * np.pi + 1.0, 0.0, 0.0), 17.0),
    "smaller than a pin": (make_disk(0.3), _MIDDLE, 0.3),
    "a point": (make_disk(0.0), _MIDDLE, 0.0),
    "a hair": (make_stroke(_HAIR, 0.0), (0.0, 0.0, 90.0), 40.0),
    "empty": (_make_constant(1e3), _MIDDLE, 0.0),
    "everywhere": (_make_constant(-1e3), _MIDDLE, 1e3),
    "NaN": (lambda p: p[..., 0] * jnp.nan, _MIDDLE, 1.0),
    "infinite": (_make_constant(np.inf), _MIDDLE, 1.0),
    "NaN target": (make_disk(50.0), (np.nan, 0.0, 0.0), 50.0),
}
# solves at a level, with or without a retry at a stronger one
Solve = Callable[[str | Level, bool], Contacts]


@dataclass(frozen=True)
class Case:
    """A contact that must be solved, or refused by name."""

    name: str
    solve: Solve
    sensor: Sensor = TACTIP_331
    refused: str | None = None  # what the message must name; None: it must be solved
    twin: Solve | None = None  # computes the same pins in another way


def make_motion(
    depth: float,
    at: tuple[float, float] = (0.0, 0.0),
    slide: tuple[float, float] = (0.0, 0.0),
    twist: float = 0.0,
    tilt: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Make points (3, 6): at rest over `at`, pressed there, then slid and twisted."""
    points = np.zeros((3, 6))
    points[:, :2], points[:, 4:] = at, tilt
    points[1:, 3] = depth
    points[2, :2] += slide
    points[2, 2] += twist
    return points


def make_path_case(
    name: str,
    points: np.ndarray,
    shape: str = "disk",
    friction: float = 0.7,
    sensor: Sensor = TACTIP_331,
    refused: str | None = None,
) -> Case:
    """Make a case of one path (K, 6) over a shape."""
    stimulus = Stimulus(shape, *STIMULI[shape]) if shape in STIMULI else shape
    paths = Paths(np.array([0]), np.array([friction]), np.asarray(points, float)[None])

    def solve(level: str | Level, retry: bool) -> Contacts:
        return follow(sensor, (stimulus,), paths, level, retry=retry)[0]

    return Case(name, solve, sensor, refused)
