"""`jaxunshear reconstruct`: the shapes that walks around objects enclose, against the true ones."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.applications.contour import Outline, outline
from jaxunshear.applications.fresh import FreshContacts
from jaxunshear.applications.geometry_scores import growths, known_growths
from jaxunshear.applications.occupancy import Occupancy, evidence, learn
from jaxunshear.applications.perception import Unshear, in_batches, unsheared_by
from jaxunshear.applications.reconstruct import (
    CELL_MM,
    Fused,
    Likeness,
    filled_shape,
    fuse,
    likeness,
    skin_places,
    to_target,
)
from jaxunshear.applications.servo import CLOSED, Course, Walks
from jaxunshear.dataset.chunks import unpack
from jaxunshear.experiment import Experiment, simulated_of
from jaxunshear.image.framing import undeformed
from jaxunshear.image.lattice import Lattice
from jaxunshear.progress import Progress
from jaxunshear.scene.stimuli import Stimulus, signed_distance, stimulus_named

EVERY = 4  # steps, 2 mm: an image shows the skin of 12 mm around its middle


class Solid(NamedTuple):
    """One walk's object."""

    fused: Fused
    shape: np.ndarray  # (K, K) bool
    true: np.ndarray  # (K, K) bool
    likeness: Likeness
    unmatched: int  # steps whose pins were not identified for sure


def occupancy_of(experiment: Experiment, known: FreshContacts) -> Occupancy:
    """What parts skin over the object from skin beside it, learnt from taps whose poses are known."""
    paired, _ = simulated_of(experiment, "reconstruct")
    lattice = undeformed(experiment.sensor, paired.camera, paired.preprocess)
    place = skin_places(experiment.sensor)
    xy = to_target(known.pose[:, :3], place)
    distance = np.zeros(xy.shape[:2])
    for index, name in enumerate(paired.stimuli):
        rows = known.stimulus == index
        distance[rows] = _distance(stimulus_named(name), xy[rows])
    return learn(lattice, place, known_growths(lattice, known), distance)


def solid(
    experiment: Experiment,
    lattice: Lattice,
    walks: Walks,
    walk: int,
    line: Outline,
    stimulus: Stimulus,
    unshear: Unshear | None,
    occupancy: Occupancy,
) -> Solid:
    """The object of one walk from every fourth of its images, unsheared or (None) as they are."""
    there = np.flatnonzero(~np.isnan(walks.seen[walk, :, 0]))[::EVERY]
    images = unpack(walks.images[walk, there], experiment.paired.preprocess.size)
    if unshear is not None:
        images = in_batches(unshear, images)
    growth = growths(lattice, images)
    place = skin_places(experiment.sensor)[occupancy.near]
    whole = float(np.abs(line.points).max()) + CELL_MM  # also what a walk that ended early has not felt
    fused = fuse(walks.point[walk, there], place, evidence(occupancy, growth), whole)
    shape = filled_shape(fused)
    true = _distance(stimulus, np.stack(np.meshgrid(fused.x, fused.y), -1)) < 0
    return Solid(fused, shape, true, likeness(fused, shape, true, line), int(np.isnan(growth[:, 0]).sum()))


def objects_of(
    experiment: Experiment, walked: tuple[Course, Walks], networks: Mapping[str, Unshear], occupancy: Occupancy
) -> dict[str, tuple[dict[str, Any], Solid]]:
    """By way of perceiving: means over its walks as a row, and the object of its walk of middling likeness.

    Images are unsheared by the network that the walk perceived by; those of walks that know the true pose, or read the
    pose code, by the disentangled one.
    """
    course, walks = walked
    stimulus = stimulus_named(course.stimulus)
    line = outline(stimulus)
    paired, _ = simulated_of(experiment, "reconstruct")
    lattice = undeformed(experiment.sensor, paired.camera, paired.preprocess)
    found = {}
    ways = list(dict.fromkeys(walks.way.tolist()))
    with Progress(f"reconstruct {course.stimulus}", len(walks.way), "walks") as progress:
        for way in ways:
            unshear = networks.get(unsheared_by(way))
            rows, solids = np.flatnonzero(walks.way == way), []
            for walk in rows:
                solids.append(solid(experiment, lattice, walks, int(walk), line, stimulus, unshear, occupancy))
                progress.advance()
            order = np.argsort([each.likeness.iou for each in solids])
            found[way] = _row(course.stimulus, way, walks, rows, solids), solids[order[len(order) // 2]]
    return found


def _row(stimulus: str, way: str, walks: Walks, rows: np.ndarray, solids: list[Solid]) -> dict[str, Any]:
    scores = np.array([each.likeness for each in solids])
    return {
        "name": f"{stimulus}/{way}",
        "stimulus": stimulus,
        "way": way,
        "walks": len(rows),
        "closed": int(np.sum(walks.end[rows] == CLOSED)),
        "iou": float(scores[:, 0].mean()),
        "iou_least": float(scores[:, 0].min()),
        "mean_mm": float(scores[:, 1].mean()),
        "hausdorff_mm": float(scores[:, 2].mean()),
        "unmatched": int(sum(each.unmatched for each in solids)),
    }


def _distance(stimulus: Stimulus, xy: np.ndarray) -> np.ndarray:
    """(N, M) mm of points (N, M, 2) mm from the object, negative over it."""
    rows = jnp.asarray(xy, jnp.float32)
    return np.asarray(jax.jit(lambda xy: jax.lax.map(lambda row: signed_distance(stimulus, row), xy))(rows))
