"""Reconstruct objects from trajectories around them, and score their shapes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from jaxunshear.data.chunks import unpack_bits
from jaxunshear.data.simulation import SCALE_TAPS, simulate_contacts
from jaxunshear.downstream.contour import Contour, trace_contour
from jaxunshear.downstream.geometry import measure_tap_motions
from jaxunshear.downstream.reconstruct import (
    CELL_MM,
    HeightMap,
    ShapeEstimator,
    ShapeScore,
    compute_skin_positions,
    fuse_heights,
    make_shape_estimators,
    score_shape,
    transform_to_target,
)
from jaxunshear.downstream.servo import (
    CLOSED,
    WALKING,
    ServoTask,
    Trajectories,
    compute_servo_digest,
)
from jaxunshear.errors import UserError
from jaxunshear.inference.edge_methods import (
    Unshear,
    compute_network_digests,
    find_unshearing_network,
    load_unshearers,
)
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.progress import Progress
from jaxunshear.results.applications import ObjectScore
from jaxunshear.simulator.stimuli import compute_distances, make_stimulus

STEPS_PER_IMAGE = 4  # steps, 2 mm: an image shows the skin of 12 mm around its middle


class ReconstructedObject(NamedTuple):
    """The object of one trajectory."""

    fused: HeightMap
    shape: np.ndarray  # (K, K) bool
    true: np.ndarray  # (K, K) bool
    score: ShapeScore
    unmatched: int  # steps whose pins were not identified
    level: float | None  # the object is where the fused values are higher; None for a ridge
    height_rms_mm: float | None  # error of the estimated top, if values are heights


@dataclass(frozen=True)
class ReconstructionResult:
    """Reconstructions of one object, by estimator and method of perception."""

    task: ServoTask
    objects: Mapping[tuple[str, str], ReconstructedObject]  # of the trajectory of median IoU
    scores: tuple[ObjectScore, ...]


class _Target(NamedTuple):
    task: ServoTask
    trajectories: Trajectories
    contour: Contour
    lattice: Lattice
    image_px: int


def reconstruct(
    model: TrainedModel, trajectories: Sequence[tuple[ServoTask, Trajectories]]
) -> Iterator[ReconstructionResult]:
    """Reconstruct objects from finished trajectories by the networks of a model.

    Images are unsheared by the network that the trajectory perceived by. If it used the true pose,
    they are unsheared by the disentangled network. Results come one by one. Raises UserError for
    trajectories of other networks or unfinished ones, before anything is simulated.
    """
    paired = model.require_simulation("reconstruct")
    for task, task_trajectories in trajectories:
        methods = task_trajectories.list_methods()
        if (task_trajectories.end == WALKING).any():
            raise UserError(
                f"walks around {task.stimulus} are not finished: "
                "run the same `jaxunshear servo` command again"
            )
        digests = compute_network_digests(model, methods)
        if str(task_trajectories.provenance) != compute_servo_digest(model.sensor, paired, digests):
            raise UserError(
                f"walks around {task.stimulus} are of another model or sensor, "
                "or of an earlier simulator: name theirs with --model, or walk again"
            )
    networks = load_unshearers(model)

    @cache
    def make_estimators(depth_mm: float) -> dict[str, ShapeEstimator]:
        taps = simulate_contacts(model.experiment, SCALE_TAPS, 1, depth_mm)
        xy = transform_to_target(taps.pose[:, :3], compute_skin_positions(model.sensor))
        distance = np.zeros(xy.shape[:2])
        for index, stimulus in enumerate(paired.stimuli):
            rows = taps.stimulus == index
            distance[rows] = compute_distances(make_stimulus(stimulus), xy[rows])
        motion = measure_tap_motions(model.lattice, taps)
        return make_shape_estimators(
            model.sensor, model.lattice, motion, taps.indentation_mm, distance
        )

    def reconstruct_task(task: ServoTask, trajectories: Trajectories) -> ReconstructionResult:
        contour = trace_contour(make_stimulus(task.stimulus))
        target = _Target(task, trajectories, contour, model.lattice, paired.preprocess.size)
        return _reconstruct_task(target, networks, make_estimators(task.depth_mm))

    return (reconstruct_task(*each) for each in trajectories)


def _reconstruct_task(
    target: _Target, networks: Mapping[str, Unshear], estimators: Mapping[str, ShapeEstimator]
) -> ReconstructionResult:
    task, trajectories = target.task, target.trajectories
    typical: dict[tuple[str, str], ReconstructedObject] = {}
    scores = []
    with Progress(f"reconstruct {task.stimulus}", len(trajectories.method), "walks") as progress:
        for method in trajectories.list_methods():
            unshear = networks.get(find_unshearing_network(method))
            rows = np.flatnonzero(trajectories.method == method)
            by_row = []
            for row in rows:
                by_row.append(_reconstruct_trajectory(target, int(row), unshear, estimators))
                progress.advance()
            closed = int(np.sum(trajectories.end[rows] == CLOSED))
            for estimator in estimators:
                objects = [each[estimator] for each in by_row]
                order = np.argsort([each.score.iou for each in objects])
                typical[estimator, method] = objects[order[len(order) // 2]]
                scores.append(
                    _score_objects(str(task.stimulus), estimator, method, objects, closed)
                )
    return ReconstructionResult(task, typical, tuple(scores))


def _reconstruct_trajectory(
    target: _Target, row: int, unshear: Unshear | None, estimators: Mapping[str, ShapeEstimator]
) -> dict[str, ReconstructedObject]:
    """Reconstruct the object of one trajectory by each estimator, from some of its images.

    The images are unsheared, or used as they are if `unshear` is None.
    """
    task, trajectories, contour, lattice, image_px = target
    perceived = ~np.isnan(trajectories.perceived[row, :, 0])
    steps = np.flatnonzero(perceived)[::STEPS_PER_IMAGE]
    images = unpack_bits(trajectories.images[row, steps], image_px)
    motion = measure_motions(lattice, images) if unshear is None else unshear(images)
    unmatched = int(np.isnan(motion[:, 0, 0]).sum())
    # also cover what a trajectory that ended early has not touched
    cover_mm = float(np.abs(contour.points).max()) + CELL_MM
    objects = {}
    for name, estimator in estimators.items():
        fused = fuse_heights(
            trajectories.point[row, steps],
            estimator.locate_values(motion),
            estimator.estimate_values(motion),
            cover_mm,
        )
        shape = estimator.extract_shape(fused)
        true = compute_distances(make_stimulus(task.stimulus), fused.xy) < 0
        height_rms_mm = None
        if estimator.in_mm:
            error = (fused.value - task.depth_mm)[true & ~np.isnan(fused.value)]
            height_rms_mm = float(np.sqrt(np.mean(error**2))) if len(error) else None
        score = score_shape(fused, shape, true, contour)
        objects[name] = ReconstructedObject(
            fused, shape, true, score, unmatched, estimator.level, height_rms_mm
        )
    return objects


def _score_objects(
    stimulus: str, estimator: str, method: str, objects: list[ReconstructedObject], closed: int
) -> ObjectScore:
    iou, mean_mm, hausdorff_mm, iou_touched = np.array([each.score for each in objects]).T
    heights = [each.height_rms_mm for each in objects if each.height_rms_mm is not None]
    return ObjectScore(
        name=f"{stimulus}/{estimator}/{method}",
        stimulus=stimulus,
        object=estimator,
        way=method,
        walks=len(objects),
        closed=closed,
        iou=float(iou.mean()),
        walk_iou=iou.tolist(),
        iou_felt=float(iou_touched.mean()),
        mean_mm=float(mean_mm.mean()),
        hausdorff_mm=float(hausdorff_mm.mean()),
        height_rms_mm=float(np.mean(heights)) if heights else None,
        level=objects[0].level,
        unmatched=int(sum(each.unmatched for each in objects)),
    )
