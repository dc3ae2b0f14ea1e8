"""Contact geometry of recordings, as they are and unsheared: the truth is not known."""

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
    estimator: HeightEstimator,
    networks: Mapping[str, Unshear],
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Estimate heights (N, P) mm of the first images at `path`, by kind; return names first.

    Rows are NaN for images that are not the sensor's.
    """
    names, images = [], []
    recordings = read_recordings(path, experiment.paired.preprocess)
    for _, name, image in islice(recordings.iterate_frames(), SHOWN_IMAGES):
        names.append(name)
        images.append(image)
    batch = np.stack(images)
    # networks over images render pins for any input, so the recorded image decides
    expected = measure_sensor_appearance(lattice.rest, batch.shape[-1])
    plausible = np.array(
        [not explain_rejection(True, compute_plausibility(image, expected)) for image in batch]
    )
    motions = {"as recorded": measure_motions(lattice, batch)}
    motions |= {name: unshear(batch) for name, unshear in networks.items()}
    heights = {}
    for kind, motion in motions.items():
        heights[kind] = np.where(plausible[:, None], estimator(motion), np.nan)
    return names, heights
