"""Stiff, extreme and senseless contacts: what the simulator must solve, and what it must refuse by name.

A `Case` is a name, a way to solve it at a level, and the line of Python that does so. Where the solver and not the mesh is at stake,
the dome is of half the size: the same shape, materials and spacing of nodes with a quarter of the nodes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, TACTIP_331_FITTED, Sensor
from jaxunshear.simulator.contact_results import Contacts, Skins
from jaxunshear.simulator.input_checks import get_level
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import follow, simulate
from jaxunshear.simulator.stimuli import SHAPES as PLANAR
from jaxunshear.simulator.stimuli import Stimulus
from verification.duplicate_nodes import solve_with_duplicates
from verification.stimuli import SHAPES

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
Solve = Callable[
    [str | Level, bool], Contacts
]  # of the level and whether to retry at a stronger one


@dataclass(frozen=True)
class Case:
    """`solve` runs it; `twin`, where there is one, gets the same pins in another way."""

    name: str
    solve: Solve
    line: str  # of Python that runs it again
    sensor: Sensor = TACTIP_331
    refused: str | None = None  # what the complaint must name; None: has to be solved
    twin: Solve | None = None


def make_motion(
    depth: float,
    at: tuple[float, float] = (0.0, 0.0),
    slide: tuple[float, float] = (0.0, 0.0),
    twist: float = 0.0,
    tilt: tuple[float, float] = (0.0, 0.0),
    yaw: float = 0.0,
) -> np.ndarray:
    """Points (3, 6): at rest over `at`, pressed there, then slid and twisted."""
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
    stimuli: tuple[str | Stimulus, ...] = (SHAPES.get(shape, shape),)
    paths = Paths(np.array([0]), np.array([friction]), np.asarray(points, float)[None])
    line = (
        f"follow({format_sensor(sensor)}, ({f'SHAPES[{shape!r}]' if shape in SHAPES else repr(shape)},), "
        f"Paths(array([0]), array([{friction!r}]), array({paths.points.tolist()})), 'auto')"
    )
    return Case(
        name,
        lambda level, retry: follow(sensor, stimuli, paths, level, retry=retry)[0],
        line,
        sensor,
        refused,
    )


def format_sensor(sensor: Sensor) -> str:
    """The sensor as Python, by what sets it apart from the standard one."""
    changed = [f for f in fields(sensor) if getattr(sensor, f.name) != getattr(TACTIP_331, f.name)]
    return f"Sensor({', '.join(f'{f.name}={getattr(sensor, f.name)!r}' for f in changed)})"


def list_cases() -> list[Case]:
    """Every case; names are unique."""
    groups = (
        _materials,
        _frictions,
        _depths,
        _slides,
        _turns,
        _edges,
        _together,
        _twins,
        _senseless,
    )
    return [case for group in groups for case in group()]


def _materials() -> Iterator[Case]:
    dragged = make_motion(2.0, at=(-4.0, 0.0), slide=(1.5, 0.5))
    for power in range(-2, 7):
        sensor = replace(HALF_SIZE, skin_modulus_mpa=10.0**power * HALF_SIZE.gel_modulus_mpa)
        yield make_path_case(f"skin:gel 1e{power}, half-size dome", dragged, sensor=sensor)
    for poisson in (0.0, 0.3, 0.499, 0.4999):
        sensor = replace(HALF_SIZE, gel_poisson=poisson, skin_poisson=poisson)
        yield make_path_case(f"nu {poisson:g}, half-size dome", dragged, sensor=sensor)
    dragged = make_motion(4.0, at=(-8.0, 0.0), slide=(3.0, 1.0))
    for ratio in (1e-2, 1e6):
        sensor = replace(TACTIP_331, skin_modulus_mpa=ratio * TACTIP_331.gel_modulus_mpa)
        yield make_path_case(f"skin:gel {ratio:.0e}, full dome", dragged, sensor=sensor)
    yield make_path_case(
        "nu 0.4999, full dome",
        dragged,
        sensor=replace(TACTIP_331, gel_poisson=0.4999, skin_poisson=0.4999),
    )
    usual = make_path_case("", dragged)
    for factor in (1e-6, 1e6):
        moduli = (factor * TACTIP_331.skin_modulus_mpa, factor * TACTIP_331.gel_modulus_mpa)
        sensor = replace(TACTIP_331, skin_modulus_mpa=moduli[0], gel_modulus_mpa=moduli[1])
        case = make_path_case(f"E times {factor:.0e}, as E times 1", dragged, sensor=sensor)
        yield replace(case, twin=usual.solve)
    yield make_path_case("127 pins, hexagonal", dragged, sensor=TACTIP_127)


def _frictions() -> Iterator[Case]:
    dragged = make_motion(4.0, at=(-8.0, 0.0), slide=(3.0, 1.0))
    for friction in (0.0, 1e-6, 0.05, 5.0, 1e4, np.inf):
        yield make_path_case(f"friction {friction:g}, slide", dragged, friction=friction)
    for friction in (0.0, 1e4, np.inf):
        yield make_path_case(
            f"friction {friction:g}, press on an edge", make_motion(4.0), friction=friction
        )
    for friction in (5.0, np.inf):
        deep = make_motion(5.5, at=(-8.0, 0.0), slide=(2.5, 2.5))
        yield make_path_case(
            f"fitted sensor, friction {friction:g}, slide",
            deep,
            friction=friction,
            sensor=TACTIP_331_FITTED,
        )


def _depths() -> Iterator[Case]:
    inside, slide = (-12.0, 0.0), (2.0, 1.0)
    for depth in (-1.0, 0.0, 1e-6, 0.01, 8.0):
        yield make_path_case(f"depth {depth:g} mm, press", make_motion(depth, at=inside))
        yield make_path_case(
            f"depth {depth:g} mm, slide", make_motion(depth, at=inside, slide=slide)
        )
    yield make_path_case("depth 8 mm on an edge, slide", make_motion(8.0, slide=slide))
    yield make_path_case("depth 10 mm, press", make_motion(10.0, at=inside))
    for depth in (12.0, 20.0):  # the contact's edge would pass the last ring of nodes
        yield make_path_case(
            f"depth {depth:g} mm, press", make_motion(depth, at=inside), refused="depth"
        )
    high = make_motion(3.0, at=inside)
    high[0, 3] = -50.0
    yield make_path_case("lowered from 50 mm above", high)


def _slides() -> Iterator[Case]:
    for length in (0.0, 1e-9, 1e-3, 0.1, 10.0, 50.0):
        yield make_path_case(
            f"slide of {length:g} mm", make_motion(3.0, at=(-60.0, 0.0), slide=(length, 0.0))
        )
    yield make_path_case(
        "slide of 50 mm off the shape", make_motion(3.0, at=(-20.0, 0.0), slide=(50.0, 0.0))
    )
    yield make_path_case(
        "slide of 50 mm onto the shape", make_motion(3.0, at=(30.0, 0.0), slide=(-50.0, 0.0))
    )
    yield make_path_case(
        "slide of 50 mm along the edge of the flower",
        make_motion(3.0, slide=(0.0, 50.0)),
        shape="flower",
    )
    back = np.concatenate(
        [make_motion(3.0, at=(-12.0, 0.0), slide=(3.0, 0.0)), make_motion(3.0, at=(-12.0, 0.0))[1:]]
    )
    yield make_path_case("slide of 3 mm there and back", back)
    lifted = np.concatenate([back, make_motion(0.0, at=(-12.0, 0.0))[1:] - np.eye(1, 6, 3)])
    yield make_path_case("slide of 3 mm, then lifted", lifted)
    zigzag = np.repeat(make_motion(3.0, at=(-12.0, 0.0))[:2], [1, 41], axis=0)
    zigzag[1:, 1] += 0.5 * (np.arange(41) % 2)
    yield make_path_case("40 slides of 0.5 mm to and fro", zigzag)


def _turns() -> Iterator[Case]:
    for twist in (1e-6, 180.0, -180.0, 720.0):
        yield make_path_case(
            f"twist of {twist:g} deg", make_motion(3.0, at=(-15.0, 0.0), twist=twist)
        )
    for friction in (0.0, np.inf):
        points = make_motion(3.0, at=(-15.0, 0.0), twist=180.0)
        yield make_path_case(f"twist of 180 deg, friction {friction:g}", points, friction=friction)
    yield make_path_case("twist of 180 deg on an edge", make_motion(3.0, twist=180.0))
    for tilt in ((25.0, 0.0), (0.0, -25.0), (17.0, 17.0), (1e-6, 0.0)):
        yield make_path_case(
            f"tilt of {tilt} deg, press", make_motion(3.0, at=(-15.0, 0.0), tilt=tilt)
        )
        yield make_path_case(
            f"tilt of {tilt} deg on an edge, slide", make_motion(3.0, tilt=tilt, slide=(1.5, 2.0))
        )
    rocking = make_motion(3.0, at=(-15.0, 0.0))
    rocking[2, 4] = 25.0
    yield make_path_case("tilted by 25 deg while pressed", rocking)
    yield make_path_case(
        "tilt of 25 deg, friction 0",
        make_motion(3.0, tilt=(25.0, 0.0), slide=(2.0, 0.0)),
        friction=0.0,
    )
    yield make_path_case(
        "tilt of 25 deg, friction infinite",
        make_motion(3.0, tilt=(25.0, 0.0), slide=(2.0, 0.0)),
        friction=np.inf,
    )
    yield make_path_case("tilt of 75 deg", make_motion(3.0, tilt=(75.0, 0.0)), refused="depth")


def _edges() -> Iterator[Case]:
    for name in PLANAR:
        yield make_path_case(
            f"edge of {name} through the apex, press", make_motion(3.0), shape=name
        )
        yield make_path_case(
            f"edge of {name} through the apex, slide",
            make_motion(3.0, at=(-1.0, -1.0), slide=(1.0, 1.0)),
            shape=name,
        )
    for name in (
        "2-mm spiral arm",
        "smaller than a pin",
        "a point",
        "a hair",
        "empty",
        "everywhere",
    ):
        yield make_path_case(f"shape: {name}, press", make_motion(2.0), shape=name)
        yield make_path_case(
            f"shape: {name}, slide", make_motion(2.0, at=(-1.0, -1.0), slide=(2.0, 1.0)), shape=name
        )
    yield make_path_case(
        "shape: a point, 8 mm deep", make_motion(8.0, slide=(1.0, 0.0)), shape="a point"
    )


def _together() -> Iterator[Case]:
    """Several extremes at once."""
    stiff, soft = (
        replace(HALF_SIZE, skin_modulus_mpa=ratio * HALF_SIZE.gel_modulus_mpa)
        for ratio in (1e6, 1e-2)
    )
    for sensor, name in ((stiff, "1e6"), (soft, "1e-2")):
        for friction in (5.0, 1e4, np.inf):
            points = make_motion(4.0, at=(-6.0, 0.0), slide=(4.0, 2.0), twist=90.0)
            yield make_path_case(
                f"skin:gel {name}, friction {friction:g}, 4 of 10 mm deep, slide, twist",
                points,
                friction=friction,
                sensor=sensor,
            )
    points = make_motion(3.0, slide=(2.0, 3.0), twist=90.0, tilt=(10.0, 20.0))
    for friction in (0.7, 1e4, np.inf):
        yield make_path_case(
            f"edge, tilt, slide, twist, friction {friction:g}", points, friction=friction
        )
    yield make_path_case(
        "2-mm spiral arm, 8 mm deep, friction 1e4, slide",
        make_motion(8.0, slide=(3.0, 3.0)),
        "2-mm spiral arm",
        1e4,
    )
    rigid = replace(stiff, gel_poisson=0.4999, skin_poisson=0.4999)
    points = make_motion(4.0, slide=(3.0, 1.0))
    yield make_path_case(
        "skin:gel 1e6, nu 0.4999, friction 1e4, edge, 4 of 10 mm deep, slide",
        points,
        friction=1e4,
        sensor=rigid,
    )


def _twins() -> Iterator[Case]:
    """The same contact in two ways."""
    points = make_motion(3.0, slide=(1.5, 1.0))
    alone = make_path_case("", points)
    generator = np.random.default_rng(0)
    crowd = np.concatenate([points[None], np.repeat(points[None], 15, axis=0)])
    crowd[1:, :, :2] += generator.uniform(-5, 5, (15, 1, 2))
    crowd[1:, 1:, 3] = generator.uniform(1, 6, (15, 1))
    paths = Paths(np.zeros(16, int), np.full(16, 0.7), crowd)

    def in_a_crowd(level: str | Level, retry: bool) -> Contacts:
        return _first(follow(TACTIP_331, ("disk",), paths, level, retry=retry)[0])

    yield replace(alone, name="batch of 1, as in a batch of 16", twin=in_a_crowd)

    def in_two_parts(level: str | Level, retry: bool) -> Contacts:
        half = [
            Paths(np.array([0]), np.array([0.7]), points[None, part])
            for part in (slice(0, 2), slice(1, 3))
        ]
        _, skins = follow(TACTIP_331, ("disk",), half[0], level, retry=retry)
        return follow(TACTIP_331, ("disk",), half[1], level, skins, retry=retry)[0]

    yield replace(alone, name="continued from its state, as in one go", twin=in_two_parts)

    def twice(level: str | Level, retry: bool) -> Contacts:
        return solve_with_duplicates(
            HALF_SIZE, make_motion(1.5, slide=(1.0, 0.5)), 0.7, get_level(level)
        )

    once = make_path_case("", make_motion(1.5, slide=(1.0, 0.5)), sensor=HALF_SIZE)
    line = f"follow_duplicated({format_sensor(HALF_SIZE)}, array({make_motion(1.5, slide=(1.0, 0.5)).tolist()}), 0.7, LEVELS['auto'])"
    yield Case(
        "contact nodes that stand there twice, as once", twice, line, HALF_SIZE, twin=once.solve
    )


def _first(contacts: Contacts) -> Contacts:
    return Contacts(*(field[:1] for field in contacts))


def _senseless() -> Iterator[Case]:
    """To be refused, with the field's name."""
    for number, name in enumerate(("x", "y", "yaw", "depth", "tilt_x", "tilt_y")):
        for value in (np.nan, np.inf):
            points = make_motion(3.0)
            points[1, number] = value
            yield make_path_case(f"point with {name} {value:g}", points, refused="points")
    for value in (np.nan, -np.inf):
        for field in ("pose", "move"):
            scene = Scenes(
                np.array([0]), np.array([[0.0, 0, 0, 3]]), np.zeros((1, 2)), np.array([0.7])
            )
            getattr(scene, field)[0, -1] = value
            line = f"simulate(TACTIP_331, ('disk',), {scene}, 'auto')"
            yield Case(
                f"scene with {field} {value:g}",
                lambda level, retry, s=scene: simulate(
                    TACTIP_331, ("disk",), s, level, retry=retry
                ),  # type: ignore[misc]
                line,
                refused=field,
            )
    for friction in (np.nan, -0.1, -np.inf):
        yield make_path_case(
            f"friction {friction:g}", make_motion(3.0), friction=friction, refused="friction"
        )
    for field in (f.name for f in fields(Sensor) if f.type in ("float", float)):
        for value in (np.nan, np.inf):
            sensor = replace(TACTIP_331, **{field: value})  # type: ignore[arg-type]
            yield make_path_case(
                f"sensor with {field} {value:g}", make_motion(3.0), sensor=sensor, refused=field
            )
    yield make_path_case(
        "gel below zero",
        make_motion(3.0),
        sensor=replace(TACTIP_331, gel_modulus_mpa=-1.0),
        refused="gel_modulus_mpa",
    )
    yield make_path_case(
        "nu 0.5",
        make_motion(3.0),
        sensor=replace(TACTIP_331, gel_poisson=0.5),
        refused="gel_poisson",
    )
    for shape in ("NaN", "infinite", "NaN target"):
        yield make_path_case(
            f"shape: {shape}", make_motion(3.0), shape=shape, refused=f"stimulus '{shape}'"
        )
    yield make_path_case(
        "shape without a name", make_motion(3.0), shape="square", refused="stimulus 'square'"
    )

    start = Skins(np.full((1, 1387, 3), np.nan), make_motion(3.0)[None, 1])
    rest = Paths(np.array([0]), np.array([0.7]), make_motion(3.0, slide=(1.0, 0.0))[None, 1:])
    yield Case(
        "continued from NaN forces",
        lambda level, retry: follow(TACTIP_331, ("disk",), rest, level, start, retry=retry)[0],
        f"follow(TACTIP_331, ('disk',), {rest}, 'auto', Skins(full((1, 1387, 3), nan), ...))",
        refused="forces",
    )
    for value in (1, -1):
        paths = Paths(np.array([value]), np.array([0.7]), make_motion(3.0)[None])
        yield Case(
            f"stimulus {value} of 1",
            lambda level, retry, p=paths: follow(TACTIP_331, ("disk",), p, level, retry=retry)[0],  # type: ignore[misc]
            f"follow(TACTIP_331, ('disk',), {paths}, 'auto')",
            refused="stimulus",
        )
