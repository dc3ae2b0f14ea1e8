"""Predict poses and pins of labelled recorded contacts by the networks of a model."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.image import Preprocess
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recorded_probes import find_training_view
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError
from jaxunshear.inference.forward import AS_RECORDED
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.progress import Progress

BATCH = 32


class ContactPredictions(NamedTuple):
    """Predictions for N labelled contacts, from their images as recorded and unsheared.

    All predictions are NaN for a contact that the networks rejected.
    """

    labels: np.ndarray  # (N, 6)
    poses: dict[str, dict[str, np.ndarray]]  # (N,) by kind of image and quantity
    pins: dict[str, np.ndarray]  # (N, P, 2) px by kind of image, of networks over pins

    def select(self, rows: np.ndarray) -> "ContactPredictions":
        poses = {}
        for kind, quantities in self.poses.items():
            poses[kind] = {name: values[rows] for name, values in quantities.items()}
        pins = {kind: values[rows] for kind, values in self.pins.items()}
        return ContactPredictions(self.labels[rows], poses, pins)

    def count_accepted(self) -> int:
        """Count the contacts that have a prediction."""
        return int(np.isfinite(next(iter(self.poses[AS_RECORDED].values()))).sum())

    def count_rejected(self) -> int:
        return len(self.labels) - self.count_accepted()


def predict_contacts(
    network: TrainedModel, contacts: RecordedContacts, title: str
) -> ContactPredictions:
    """Predict poses and pins of all contacts, a batch at a time."""
    view = network.view or find_training_view(contacts, network.preprocess)
    count = len(contacts.files)
    poses: dict[str, dict[str, np.ndarray]] = {}
    pins: dict[str, np.ndarray] = {}
    with Progress(title, count, "frames") as progress:
        for start in range(0, count, BATCH):
            files = contacts.files[start : start + BATCH]
            rows = slice(start, start + len(files))
            predictions = network.predict(_read_images(files, network.preprocess, view))
            for kind, quantities in predictions.poses.items():
                all_quantities = poses.setdefault(kind, {})
                for name, values in quantities.items():
                    all_values = all_quantities.setdefault(name, np.full(count, np.nan))
                    all_values[rows] = values[: len(files)]
            for kind, values in predictions.pins.items():
                all_values = pins.setdefault(kind, np.full((count, *values.shape[1:]), np.nan))
                all_values[rows] = values[: len(files)]
            progress.advance(len(files))
    return ContactPredictions(contacts.pose, poses, pins)


def _read_images(files: Sequence[Path], preprocess: Preprocess, view: View) -> np.ndarray:
    """Read a batch of frames; those that cannot be read stay black, which networks reject."""
    images = np.zeros((BATCH, preprocess.size, preprocess.size), np.uint8)
    for index, file in enumerate(files):
        try:
            images[index] = prepare_frame(preprocess, read_image(file), view)
        except UserError:
            continue
    return images
