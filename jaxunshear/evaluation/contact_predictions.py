"""Predict poses and pins of labelled recorded contacts by the networks of a model."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxunshear.config.sensor import Preprocess
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
        return jax.tree.map(lambda values: values[rows], self)

    @property
    def accepted(self) -> np.ndarray:
        """Which contacts (N,) have a prediction."""
        return np.isfinite(next(iter(self.poses[AS_RECORDED].values())))


def predict_contacts(
    network: TrainedModel, contacts: RecordedContacts, title: str
) -> ContactPredictions:
    """Predict poses and pins of all contacts, a batch at a time."""
    view = network.view or find_training_view(contacts, network.preprocess)
    count = len(contacts.files)
    batches = []
    with Progress(title, count, "frames") as progress:
        for start in range(0, count, BATCH):
            files = contacts.files[start : start + BATCH]
            predictions = network.predict(_read_images(files, network.preprocess, view))
            batches.append((predictions.poses, predictions.pins))
            progress.advance(len(files))

    def join(*parts: np.ndarray) -> np.ndarray:
        return np.concatenate(parts, dtype=np.float64)[:count]

    return ContactPredictions(contacts.pose, *jax.tree.map(join, *batches))


def _read_images(files: Sequence[Path], preprocess: Preprocess, view: View) -> np.ndarray:
    """Read a batch of frames; those that cannot be read stay black, which networks reject."""
    images = np.zeros((BATCH, preprocess.size, preprocess.size), np.uint8)
    for index, file in enumerate(files):
        try:
            images[index] = prepare_frame(preprocess, read_image(file), view)
        except UserError:
            continue
    return images
