"""`jaxunshear reconstruct`: the shapes that walks around objects enclose, against the true ones."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment, require_simulated
from jaxunshear.data import simulated_contacts
from jaxunshear.data.chunks import unpack_bits
from jaxunshear.data.simulated_contacts import SimulatedContacts, simulate_contacts
from jaxunshear.downstream.contour import Contour, trace_contour
from jaxunshear.downstream.geometry import measure_tap_motions
from jaxunshear.downstream.reconstruct import (
    CELL_MM,
    HeightMap,
    ShapeScore,
    compute_skin_positions,
    fuse_heights,
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
from jaxunshear.downstream.shape_estimators import ShapeEstimator, make_shape_estimators
from jaxunshear.errors import UserError
from jaxunshear.inference import perception
from jaxunshear.inference.perception import Unshear
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.progress import Progress
from jaxunshear.results.applications import ObjectScore
from jaxunshear.simulator.stimuli import compute_distances, make_stimulus

STEPS_PER_IMAGE = 4  # steps, 2 mm: an image shows the skin of 12 mm around its middle


class ReconstructedObject(NamedTuple):
    """One walk's object."""

    fused: HeightMap
    shape: np.ndarray  # (K, K) bool
    true: np.ndarray  # (K, K) bool
    likeness: ShapeScore
    unmatched: int  # steps whose pins were not identified for sure
    level: (
        float | None
    )  # of the fused values, over which the object lies; none where it is what their ridge surrounds
    height_rms_mm: float | None  # of the felt top from the object's, where values are heights


def make_estimators_for(
    experiment: Experiment, known: SimulatedContacts
) -> dict[str, ShapeEstimator]:
    """The ways to an object by name, from taps whose poses and indentations are known."""
    paired, _ = require_simulated(experiment, "reconstruct")
    lattice = perception.compute_model_lattice(experiment)
    xy = transform_to_target(known.pose[:, :3], compute_skin_positions(experiment.sensor))
    distance = np.zeros(xy.shape[:2])
    for index, touched in enumerate(paired.stimuli):
        rows = known.stimulus == index
        distance[rows] = compute_distances(make_stimulus(touched), xy[rows])
    return make_shape_estimators(
        experiment.sensor,
        lattice,
        measure_tap_motions(lattice, known),
        known.indentation_mm,
        distance,
    )


def reconstruct_objects(
    experiment: Experiment,
    lattice: Lattice,
    trajectories: tuple[ServoTask, Trajectories],
    walk: int,
    line: Contour,
    unshear: Unshear | None,
    estimators: Mapping[str, ShapeEstimator],
) -> dict[str, ReconstructedObject]:
    """By maker, the object of one walk from every fourth of its images, unsheared or (None) as they are."""
    course, walks = trajectories
    there = np.flatnonzero(~np.isnan(walks.perceived[walk, :, 0]))[::STEPS_PER_IMAGE]
    images = unpack_bits(walks.images[walk, there], experiment.paired.preprocess.size)
    motion = measure_motions(lattice, images) if unshear is None else unshear(images)
    full = (
        float(np.abs(line.points).max()) + CELL_MM
    )  # also what a walk that ended early has not felt
    found = {}
    for name, maker in estimators.items():
        fused = fuse_heights(
            walks.point[walk, there],
            maker.locate_values(motion),
            maker.estimate_values(motion),
            full,
        )
        shape = maker.extract_shape(fused)
        true = compute_distances(make_stimulus(course.stimulus), fused.xy) < 0
        off = (fused.value - course.depth_mm)[true & ~np.isnan(fused.value)]
        rms = float(np.sqrt(np.mean(off**2))) if maker.in_mm and len(off) else None
        unmatched = int(np.isnan(motion[:, 0, 0]).sum())
        found[name] = ReconstructedObject(
            fused, shape, true, score_shape(fused, shape, true, line), unmatched, maker.level, rms
        )
    return found


@dataclass(frozen=True)
class ReconstructionResult:
    """What walks around one object make of it, by maker and way of perceiving."""

    course: ServoTask
    solids: Mapping[tuple[str, str], ReconstructedObject]  # of the walk of middling likeness
    scores: tuple[ObjectScore, ...]


def reconstruct(
    folder: Path, experiment: Experiment, trajectories: Sequence[tuple[ServoTask, Trajectories]]
) -> Iterator[ReconstructionResult]:
    """Objects from finished walks by networks of the run in `folder`, each when it is done.

    Images are unsheared by the network that the walk perceived by; those of walks that know the true pose, or read the
    pose code, by the disentangled one. Raises UserError, for walks that are of others before anything is simulated.
    """
    paired, _ = require_simulated(experiment, "reconstruct")
    for course, walks in trajectories:
        ways = tuple(dict.fromkeys(walks.method.tolist()))
        if (walks.end == WALKING).any():
            raise UserError(
                f"walks around {course.stimulus} are not finished: run the same `jaxunshear servo` command again"
            )
        if str(walks.provenance) != compute_servo_digest(
            experiment.sensor, paired, perception.compute_network_digests(folder, ways)
        ):
            raise UserError(
                f"walks around {course.stimulus} are of another model or sensor, or of an earlier simulator: name theirs with "
                "--model, or walk again"
            )
    networks = perception.load_unshearers(
        folder, experiment, perception.list_unshearing_networks(folder)
    )

    @cache
    def makers(depth: float) -> dict[str, ShapeEstimator]:
        return make_estimators_for(
            experiment, simulate_contacts(experiment, simulated_contacts.SCALE_TAPS, 1, depth)
        )

    return (_objects(experiment, each, networks, makers(each[0].depth_mm)) for each in trajectories)


def _objects(
    experiment: Experiment,
    walked: tuple[ServoTask, Trajectories],
    networks: Mapping[str, Unshear],
    makers: Mapping[str, ShapeEstimator],
) -> ReconstructionResult:
    course, walks = walked
    line = trace_contour(make_stimulus(course.stimulus))
    lattice = perception.compute_model_lattice(experiment)
    typical: dict[tuple[str, str], ReconstructedObject] = {}
    scores = []
    with Progress(f"reconstruct {course.stimulus}", len(walks.method), "walks") as progress:
        for way in dict.fromkeys(walks.method.tolist()):
            unshear = networks.get(perception.find_unshearing_network(way))
            rows, made = np.flatnonzero(walks.method == way), []
            for walk in rows:
                made.append(
                    reconstruct_objects(
                        experiment, lattice, walked, int(walk), line, unshear, makers
                    )
                )
                progress.advance()
            for maker in makers:
                mine = [each[maker] for each in made]
                order = np.argsort([each.likeness.iou for each in mine])
                typical[maker, way] = mine[order[len(order) // 2]]
                scores.append(_score(str(course.stimulus), maker, way, walks, rows, mine))
    return ReconstructionResult(course, typical, tuple(scores))


def _score(
    stimulus: str,
    maker: str,
    way: str,
    walks: Trajectories,
    rows: np.ndarray,
    solids: list[ReconstructedObject],
) -> ObjectScore:
    iou, mean_mm, hausdorff_mm, iou_felt = np.array([each.likeness for each in solids]).T
    heights = [each.height_rms_mm for each in solids if each.height_rms_mm is not None]
    return ObjectScore(
        name=f"{stimulus}/{maker}/{way}",
        stimulus=stimulus,
        object=maker,
        way=way,
        walks=len(rows),
        closed=int(np.sum(walks.end[rows] == CLOSED)),
        iou=float(iou.mean()),
        walk_iou=iou.tolist(),
        iou_felt=float(iou_felt.mean()),
        mean_mm=float(mean_mm.mean()),
        hausdorff_mm=float(hausdorff_mm.mean()),
        height_rms_mm=float(np.mean(heights)) if heights else None,
        level=solids[0].level,
        unmatched=int(sum(each.unmatched for each in solids)),
    )
