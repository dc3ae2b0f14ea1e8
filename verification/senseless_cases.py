"""Senseless contacts, which the simulator must refuse by the name of the field."""

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.simulator.contact_results import Contacts, Skins
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import follow, simulate
from verification.contact_case import Case, make_motion, make_path_case


def list_senseless_cases() -> Iterator[Case]:
    """List the cases that must be refused; their names are unique."""
    yield from _list_points()
    yield from _list_scenes()
    yield from _list_frictions()
    yield from _list_sensors()
    yield from _list_shapes()
    yield from _list_starts()
    yield from _list_indices()


def _list_points() -> Iterator[Case]:
    for number, name in enumerate(("x", "y", "yaw", "depth", "tilt_x", "tilt_y")):
        for value in (np.nan, np.inf):
            points = make_motion(3.0)
            points[1, number] = value
            yield make_path_case(f"point with {name} {value:g}", points, refused="points")


def _list_scenes() -> Iterator[Case]:
    for value in (np.nan, -np.inf):
        for field in ("pose", "move"):
            scene = Scenes(
                np.array([0]), np.array([[0.0, 0, 0, 3]]), np.zeros((1, 2)), np.array([0.7])
            )
            getattr(scene, field)[0, -1] = value

            def solve(level: str | Level, retry: bool, scene: Scenes = scene) -> Contacts:
                return simulate(TACTIP_331, ("disk",), scene, level, retry=retry)

            line = f"simulate(TACTIP_331, ('disk',), {scene}, 'auto')"
            yield Case(f"scene with {field} {value:g}", solve, line, refused=field)


def _list_frictions() -> Iterator[Case]:
    for friction in (np.nan, -0.1, -np.inf):
        yield make_path_case(
            f"friction {friction:g}", make_motion(3.0), friction=friction, refused="friction"
        )


def _list_sensors() -> Iterator[Case]:
    press = make_motion(3.0)
    for field in (f.name for f in fields(Sensor) if f.type in ("float", float)):
        for value in (np.nan, np.inf):
            sensor = replace(TACTIP_331, **{field: value})  # type: ignore[arg-type]
            name = f"sensor with {field} {value:g}"
            yield make_path_case(name, press, sensor=sensor, refused=field)
    sensor = replace(TACTIP_331, gel_modulus_mpa=-1.0)
    yield make_path_case("gel below zero", press, sensor=sensor, refused="gel_modulus_mpa")
    sensor = replace(TACTIP_331, gel_poisson=0.5)
    yield make_path_case("nu 0.5", press, sensor=sensor, refused="gel_poisson")


def _list_shapes() -> Iterator[Case]:
    press = make_motion(3.0)
    for shape in ("NaN", "infinite", "NaN target"):
        refused = f"stimulus '{shape}'"
        yield make_path_case(f"shape: {shape}", press, shape=shape, refused=refused)
    refused = "stimulus 'square'"
    yield make_path_case("shape without a name", press, shape="square", refused=refused)


def _list_starts() -> Iterator[Case]:
    start = Skins(np.full((1, 1387, 3), np.nan), make_motion(3.0)[None, 1])
    paths = Paths(np.array([0]), np.array([0.7]), make_motion(3.0, slide=(1.0, 0.0))[None, 1:])

    def solve(level: str | Level, retry: bool) -> Contacts:
        return follow(TACTIP_331, ("disk",), paths, level, start, retry=retry)[0]

    skins = "Skins(full((1, 1387, 3), nan), ...)"
    line = f"follow(TACTIP_331, ('disk',), {paths}, 'auto', {skins})"
    yield Case("continued from NaN forces", solve, line, refused="forces")


def _list_indices() -> Iterator[Case]:
    for value in (1, -1):
        paths = Paths(np.array([value]), np.array([0.7]), make_motion(3.0)[None])

        def solve(level: str | Level, retry: bool, paths: Paths = paths) -> Contacts:
            return follow(TACTIP_331, ("disk",), paths, level, retry=retry)[0]

        line = f"follow(TACTIP_331, ('disk',), {paths}, 'auto')"
        yield Case(f"stimulus {value} of 1", solve, line, refused="stimulus")
