"""Walks around objects by the networks of a run, and what they are worth: how much of the outline, how close to it, how they ended.

>>> model = load_model("standard")
>>> (found,) = servo(model.folder, model.experiment, [ServoTask("disk", starts=1)], ("disentangled",))
>>> found.scores[0].mean_mm, found.walks.point           # mm from the edge; where the sensor went
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxunshear.config.experiment import Experiment, require_simulated
from jaxunshear.config.reach import compute_max_depth_mm
from jaxunshear.config.sensor import Sensor
from jaxunshear.downstream.contour import Contour, measure_contour_distances
from jaxunshear.downstream.servo import CLOSED, ENDS, LATE, ServoTask, Trajectories, follow_contour
from jaxunshear.errors import UserError
from jaxunshear.inference import perception
from jaxunshear.results.applications import TrajectoryScore
from jaxunshear.simulator.stimuli import get_closed_stimulus


@dataclass(frozen=True)
class ServoResult:
    """All walks around one object, and what they are worth."""

    course: ServoTask
    walks: Trajectories
    line: Contour
    scores: tuple[TrajectoryScore, ...]  # by way of perceiving


def servo(
    folder: Path,
    experiment: Experiment,
    tasks: Sequence[ServoTask],
    methods: tuple[str, ...] | None = None,
    out: Path | None = None,
) -> Iterator[ServoResult]:
    """Walks around objects by the networks of a finished run in `folder`, each object when it is done.

    `methods` to perceive are names of `perception.METHODS`, and `perception.TRUE_POSE`; None: all that the networks allow. Walks are kept as
    <out>/<object>.npz, and go on from there. Raises UserError, before anything is simulated, where that cannot be asked for.
    """
    paired, _ = require_simulated(experiment, "servo")
    for course in tasks:
        _check(course, experiment.sensor)
    if methods is None:
        known = perception.list_methods(folder)
        if not known:
            raise UserError(
                f"{folder} holds no trained networks to perceive by: train them first, or ask for --ways {perception.TRUE_POSE}"
            )
        methods = (perception.TRUE_POSE, *known)
    found = perception.make_edge_estimators(
        folder, experiment, tuple(way for way in methods if way != perception.TRUE_POSE)
    )
    perceive, digests = (
        {way: found.get(way) for way in methods},
        perception.compute_network_digests(folder, methods),
    )

    def run_task(course: ServoTask) -> ServoResult:
        file = out / f"{course.stimulus}.npz" if out else None
        walks, line = follow_contour(course, experiment.sensor, paired, perceive, file, digests)
        return ServoResult(
            course, walks, line, score_trajectories(walks, line, str(course.stimulus))
        )

    return map(run_task, tasks)


def _check(course: ServoTask, sensor: Sensor) -> None:
    """Raises UserError for what no walk can start with."""
    get_closed_stimulus(course.stimulus)
    if course.starts < 1:
        raise UserError(f"--starts {course.starts}: use at least 1")
    if course.seed < 0:
        raise UserError(f"--seed {course.seed}: use 0 or more")
    deepest = compute_max_depth_mm(sensor)
    if not 0 < course.depth_mm <= deepest:
        raise UserError(f"--depth {course.depth_mm:g}: use more than 0, up to {deepest:.1f} mm")


def score_trajectories(
    walks: Trajectories, line: Contour, stimulus: str
) -> tuple[TrajectoryScore, ...]:
    """For each way of perceiving."""
    rows = []
    for way in dict.fromkeys(walks.method.tolist()):
        mine = np.flatnonzero(walks.method == way)
        tracks = [
            measure_contour_distances(line, walks.point[w, ~np.isnan(walks.point[w, :, 0]), :2])
            for w in mine
        ]
        edge = np.concatenate([compute_perceived_edge(walks, int(w)) for w in mine])
        apart, seen = np.concatenate(tracks), measure_contour_distances(line, edge)
        ends = {ENDS[end]: int(np.sum(walks.end[mine] == end)) for end in range(CLOSED, LATE + 1)}
        taken = np.sum(~np.isnan(walks.point[mine, :, 0]))
        row = TrajectoryScore(
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
            unsolved=int(walks.failed_contacts[mine].sum()),
            steps=int(taken),
            unfollowed=int(taken - np.sum(~np.isnan(walks.perceived[mine, :, 0]))),
            perceive_ms=float(1e3 * walks.perceive_s[mine].sum() / max(taken, 1)),
        )
        rows.append(row)
    return tuple(rows)


def compute_perceived_edge(walks: Trajectories, walk: int) -> np.ndarray:
    """(T, 2) mm, target frame: where walk `walk` perceived the edge, step by step."""
    point, seen = walks.point[walk], walks.perceived[walk]
    there = ~np.isnan(point[:, 0]) & ~np.isnan(seen[:, 0])
    x, y, yaw = point[there].T
    distance, direction = seen[there].T
    angle = np.radians(yaw + direction)
    return np.stack([x - distance * np.cos(angle), y - distance * np.sin(angle)], -1)
