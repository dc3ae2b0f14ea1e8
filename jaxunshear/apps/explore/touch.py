"""One touch of the simulated dome: what is asked, and what its contact gives. Pure functions of it.

>>> touch = Touch(get_stimulus("disk"), sensor_named("tactip331-fitted"), (0.0, 0.0, 0.0, 3.0), (2.0, 0.0), 0.4)
>>> felt = simulate_touch(touch)                                 # raises UserError where no contact can be had
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.config.reach import compute_ring_spacing
from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.batches import plan_paths, sample_obstacles
from jaxunshear.simulator.level import LEVELS, Level
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.scheduler import NODE_COUNTS, pad_count
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import Stimulus, get_stimulus
from jaxunshear.simulator.systems import load_shared_dome

# `auto`, but friction is never left out: a tap and a slide then share a batch, and programs of one kind are enough.
LEVEL = replace(LEVELS["auto"], omit=tuple(one for one in LEVELS["auto"].omit if one != "friction"))
BATCH = 2  # a slide and the tap at its end
DEEPEST_MM, MOST_SLIDE_MM = 6.0, 5.0  # made ready for
FREE, STUCK, SLIPPING = range(3)
ROUNDING = 1e-3  # of the greatest friction, within which a node slips


@dataclass(frozen=True)
class Touch:
    """Pressed down at `pose` less `move`, then slid by `move`."""

    stimulus: Stimulus
    sensor: Sensor
    pose: tuple[
        float, float, float, float
    ]  # at the end: x, y (mm), yaw (deg), depth (mm) in the target frame
    move: tuple[float, float]  # mm, target frame
    friction: float  # Coulomb coefficient


class TouchResult(NamedTuple):
    """Of a slide and of the tap at its end, in this order."""

    tips: np.ndarray  # (2, P, 3) mm, pin tips in the sensor frame
    state: np.ndarray  # (P,) FREE, STUCK or SLIPPING: the skin above each pin, at the slide's end
    force_n: np.ndarray  # (3,) N on the sensor at the slide's end


def make_scenes(touch: Touch) -> Scenes:
    pose, move = np.array([touch.pose] * 2, float), np.array([touch.move, (0.0, 0.0)], float)
    return Scenes(np.zeros(2, int), pose, move, np.full(2, float(touch.friction)))


def simulate_touch(touch: Touch, level: Level = LEVEL) -> TouchResult:
    """Raises UserError for what the contact model does not cover, and where a contact does not converge."""
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
        which = "slide" if not contacts.converged[0] else "tap"
        raise UserError(
            f"the contact of this {which} did not converge: move the sensor a little, or press less deep"
        )
    return TouchResult(
        contacts.pins,
        compute_skin_state(touch.sensor, skins.force_n[0], touch.friction),
        contacts.force_n[0],
    )


def compute_skin_state(sensor: Sensor, force_n: np.ndarray, friction: float) -> np.ndarray:
    """(P,) FREE, STUCK or SLIPPING above each pin of an upright sensor, of forces (N, 3) on its contact nodes."""
    pressure, pull = force_n[:, 2], np.hypot(force_n[:, 0], force_n[:, 1])
    slips = pull >= (1 - ROUNDING) * friction * pressure
    state = np.where(pressure > 0, np.where(slips, SLIPPING, STUCK), FREE)
    nearest, near = _above(sensor)
    return np.where(near, state[nearest], FREE)


@lru_cache(maxsize=8)
def _above(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """(P,) number of the contact node nearest to the skin above each pin, and whether it is less than a ring away."""
    centre = np.array([0, 0, sensor.dome_radius_mm])

    def outward(points: np.ndarray) -> np.ndarray:
        return (points - centre) / np.linalg.norm(points - centre, axis=-1, keepdims=True)

    apart, nearest = cKDTree(outward(load_shared_dome(sensor).nodes)).query(
        outward(compute_pin_tips(sensor))
    )
    return nearest, apart * sensor.dome_radius_mm < compute_ring_spacing(sensor)


def list_warmup_touches(sensor: Sensor, friction: float) -> list[Touch]:
    """One touch for every size of contact up to DEEPEST_MM: each size is a program to compile. Shallow ones first."""
    found: dict[int, Touch] = {}
    for number, depth in enumerate(np.linspace(0.3, DEEPEST_MM, 20)):
        slide = (0.0, 0.0), (1.0, 0.0), (0.0, 2.5), (0.0, MOST_SLIDE_MM)
        for name, x in (("edge", 6.0), ("edge", 3.0), ("edge", 0.0), ("surface", 0.0)):
            pose = (x, 0.0, 0.0, float(depth))
            touch = Touch(get_stimulus(name), sensor, pose, slide[number % len(slide)], friction)
            batches = plan_paths(
                sensor,
                sample_obstacles((touch.stimulus,)),
                make_paths(make_scenes(touch)),
                LEVEL,
                BATCH,
            )
            found.setdefault(
                max(pad_count(len(batch.nodes), NODE_COUNTS) for batch in batches), touch
            )
    return list(found.values())
