"""Contact geometry of recordings, as they are and unsheared: for inspection, as no truth is known."""

from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from jaxunshear.applications.geometry_ways import Way
from jaxunshear.applications.perception import Unshear
from jaxunshear.dataset.recordings import read_recordings
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.tracking import motions_of
from jaxunshear.settings.experiment import Experiment

SHOWN = 8


def heights_of_recordings(
    path: Path, experiment: Experiment, lattice: Lattice, way: Way, networks: Mapping[str, Unshear]
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Names of the first images at `path`, and heights (N, P) mm by kind; NaN rows where pins are not those of the model's sensor."""
    _, names, images = zip(*islice(read_recordings(path, experiment.paired.preprocess).frames(), SHOWN), strict=True)
    stack = np.stack(images)
    motions = {"as recorded": motions_of(lattice, stack)} | {name: unshear(stack) for name, unshear in networks.items()}
    return list(names), {kind: way(motion) for kind, motion in motions.items()}
