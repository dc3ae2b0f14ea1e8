"""One touch of the simulated dome, and its contact.

>>> pose, move = (0.0, 0.0, 0.0, 3.0), (2.0, 0.0)
>>> touch = Touch(get_stimulus("disk"), get_sensor("tactip331-fitted"), pose, move, 0.4)
>>> result = simulate_touch(touch)                   # raises UserError if there is no contact
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.config.sensor import Sensor, compute_ring_spacing
from jaxunshear.errors import UserError
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.level import LEVELS, Level
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.scheduler import NODE_COUNTS, Simulation, make_plan, pad_count
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import Stimulus, get_stimulus

# `auto` with friction for taps, too: a tap and a slide then share a batch and compiled programs
LEVEL = replace(
    LEVELS["auto"], omit=tuple(name for name in LEVELS["auto"].omit if name != "friction")
)
BATCH = 2  # a slide and the tap at its end
DEEPEST_MM, MOST_SLIDE_MM = 6.0, 5.0  # of touches that are compiled beforehand
FREE, STUCK, SLIPPING = range(3)
ROUNDING = 1e-3  # of the greatest friction, within which a node slips


@dataclass(frozen=True)
class Touch:
    """A sensor that is pressed down at `pose` - `move`, and then slides by `move`."""

    stimulus: Stimulus
    sensor: Sensor
    pose: tuple[float, ...]  # at the end: x, y (mm), yaw (deg), depth (mm) in the target frame
    move: tuple[float, float]  # mm, target frame
    friction: float  # Coulomb coefficient


class TouchResult(NamedTuple):
    """The contacts of a slide and of the tap at its end, in this order."""

    tips: np.ndarray  # (2, P, 3) mm, pin tips in the sensor frame
    state: np.ndarray  # (P,) FREE, STUCK or SLIPPING: the skin above each pin, at the slide's end
    force_n: np.ndarray  # (3,) N on the sensor at the slide's end


def make_scenes(touch: Touch) -> Scenes:
    """Make the scenes of a slide and of the tap at its end."""
    pose = np.array([touch.pose] * 2, float)
    move = np.array([touch.move, (0.0, 0.0)], float)
    return Scenes(np.zeros(2, int), pose, move, np.full(2, float(touch.friction)))


def simulate_touch(touch: Touch, level: Level = LEVEL) -> TouchResult:
    """Simulate a touch.

    Raises UserError if the contact model does not cover it, or a contact does not converge.
    """
    try:
        contacts, skins = follow(
            touch.sensor,
            (touch.stimulus,),
            make_paths(make_scenes(touch)),
            level,
            batch=BATCH,
            retry=False,
        )
    except UserError as error:
        raise UserError(str(error).removeprefix("scene 0: ")) from None
    if not contacts.converged.all():
        contact = "slide" if not contacts.converged[0] else "tap"
        raise UserError(
            f"the contact of this {contact} did not converge: "
            "move the sensor a little, or press less deep"
        )
    return TouchResult(
        contacts.pins,
        compute_skin_state(touch.sensor, skins.force_n[0], touch.friction),
        contacts.force_n[0],
    )


def compute_skin_state(sensor: Sensor, force_n: np.ndarray, friction: float) -> np.ndarray:
    """Compute FREE, STUCK or SLIPPING (P,) of the skin above each pin of an upright sensor.

    `force_n` (N, 3) has the forces on the contact nodes.
    """
    pressure, pull = force_n[:, 2], np.hypot(force_n[:, 0], force_n[:, 1])
    slips = pull >= (1 - ROUNDING) * friction * pressure
    state = np.where(pressure > 0, np.where(slips, SLIPPING, STUCK), FREE)
    nearest, near = _find_nodes_above(sensor)
    return np.where(near, state[nearest], FREE)


@lru_cache(maxsize=8)
def _find_nodes_above(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Find the contact node (P,) nearest to the skin above each pin, and whether it is near (P,).

    A near node is less than a ring away.
    """
    centre = np.array([0, 0, sensor.dome_radius_mm])

    def compute_directions(points: np.ndarray) -> np.ndarray:
        return (points - centre) / np.linalg.norm(points - centre, axis=-1, keepdims=True)

    nodes = cKDTree(compute_directions(load_shared_dome(sensor).nodes))
    distance, nearest = nodes.query(compute_directions(compute_pin_tips(sensor)))
    return nearest, distance * sensor.dome_radius_mm < compute_ring_spacing(sensor)


def list_warmup_touches(sensor: Sensor, friction: float) -> list[Touch]:
    """List a touch for every size of contact up to DEEPEST_MM, shallow ones first.

    Each size is a program to compile.
    """
    touches: dict[int, Touch] = {}  # by number of nodes
    moves = (0.0, 0.0), (1.0, 0.0), (0.0, 2.5), (0.0, MOST_SLIDE_MM)
    for number, depth in enumerate(np.linspace(0.3, DEEPEST_MM, 20)):
        for name, x in (("edge", 6.0), ("edge", 3.0), ("edge", 0.0), ("surface", 0.0)):
            pose = (x, 0.0, 0.0, float(depth))
            touch = Touch(get_stimulus(name), sensor, pose, moves[number % len(moves)], friction)
            simulation = Simulation(sensor, (touch.stimulus,), LEVEL, BATCH)
            batches = make_plan(simulation, make_paths(make_scenes(touch)))
            nodes = max(pad_count(len(batch.nodes), NODE_COUNTS) for batch in batches)
            touches.setdefault(nodes, touch)
    return list(touches.values())
