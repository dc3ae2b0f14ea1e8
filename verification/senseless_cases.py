"""Senseless contacts, which the simulator must refuse by the name of the field."""

from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partial

import numpy as np

from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.simulator.contacts import Contacts, Skins
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import follow, simulate
from verification.contact_case import Case, make_motion, make_path_case

PRESS = make_motion(3.0)
PATHS = Paths(np.array([0]), np.array([0.7]), PRESS[None])


def list_senseless_cases() -> Iterator[Case]:
    """List the cases that must be refused; their names are unique."""
    for number, name in enumerate(("x", "y", "yaw", "depth", "tilt_x", "tilt_y")):
        for value in (np.nan, np.inf):
            points = PRESS.copy()
            points[1, number] = value
            yield make_path_case(f"point with {name} {value:g}", points, refused="points")
    yield from _list_scenes()
    for friction in (np.nan, -0.1, -np.inf):
        name = f"friction {friction:g}"
        yield make_path_case(name, PRESS, friction=friction, refused="friction")
    yield from _list_sensors()
    shapes = {f"shape: {shape}": shape for shape in ("NaN", "infinite", "NaN target")}
    for name, shape in {**shapes, "shape without a name": "square"}.items():
        yield make_path_case(name, PRESS, shape, refused=f"stimulus '{shape}'")
    yield from _list_starts()


def _list_scenes() -> Iterator[Case]:
    for value in (np.nan, -np.inf):
        for field in ("pose", "move"):
            pose, move = np.array([[0.0, 0, 0, 3]]), np.zeros((1, 2))
            scene = Scenes(np.array([0]), pose, move, np.array([0.7]))
            getattr(scene, field)[0, -1] = value

            def solve(level: str | Level, retry: bool, scene: Scenes = scene) -> Contacts:
                return simulate(TACTIP_331, ("disk",), scene, level, retry=retry)

            yield Case(f"scene with {field} {value:g}", solve, refused=field)


def _list_sensors() -> Iterator[Case]:
    values = [
        (field.name, value, f"sensor with {field.name} {value:g}")
        for field in fields(Sensor)
        if isinstance(field.default, float)
        for value in (np.nan, np.inf)
    ]
    values += [("gel_modulus_mpa", -1.0, "gel below zero"), ("gel_poisson", 0.5, "nu 0.5")]
    for field, value, name in values:
        sensor = replace(TACTIP_331, **{field: value})  # type: ignore[arg-type]
        yield make_path_case(name, PRESS, sensor=sensor, refused=field)


def _list_starts() -> Iterator[Case]:
    start = Skins(np.full((1, 1387, 3), np.nan), PRESS[None, 1])
    slide = replace(PATHS, points=make_motion(3.0, slide=(1.0, 0.0))[None, 1:])
    yield Case("continued from NaN forces", partial(_follow, slide, start), refused="forces")
    for value in (1, -1):
        paths = replace(PATHS, stimulus=np.array([value]))
        yield Case(f"stimulus {value} of 1", partial(_follow, paths, None), refused="stimulus")


def _follow(paths: Paths, start: Skins | None, level: str | Level, retry: bool) -> Contacts:
    return follow(TACTIP_331, ("disk",), paths, level, start, retry=retry)[0]
