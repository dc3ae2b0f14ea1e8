"""Follow contours by the networks of a run, and score the trajectories.

>>> model = load_model("standard")
>>> (result,) = servo(model, [ServoTask("disk", starts=1)], ("sheared",))
>>> result.scores[0].mean_mm, result.trajectories.point    # mm from the edge; the sensor's poses
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxunshear.config.contact_rings import compute_max_depth_mm
from jaxunshear.config.sensor import Sensor
from jaxunshear.downstream.contour import Contour, measure_contour_distances
from jaxunshear.downstream.servo import CLOSED, ENDS, LATE, ServoTask, Trajectories, follow_contour
from jaxunshear.errors import UserError
from jaxunshear.inference import edge_methods
from jaxunshear.inference.edge_methods import TRUE_POSE
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.results.applications import TrajectoryScore
from jaxunshear.simulator.stimuli import get_closed_stimulus

MAX_STARTS = 10_000  # more may not fit into memory


@dataclass(frozen=True)
class ServoResult:
    """All trajectories around one object, and their scores."""

    task: ServoTask
    trajectories: Trajectories
    contour: Contour
    scores: tuple[TrajectoryScore, ...]  # by method of perception


def servo(
    model: TrainedModel,
    tasks: Sequence[ServoTask],
    methods: tuple[str, ...] | None = None,
    out: Path | None = None,
) -> Iterator[ServoResult]:
    """Follow contours in the simulator by the networks of a model; results come one by one.

    Raises UserError, before anything is simulated, if the tasks or methods are impossible.

    Args:
        tasks: The objects, and how they are followed.
        methods: Names of `edge_methods.METHODS`, or TRUE_POSE; None for all that there are
            networks for.
        out: A folder in which trajectories are saved as <object>.npz, and from which they continue.
    """
    paired = model.require_simulation("servo")
    for task in tasks:
        _check_task(task, model.sensor)
    if methods is None:
        available = edge_methods.list_methods(model)
        if not available:
            raise UserError(
                f"{model.folder} holds no trained networks to perceive by: "
                f"train them first, or ask for --ways {TRUE_POSE}"
            )
        methods = (TRUE_POSE, *available)
    estimators = edge_methods.make_edge_estimators(model, methods)
    digests = edge_methods.compute_network_digests(model, methods)

    def run_task(task: ServoTask) -> ServoResult:
        file = out / f"{task.stimulus}.npz" if out else None
        trajectories, contour = follow_contour(
            task, model.sensor, paired, estimators, file, digests
        )
        scores = score_trajectories(trajectories, contour, str(task.stimulus))
        return ServoResult(task, trajectories, contour, scores)

    return map(run_task, tasks)


def _check_task(task: ServoTask, sensor: Sensor) -> None:
    get_closed_stimulus(task.stimulus)
    if not 1 <= task.starts <= MAX_STARTS:
        raise UserError(f"--starts {task.starts}: use at least 1, at most {MAX_STARTS}")
    if task.seed < 0:
        raise UserError(f"--seed {task.seed}: use 0 or more")
    deepest = compute_max_depth_mm(sensor)
    if not 0 < task.depth_mm <= deepest:
        raise UserError(f"--depth {task.depth_mm:g}: use more than 0, up to {deepest:.1f} mm")


def score_trajectories(
    trajectories: Trajectories, contour: Contour, stimulus: str
) -> tuple[TrajectoryScore, ...]:
    """Score the trajectories of each method of perception."""
    return tuple(
        _score_method(trajectories, contour, stimulus, method)
        for method in trajectories.list_methods()
    )


def _score_method(
    trajectories: Trajectories, contour: Contour, stimulus: str, method: str
) -> TrajectoryScore:
    rows = np.flatnonzero(trajectories.method == method)
    distances, perceived_edges = [], []
    for row in rows:
        point = trajectories.point[row]
        xy = point[~np.isnan(point[:, 0]), :2]
        distances.append(measure_contour_distances(contour, xy))
        perceived_edges.append(compute_perceived_edge(trajectories, int(row)))
    distance = np.concatenate(distances)
    edge_distance = measure_contour_distances(contour, np.concatenate(perceived_edges))
    ends = {
        ENDS[end]: int(np.sum(trajectories.end[rows] == end)) for end in range(CLOSED, LATE + 1)
    }
    steps = np.sum(~np.isnan(trajectories.point[rows, :, 0]))
    followed = np.sum(~np.isnan(trajectories.perceived[rows, :, 0]))
    completed = np.clip(trajectories.way_mm[rows] / contour.length, 0, 1)
    return TrajectoryScore(
        name=f"{stimulus}/{method}",
        stimulus=stimulus,
        way=method,
        starts=len(rows),
        completed=float(np.mean(completed)),
        closed=ends[ENDS[CLOSED]],
        mean_mm=float(distance.mean()),
        walk_mm=[float(each.mean()) for each in distances],
        p95_mm=float(np.percentile(distance, 95)),
        largest_mm=float(distance.max()),
        seen_mean_mm=float(edge_distance.mean()) if len(edge_distance) else None,
        ends={name: count for name, count in ends.items() if count},
        unsolved=int(trajectories.failed_contacts[rows].sum()),
        steps=int(steps),
        unfollowed=int(steps - followed),
        perceive_ms=float(1e3 * trajectories.perceive_s[rows].sum() / max(steps, 1)),
    )


def compute_perceived_edge(trajectories: Trajectories, row: int) -> np.ndarray:
    """Compute where one trajectory perceived the edge at each step: (T, 2) mm, target frame."""
    point, perceived = trajectories.point[row], trajectories.perceived[row]
    known = ~np.isnan(point[:, 0]) & ~np.isnan(perceived[:, 0])
    x, y, yaw = point[known].T
    distance, direction = perceived[known].T
    angle = np.radians(yaw + direction)
    return np.stack([x - distance * np.cos(angle), y - distance * np.sin(angle)], -1)
