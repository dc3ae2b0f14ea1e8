"""`jaxunshear reconstruct`: the shapes that walks around objects enclose, against the true ones."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.dataset import fresh
from jaxunshear.dataset.chunks import unpack_bits
from jaxunshear.dataset.fresh import FreshContacts, fresh_contacts
from jaxunshear.downstream.contour import Contour, outline
from jaxunshear.downstream.geometry import known_motions
from jaxunshear.downstream.makers import Maker, makers_of
from jaxunshear.downstream.reconstruct import (
    CELL_MM,
    Fused,
    Likeness,
    fuse,
    likeness,
    skin_places,
    to_target,
)
from jaxunshear.downstream.servo import CLOSED, WALKING, Course, Walks, made_with
from jaxunshear.errors import UserError
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.pin_tracking import measure_motions
from jaxunshear.inference import perception
from jaxunshear.inference.perception import Unshear
from jaxunshear.progress import Progress
from jaxunshear.results.applications import ObjectScore
from jaxunshear.scene.stimuli import compute_distances, make_stimulus
from jaxunshear.settings.experiment import Experiment, simulated_of

EVERY = 4  # steps, 2 mm: an image shows the skin of 12 mm around its middle


class Solid(NamedTuple):
    """One walk's object."""

    fused: Fused
    shape: np.ndarray  # (K, K) bool
    true: np.ndarray  # (K, K) bool
    likeness: Likeness
    unmatched: int  # steps whose pins were not identified for sure
    level: (
        float | None
    )  # of the fused values, over which the object lies; none where it is what their ridge surrounds
    height_rms_mm: float | None  # of the felt top from the object's, where values are heights


def makers_for(experiment: Experiment, known: FreshContacts) -> dict[str, Maker]:
    """The ways to an object by name, from taps whose poses and indentations are known."""
    paired, _ = simulated_of(experiment, "reconstruct")
    lattice = perception.lattice_of(experiment)
    xy = to_target(known.pose[:, :3], skin_places(experiment.sensor))
    distance = np.zeros(xy.shape[:2])
    for index, touched in enumerate(paired.stimuli):
        rows = known.stimulus == index
        distance[rows] = compute_distances(make_stimulus(touched), xy[rows])
    return makers_of(
        experiment.sensor, lattice, known_motions(lattice, known), known.indentation_mm, distance
    )


def solids(
    experiment: Experiment,
    lattice: Lattice,
    walked: tuple[Course, Walks],
    walk: int,
    line: Contour,
    unshear: Unshear | None,
    makers: Mapping[str, Maker],
) -> dict[str, Solid]:
    """By maker, the object of one walk from every fourth of its images, unsheared or (None) as they are."""
    course, walks = walked
    there = np.flatnonzero(~np.isnan(walks.seen[walk, :, 0]))[::EVERY]
    images = unpack_bits(walks.images[walk, there], experiment.paired.preprocess.size)
    motion = measure_motions(lattice, images) if unshear is None else unshear(images)
    full = (
        float(np.abs(line.points).max()) + CELL_MM
    )  # also what a walk that ended early has not felt
    found = {}
    for name, maker in makers.items():
        fused = fuse(walks.point[walk, there], maker.place(motion), maker.value(motion), full)
        shape = maker.shape(fused)
        true = compute_distances(make_stimulus(course.stimulus), fused.xy) < 0
        off = (fused.value - course.depth_mm)[true & ~np.isnan(fused.value)]
        rms = float(np.sqrt(np.mean(off**2))) if maker.in_mm and len(off) else None
        unmatched = int(np.isnan(motion[:, 0, 0]).sum())
        found[name] = Solid(
            fused, shape, true, likeness(fused, shape, true, line), unmatched, maker.level, rms
        )
    return found


@dataclass(frozen=True)
class Objects:
    """What walks around one object make of it, by maker and way of perceiving."""

    course: Course
    solids: Mapping[tuple[str, str], Solid]  # of the walk of middling likeness
    scores: tuple[ObjectScore, ...]


def reconstruct(
    folder: Path, experiment: Experiment, walked: Sequence[tuple[Course, Walks]]
) -> Iterator[Objects]:
    """Objects from finished walks by networks of the run in `folder`, each when it is done.

    Images are unsheared by the network that the walk perceived by; those of walks that know the true pose, or read the
    pose code, by the disentangled one. Raises UserError, for walks that are of others before anything is simulated.
    """
    paired, _ = simulated_of(experiment, "reconstruct")
    for course, walks in walked:
        ways = tuple(dict.fromkeys(walks.way.tolist()))
        if (walks.end == WALKING).any():
            raise UserError(
                f"walks around {course.stimulus} are not finished: run the same `jaxunshear servo` command again"
            )
        if str(walks.made) != made_with(
            experiment.sensor, paired, perception.digests(folder, ways)
        ):
            raise UserError(
                f"walks around {course.stimulus} are of another model or sensor, or of an earlier simulator: name theirs with "
                "--model, or walk again"
            )
    networks = perception.unshearers(folder, experiment, perception.unshearing_of(folder))

    @cache
    def makers(depth: float) -> dict[str, Maker]:
        return makers_for(experiment, fresh_contacts(experiment, fresh.KNOWN, 1, depth))

    return (_objects(experiment, each, networks, makers(each[0].depth_mm)) for each in walked)


def _objects(
    experiment: Experiment,
    walked: tuple[Course, Walks],
    networks: Mapping[str, Unshear],
    makers: Mapping[str, Maker],
) -> Objects:
    course, walks = walked
    line = outline(make_stimulus(course.stimulus))
    lattice = perception.lattice_of(experiment)
    typical: dict[tuple[str, str], Solid] = {}
    scores = []
    with Progress(f"reconstruct {course.stimulus}", len(walks.way), "walks") as progress:
        for way in dict.fromkeys(walks.way.tolist()):
            unshear = networks.get(perception.unsheared_by(way))
            rows, made = np.flatnonzero(walks.way == way), []
            for walk in rows:
                made.append(solids(experiment, lattice, walked, int(walk), line, unshear, makers))
                progress.advance()
            for maker in makers:
                mine = [each[maker] for each in made]
                order = np.argsort([each.likeness.iou for each in mine])
                typical[maker, way] = mine[order[len(order) // 2]]
                scores.append(_score(str(course.stimulus), maker, way, walks, rows, mine))
    return Objects(course, typical, tuple(scores))


def _score(
    stimulus: str, maker: str, way: str, walks: Walks, rows: np.ndarray, solids: list[Solid]
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
