"""Stiff and extreme contacts that the simulator must solve, and a list of all cases."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, TACTIP_331_FITTED, Sensor
from jaxunshear.simulator.contacts import Contacts
from jaxunshear.simulator.level import Level, get_level
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import SHAPES
from verification.contact_case import HALF_SIZE, Case, make_motion, make_path_case
from verification.duplicate_nodes import solve_with_duplicates
from verification.senseless_cases import list_senseless_cases

INSIDE = (-12.0, 0.0)
LONG_SLIDE = make_motion(4.0, (-8.0, 0.0), (3.0, 1.0))
EXTREME_FRICTIONS = (0.0, 1e4, np.inf)


def list_cases() -> list[Case]:
    """List all cases; their names are unique."""
    return [
        *_list_materials(),
        *_list_frictions(),
        *_list_depths(),
        *_list_slides(),
        *_list_turns(),
        *_list_edges(),
        *_list_combinations(),
        *_list_twins(),
        *list_senseless_cases(),
    ]


def set_stiffness_ratio(sensor: Sensor, ratio: float) -> Sensor:
    """Set the skin's modulus to a multiple of the gel's."""
    return replace(sensor, skin_modulus_mpa=ratio * sensor.gel_modulus_mpa)


def _set_poisson(sensor: Sensor, poisson: float) -> Sensor:
    return replace(sensor, gel_poisson=poisson, skin_poisson=poisson)


def _list_materials() -> Iterator[Case]:
    slide = make_motion(2.0, (-4.0, 0.0), (1.5, 0.5))
    for power in range(-2, 7):
        sensor = set_stiffness_ratio(HALF_SIZE, 10.0**power)
        yield make_path_case(f"skin:gel 1e{power}, half-size dome", slide, sensor=sensor)
    for poisson in (0.0, 0.3, 0.499, 0.4999):
        sensor = _set_poisson(HALF_SIZE, poisson)
        yield make_path_case(f"nu {poisson:g}, half-size dome", slide, sensor=sensor)
    for ratio in (1e-2, 1e6):
        sensor = set_stiffness_ratio(TACTIP_331, ratio)
        yield make_path_case(f"skin:gel {ratio:.0e}, full dome", LONG_SLIDE, sensor=sensor)
    sensor = _set_poisson(TACTIP_331, 0.4999)
    yield make_path_case("nu 0.4999, full dome", LONG_SLIDE, sensor=sensor)
    usual = make_path_case("", LONG_SLIDE)
    for factor in (1e-6, 1e6):
        moduli = (factor * TACTIP_331.skin_modulus_mpa, factor * TACTIP_331.gel_modulus_mpa)
        sensor = replace(TACTIP_331, skin_modulus_mpa=moduli[0], gel_modulus_mpa=moduli[1])
        case = make_path_case(f"E times {factor:.0e}, as E times 1", LONG_SLIDE, sensor=sensor)
        yield replace(case, twin=usual.solve)
    yield make_path_case("127 pins, hexagonal", LONG_SLIDE, sensor=TACTIP_127)


def _list_frictions() -> Iterator[Case]:
    for friction in (0.0, 1e-6, 0.05, 5.0, 1e4, np.inf):
        yield make_path_case(f"friction {friction:g}, slide", LONG_SLIDE, friction=friction)
    press, deep = make_motion(4.0), make_motion(5.5, (-8.0, 0.0), (2.5, 2.5))
    for friction in EXTREME_FRICTIONS:
        yield make_path_case(f"friction {friction:g}, press on an edge", press, friction=friction)
    for friction in (5.0, np.inf):
        name = f"fitted sensor, friction {friction:g}, slide"
        yield make_path_case(name, deep, friction=friction, sensor=TACTIP_331_FITTED)


def _list_depths() -> Iterator[Case]:
    slide = (2.0, 1.0)
    for depth in (-1.0, 0.0, 1e-6, 0.01, 8.0):
        yield make_path_case(f"depth {depth:g} mm, press", make_motion(depth, INSIDE))
        yield make_path_case(f"depth {depth:g} mm, slide", make_motion(depth, INSIDE, slide))
    yield make_path_case("depth 8 mm on an edge, slide", make_motion(8.0, slide=slide))
    yield make_path_case("depth 10 mm, press", make_motion(10.0, INSIDE))
    for depth in (12.0, 20.0):  # the contact's edge would pass the last ring of nodes
        points = make_motion(depth, INSIDE)
        yield make_path_case(f"depth {depth:g} mm, press", points, refused="depth")
    high = make_motion(3.0, INSIDE)
    high[0, 3] = -50.0
    yield make_path_case("lowered from 50 mm above", high)


def _list_slides() -> Iterator[Case]:
    for length in (0.0, 1e-9, 1e-3, 0.1, 10.0, 50.0):
        points = make_motion(3.0, (-60.0, 0.0), (length, 0.0))
        yield make_path_case(f"slide of {length:g} mm", points)
    off = make_motion(3.0, (-20.0, 0.0), (50.0, 0.0))
    yield make_path_case("slide of 50 mm off the shape", off)
    onto = make_motion(3.0, (30.0, 0.0), (-50.0, 0.0))
    yield make_path_case("slide of 50 mm onto the shape", onto)
    along = make_motion(3.0, slide=(0.0, 50.0))
    yield make_path_case("slide of 50 mm along the edge of the flower", along, "flower")
    press = make_motion(3.0, INSIDE)
    back = np.concatenate([make_motion(3.0, INSIDE, (3.0, 0.0)), press[1:]])
    yield make_path_case("slide of 3 mm there and back", back)
    lifted = np.concatenate([back, make_motion(0.0, INSIDE)[1:] - np.eye(1, 6, 3)])
    yield make_path_case("slide of 3 mm, then lifted", lifted)
    zigzag = np.repeat(press[:2], [1, 41], axis=0)
    zigzag[1:, 1] += 0.5 * (np.arange(41) % 2)
    yield make_path_case("40 slides of 0.5 mm to and fro", zigzag)


def _list_turns() -> Iterator[Case]:
    inside = (-15.0, 0.0)
    for twist in (1e-6, 180.0, -180.0, 720.0):
        points = make_motion(3.0, inside, twist=twist)
        yield make_path_case(f"twist of {twist:g} deg", points)
    for friction in (0.0, np.inf):
        points = make_motion(3.0, inside, twist=180.0)
        yield make_path_case(f"twist of 180 deg, friction {friction:g}", points, friction=friction)
    yield make_path_case("twist of 180 deg on an edge", make_motion(3.0, twist=180.0))
    for tilt in ((25.0, 0.0), (0.0, -25.0), (17.0, 17.0), (1e-6, 0.0)):
        press = make_motion(3.0, inside, tilt=tilt)
        yield make_path_case(f"tilt of {tilt} deg, press", press)
        slide = make_motion(3.0, slide=(1.5, 2.0), tilt=tilt)
        yield make_path_case(f"tilt of {tilt} deg on an edge, slide", slide)
    rocking = make_motion(3.0, inside)
    rocking[2, 4] = 25.0
    yield make_path_case("tilted by 25 deg while pressed", rocking)
    tilted = make_motion(3.0, slide=(2.0, 0.0), tilt=(25.0, 0.0))
    for name, friction in (("0", 0.0), ("infinite", np.inf)):
        yield make_path_case(f"tilt of 25 deg, friction {name}", tilted, friction=friction)
    steep = make_motion(3.0, tilt=(75.0, 0.0))
    yield make_path_case("tilt of 75 deg", steep, refused="depth")


def _list_edges() -> Iterator[Case]:
    press, slide = make_motion(3.0), make_motion(3.0, (-1.0, -1.0), (1.0, 1.0))
    for name in SHAPES:
        yield make_path_case(f"edge of {name} through the apex, press", press, name)
        yield make_path_case(f"edge of {name} through the apex, slide", slide, name)
    press, slide = make_motion(2.0), make_motion(2.0, (-1.0, -1.0), (2.0, 1.0))
    thin = ("2-mm spiral arm", "smaller than a pin", "a point", "a hair")
    for name in (*thin, "empty", "everywhere"):
        yield make_path_case(f"shape: {name}, press", press, name)
        yield make_path_case(f"shape: {name}, slide", slide, name)
    deep = make_motion(8.0, slide=(1.0, 0.0))
    yield make_path_case("shape: a point, 8 mm deep", deep, "a point")


def _list_combinations() -> Iterator[Case]:
    """List cases of several extremes at once."""
    points = make_motion(4.0, (-6.0, 0.0), (4.0, 2.0), 90.0)
    for ratio, title in ((1e6, "1e6"), (1e-2, "1e-2")):
        sensor = set_stiffness_ratio(HALF_SIZE, ratio)
        for friction in (5.0, 1e4, np.inf):
            name = f"skin:gel {title}, friction {friction:g}, 4 of 10 mm deep, slide, twist"
            yield make_path_case(name, points, friction=friction, sensor=sensor)
    points = make_motion(3.0, slide=(2.0, 3.0), twist=90.0, tilt=(10.0, 20.0))
    for friction in (0.7, 1e4, np.inf):
        name = f"edge, tilt, slide, twist, friction {friction:g}"
        yield make_path_case(name, points, friction=friction)
    arm, points = "2-mm spiral arm", make_motion(8.0, slide=(3.0, 3.0))
    yield make_path_case(f"{arm}, 8 mm deep, friction 1e4, slide", points, arm, 1e4)
    rigid = _set_poisson(set_stiffness_ratio(HALF_SIZE, 1e6), 0.4999)
    name = "skin:gel 1e6, nu 0.4999, friction 1e4, edge, 4 of 10 mm deep, slide"
    points = make_motion(4.0, slide=(3.0, 1.0))
    yield make_path_case(name, points, friction=1e4, sensor=rigid)


def _list_twins() -> Iterator[Case]:
    """List cases that solve one contact in two ways."""
    points = make_motion(3.0, slide=(1.5, 1.0))
    alone = make_path_case("", points)
    generator = np.random.default_rng(0)
    batch = np.repeat(points[None], 16, axis=0)
    batch[1:, :, :2] += generator.uniform(-5, 5, (15, 1, 2))
    batch[1:, 1:, 3] = generator.uniform(1, 6, (15, 1))
    paths = Paths(np.zeros(16, int), np.full(16, 0.7), batch)

    def solve_in_batch(level: str | Level, retry: bool) -> Contacts:
        contacts, _ = follow(TACTIP_331, ("disk",), paths, level, retry=retry)
        return Contacts(*(field[:1] for field in contacts))

    yield replace(alone, name="batch of 1, as in a batch of 16", twin=solve_in_batch)

    def solve_in_parts(level: str | Level, retry: bool) -> Contacts:
        press = Paths(np.array([0]), np.array([0.7]), points[None, :2])
        slide = replace(press, points=points[None, 1:])
        _, skins = follow(TACTIP_331, ("disk",), press, level, retry=retry)
        return follow(TACTIP_331, ("disk",), slide, level, skins, retry=retry)[0]

    yield replace(alone, name="continued from its state, as in one go", twin=solve_in_parts)

    motion = make_motion(1.5, slide=(1.0, 0.5))

    def solve_twice(level: str | Level, retry: bool) -> Contacts:
        return solve_with_duplicates(HALF_SIZE, motion, 0.7, get_level(level))

    name = "contact nodes that stand there twice, as once"
    once = make_path_case("", motion, sensor=HALF_SIZE)
    yield Case(name, solve_twice, HALF_SIZE, twin=once.solve)
