"""Scenes in, pin positions out: planned, solved in batches, each contact with its quality.

    contacts = simulate(TACTIP_331, ("disk",), scenes)
    contacts.pins  # (B, 331, 3) mm in the sensor frame

`follow` takes any path (press, slide, twist, tilt) and goes on from where an earlier one ended.
"""

import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.progress import Progress
from jaxunshear.simulator.batches import (
    Stimuli,
    make_undeformed_contacts,
    plan_paths,
    sample_obstacles,
    solve_batches,
)
from jaxunshear.simulator.contact_results import Contacts, Skins
from jaxunshear.simulator.input_checks import (
    check_batch,
    check_paths,
    check_scenes,
    check_start,
    check_started,
    get_level,
)
from jaxunshear.simulator.level import STRONGER_LEVELS, Level
from jaxunshear.simulator.paths import Paths, make_paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.systems import load_shared_dome

BATCH = 64


def simulate(
    sensor: Sensor,
    stimuli: Stimuli,
    scenes: Scenes,
    level: str | Level = "auto",
    batch: int = BATCH,
    retry: bool = True,
    progress: Progress | None = None,
) -> Contacts:
    """Solve the contacts of B scenes and return them in the order given.

    `scenes.stimulus` indexes `stimuli`. At a level that groups scenes, as `auto` does, those of a batch
    share nodes and increments. The pins of one scene then vary with its companions, by about 0.1 px
    rms of a 256-px image; the same call gives the same pins. Raises `UserError` by name of the field.
    """
    check_scenes(scenes)
    return follow(
        sensor, stimuli, make_paths(scenes), level, batch=batch, retry=retry, progress=progress
    )[0]


def follow(
    sensor: Sensor,
    stimuli: Stimuli,
    paths: Paths,
    level: str | Level = "auto",
    start: Skins | None = None,
    batch: int = BATCH,
    retry: bool = True,
    progress: Progress | None = None,
) -> tuple[Contacts, Skins]:
    """Contacts at the ends of B paths, and the skins there; with `start`, each path goes on from its first point with that skin.

    What does not converge is solved again at the next stronger level, unless `retry` is False. What then still has not is
    returned as not converged: it is for the caller to drop and to count.
    """
    chosen = get_level(level)
    check_batch(batch)
    check_paths(sensor, len(stimuli), paths)
    if start is not None:
        check_start(paths, start, len(load_shared_dome(sensor).nodes))
    else:
        check_started(paths)
    if not len(paths):
        return make_undeformed_contacts(sensor, paths, chosen)
    obstacles = sample_obstacles(stimuli)
    contacts, skins, incomplete = solve_batches(
        sensor, obstacles, paths, chosen, start, batch, progress, wide=False
    )

    def replace(rows: np.ndarray, new: Contacts, new_skins: Skins) -> None:
        for field, value in zip((*contacts, *skins), (*new, *new_skins), strict=True):
            field[rows] = value

    if incomplete.any():
        rows = np.flatnonzero(incomplete)
        before = None if start is None else start.take(rows)
        new, new_skins, still = solve_batches(
            sensor, obstacles, paths.take(rows), chosen, before, batch, None, wide=True
        )
        replace(rows, new._replace(converged=new.converged & ~still), new_skins)
    stronger = STRONGER_LEVELS.get(level, "reference") if isinstance(level, str) else "reference"
    if retry and not contacts.converged.all() and level != stronger:
        rows = np.flatnonzero(~contacts.converged)
        before = None if start is None else start.take(rows)
        new, new_skins = follow(sensor, stimuli, paths.take(rows), stronger, before, batch)
        replace(rows, new._replace(retried=np.ones(len(rows), bool)), new_skins)
    return contacts, skins


def plan(
    sensor: Sensor, names: Stimuli, scenes: Scenes, level: str | Level = "auto", batch: int = BATCH
) -> list[np.ndarray]:
    """The scenes' rows, batch by batch, as `simulate` groups them."""
    check_scenes(scenes)
    paths = make_paths(scenes)
    check_paths(sensor, len(names), paths)
    return [
        part.rows
        for part in plan_paths(sensor, sample_obstacles(names), paths, get_level(level), batch)
    ]
