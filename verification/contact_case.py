"""A contact case: its name, a way to solve it at a level, and the Python that does so."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.simulator.contact_results import Contacts
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import Stimulus
from verification.stimuli import SHAPES

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
# solves at a level, with or without a retry at a stronger one
Solve = Callable[[str | Level, bool], Contacts]


@dataclass(frozen=True)
class Case:
    """A contact that must be solved, or refused by name."""

    name: str
    solve: Solve
    line: str  # of Python that runs it again
    sensor: Sensor = TACTIP_331
    refused: str | None = None  # what the message must name; None: it must be solved
    twin: Solve | None = None  # computes the same pins in another way


def make_motion(
    depth: float,
    at: tuple[float, float] = (0.0, 0.0),
    slide: tuple[float, float] = (0.0, 0.0),
    twist: float = 0.0,
    tilt: tuple[float, float] = (0.0, 0.0),
    yaw: float = 0.0,
) -> np.ndarray:
    """Make points (3, 6): at rest over `at`, pressed there, then slid and twisted."""
    points = np.zeros((3, 6))
    points[:, :2], points[:, 2], points[:, 4:] = at, yaw, tilt
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
    stimuli: tuple[str | Stimulus, ...] = (SHAPES.get(shape, shape),)
    stimulus = f"SHAPES[{shape!r}]" if shape in SHAPES else repr(shape)
    paths = Paths(np.array([0]), np.array([friction]), np.asarray(points, float)[None])
    line = (
        f"follow({format_sensor(sensor)}, ({stimulus},), "
        f"Paths(array([0]), array([{friction!r}]), array({paths.points.tolist()})), 'auto')"
    )

    def solve(level: str | Level, retry: bool) -> Contacts:
        return follow(sensor, stimuli, paths, level, retry=retry)[0]

    return Case(name, solve, line, sensor, refused)


def format_sensor(sensor: Sensor) -> str:
    """Format the sensor as Python, by its differences from the standard one."""
    changed = [f for f in fields(sensor) if getattr(sensor, f.name) != getattr(TACTIP_331, f.name)]
    return f"Sensor({', '.join(f'{f.name}={getattr(sensor, f.name)!r}' for f in changed)})"
