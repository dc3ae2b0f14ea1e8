"""Walks around objects by the networks of a run, and what they are worth: how much of the outline, how close to it, how they ended.

>>> model = load_model("standard")
>>> (found,) = servo(model.folder, model.experiment, [Course("disk", starts=1)], ("disentangled",))
>>> found.scores[0].mean_mm, found.walks.point           # mm from the edge; where the sensor went
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxunshear.downstream.contour import Contour, off
from jaxunshear.downstream.servo import CLOSED, ENDS, LATE, Course, Walks, follow_contour
from jaxunshear.errors import UserError
from jaxunshear.inference import perception
from jaxunshear.results.applications import WalkScore
from jaxunshear.scene.stimuli import get_closed_stimulus
from jaxunshear.settings.experiment import Experiment, simulated_of
from jaxunshear.settings.reach import deepest_mm
from jaxunshear.settings.sensor import Sensor


@dataclass(frozen=True)
class Followed:
    """All walks around one object, and what they are worth."""

    course: Course
    walks: Walks
    line: Contour
    scores: tuple[WalkScore, ...]  # by way of perceiving


def servo(
    folder: Path,
    experiment: Experiment,
    courses: Sequence[Course],
    ways: tuple[str, ...] | None = None,
    out: Path | None = None,
) -> Iterator[Followed]:
    """Walks around objects by the networks of a finished run in `folder`, each object when it is done.

    `ways` to perceive are names of `perception.WAYS`, and `perception.TRUE`; None: all that the networks allow. Walks are kept as
    <out>/<object>.npz, and go on from there. Raises UserError, before anything is simulated, where that cannot be asked for.
    """
    paired, _ = simulated_of(experiment, "servo")
    for course in courses:
        _check(course, experiment.sensor)
    if ways is None:
        known = perception.ways_of(folder)
        if not known:
            raise UserError(
                f"{folder} holds no trained networks to perceive by: train them first, or ask for --ways {perception.TRUE}"
            )
        ways = (perception.TRUE, *known)
    found = perception.perceptions(
        folder, experiment, tuple(way for way in ways if way != perception.TRUE)
    )
    perceive, digests = {way: found.get(way) for way in ways}, perception.digests(folder, ways)

    def walked(course: Course) -> Followed:
        file = out / f"{course.stimulus}.npz" if out else None
        walks, line = follow_contour(course, experiment.sensor, paired, perceive, file, digests)
        return Followed(course, walks, line, walk_scores(walks, line, str(course.stimulus)))

    return map(walked, courses)


def _check(course: Course, sensor: Sensor) -> None:
    """Raises UserError for what no walk can start with."""
    get_closed_stimulus(course.stimulus)
    if course.starts < 1:
        raise UserError(f"--starts {course.starts}: use at least 1")
    if course.seed < 0:
        raise UserError(f"--seed {course.seed}: use 0 or more")
    deepest = deepest_mm(sensor)
    if not 0 < course.depth_mm <= deepest:
        raise UserError(f"--depth {course.depth_mm:g}: use more than 0, up to {deepest:.1f} mm")


def walk_scores(walks: Walks, line: Contour, stimulus: str) -> tuple[WalkScore, ...]:
    """For each way of perceiving."""
    rows = []
    for way in dict.fromkeys(walks.way.tolist()):
        mine = np.flatnonzero(walks.way == way)
        tracks = [off(line, walks.point[w, ~np.isnan(walks.point[w, :, 0]), :2]) for w in mine]
        edge = np.concatenate([seen_edge(walks, int(w)) for w in mine])
        apart, seen = np.concatenate(tracks), off(line, edge)
        ends = {ENDS[end]: int(np.sum(walks.end[mine] == end)) for end in range(CLOSED, LATE + 1)}
        taken = np.sum(~np.isnan(walks.point[mine, :, 0]))
        row = WalkScore(
            name=f"{stimulus}/{way}",
            stimulus=stimulus,
            way=way,
            starts=len(mine),
            completed=float(np.mean(np.clip(walks.way_mm[mine] / line.length, 0, 1))),
            closed=ends[ENDS[CLOSED]],
            mean_mm=float(apart.mean()),
            walk_mm=[float(track.mean()) for track in tracks],
            p95_mm=float(np.percentile(apart, 95)),
            largest_mm=float(apart.max()),
            seen_mean_mm=float(seen.mean()) if len(seen) else None,
            ends={name: count for name, count in ends.items() if count},
            unsolved=int(walks.unsolved[mine].sum()),
            steps=int(taken),
            unfollowed=int(taken - np.sum(~np.isnan(walks.seen[mine, :, 0]))),
            perceive_ms=float(1e3 * walks.perceive_s[mine].sum() / max(taken, 1)),
        )
        rows.append(row)
    return tuple(rows)


def seen_edge(walks: Walks, walk: int) -> np.ndarray:
    """(T, 2) mm, target frame: where walk `walk` perceived the edge, step by step."""
    point, seen = walks.point[walk], walks.seen[walk]
    there = ~np.isnan(point[:, 0]) & ~np.isnan(seen[:, 0])
    x, y, yaw = point[there].T
    distance, direction = seen[there].T
    angle = np.radians(yaw + direction)
    return np.stack([x - distance * np.cos(angle), y - distance * np.sin(angle)], -1)
