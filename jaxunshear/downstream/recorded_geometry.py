"""Contact geometry of recordings, as they are and unsheared: for inspection, as no truth is known."""

from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.data.recordings import read_recordings
from jaxunshear.downstream.geometry import HeightEstimator
from jaxunshear.inference.perception import Unshear
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.perception.sensor_check import (
    compute_plausibility,
    explain_rejection,
    measure_sensor_appearance,
)

SHOWN_IMAGES = 8


def estimate_recorded_heights(
    path: Path,
    experiment: Experiment,
    lattice: Lattice,
    way: HeightEstimator,
    networks: Mapping[str, Unshear],
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Names of the first images at `path`, and heights (N, P) mm by kind; NaN rows of images that are not understood."""
    _, names, images = zip(
        *islice(read_recordings(path, experiment.paired.preprocess).iterate_frames(), SHOWN_IMAGES),
        strict=True,
    )
    stack = np.stack(images)
    motions = {"as recorded": measure_motions(lattice, stack)} | {
        name: unshear(stack) for name, unshear in networks.items()
    }
    # networks over images draw pins whatever they are given
    expected = measure_sensor_appearance(lattice.rest, stack.shape[-1])
    known = np.array(
        [not explain_rejection(True, compute_plausibility(image, expected)) for image in stack]
    )
    return list(names), {
        kind: np.where(known[:, None], way(motion), np.nan) for kind, motion in motions.items()
    }
