"""Simulation of scenes: planned, solved in batches, each contact with its quality.

    contacts = simulate(TACTIP_331, ("disk",), scenes)
    contacts.pins  # (B, 331, 3) mm in the sensor frame

`follow` takes any path (press, slide, twist, tilt) and continues from where an earlier one ended.
"""

from dataclasses import replace

import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.progress import Counter
from jaxunshear.simulator.batches import make_undeformed_contacts, solve_batches
from jaxunshear.simulator.contacts import (
    Contacts,
    Skins,
    check_paths,
    check_scenes,
    check_start,
    check_start_at_rest,
)
from jaxunshear.simulator.level import STRONGER_LEVELS, Level, get_level
from jaxunshear.simulator.paths import Paths, make_paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.scheduler import BATCH, Simulation, Stimuli, make_plan


def simulate(
    sensor: Sensor,
    stimuli: Stimuli,
    scenes: Scenes,
    level: str | Level = "auto",
    batch: int = BATCH,
    retry: bool = True,
    progress: Counter | None = None,
) -> Contacts:
    """Solve the contacts of B scenes and return them in the order given.

    `scenes.stimulus` indexes `stimuli`. At a level that groups scenes, as `auto` does, those of a
    batch share nodes and increments. The pins of one scene then vary with its companions, by about
    0.1 px rms of a 256-px image; the same call gives the same pins. Raises `UserError` by name of
    the field.
    """
    check_scenes(scenes)
    simulation = Simulation(sensor, stimuli, get_level(level), batch)
    stronger = _find_stronger_level(level) if retry else None
    return _follow(simulation, make_paths(scenes), None, stronger, progress)[0]


def follow(
    sensor: Sensor,
    stimuli: Stimuli,
    paths: Paths,
    level: str | Level = "auto",
    start: Skins | None = None,
    batch: int = BATCH,
    retry: bool = True,
) -> tuple[Contacts, Skins]:
    """Solve B paths and return the contacts and the skins at their ends.

    With `start`, each path continues from its first point with that skin. A path that does not
    converge is solved again at the next stronger level, unless `retry` is False. One that still
    does not converge is returned as not converged: it is for the caller to drop and to count.
    """
    simulation = Simulation(sensor, stimuli, get_level(level), batch)
    stronger = _find_stronger_level(level) if retry else None
    return _follow(simulation, paths, start, stronger)


def _find_stronger_level(level: str | Level) -> str | None:
    stronger = STRONGER_LEVELS.get(level, "reference") if isinstance(level, str) else "reference"
    return None if level == stronger else stronger


def _follow(
    simulation: Simulation,
    paths: Paths,
    start: Skins | None,
    stronger: str | None,
    progress: Counter | None = None,
) -> tuple[Contacts, Skins]:
    """Follow paths, and again at the level `stronger` where they do not converge."""
    _check(simulation, paths, start)
    if not len(paths):
        return make_undeformed_contacts(simulation, paths)
    contacts, skins, incomplete = solve_batches(simulation, paths, start, progress)
    if incomplete.any():
        rows = np.flatnonzero(incomplete)
        again = solve_batches(simulation, paths.take(rows), _take(start, rows), wide=True)
        converged = again.contacts.converged & ~again.incomplete
        _replace_rows(contacts, rows, again.contacts._replace(converged=converged))
        _replace_rows(skins, rows, again.skins)
    if stronger is not None and not contacts.converged.all():
        rows = np.flatnonzero(~contacts.converged)
        retried, retried_skins = _follow(
            replace(simulation, level=get_level(stronger)),
            paths.take(rows),
            _take(start, rows),
            _find_stronger_level(stronger),
        )
        _replace_rows(contacts, rows, retried._replace(retried=np.ones(len(rows), bool)))
        _replace_rows(skins, rows, retried_skins)
    return contacts, skins


def _check(simulation: Simulation, paths: Paths, start: Skins | None) -> None:
    if simulation.batch < 1:
        raise UserError(f"batch = {simulation.batch}: solve at least 1 scene at a time")
    check_paths(simulation.sensor, len(simulation.stimuli), paths)
    if start is not None:
        check_start(paths, start, len(simulation.dome.nodes))
    else:
        check_start_at_rest(simulation.sensor, paths)


def _take(start: Skins | None, rows: np.ndarray) -> Skins | None:
    return None if start is None else start.take(rows)


def _replace_rows(old: Contacts | Skins, rows: np.ndarray, new: Contacts | Skins) -> None:
    """Overwrite rows in place."""
    for array, values in zip(old, new, strict=True):
        array[rows] = values


def plan(
    sensor: Sensor,
    stimuli: Stimuli,
    scenes: Scenes,
    level: str | Level = "auto",
    batch: int = BATCH,
) -> list[np.ndarray]:
    """List the scenes' rows, batch by batch, as `simulate` groups them."""
    check_scenes(scenes)
    paths = make_paths(scenes)
    check_paths(sensor, len(stimuli), paths)
    simulation = Simulation(sensor, stimuli, get_level(level), batch)
    return [part.rows for part in make_plan(simulation, paths)]
