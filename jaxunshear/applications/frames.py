"""Frames of a folder, checked to be of the sensor that a model learnt from."""

from collections.abc import Iterator

import numpy as np

from jaxunshear.applications.perceiver import Perceiver
from jaxunshear.dataset.recordings import Recordings, read_image
from jaxunshear.errors import UserError
from jaxunshear.image.preprocess import prepare_frame
from jaxunshear.image.understood import ENOUGH, inverse, plausibility, verdict

SAMPLED = 20  # frames that a folder is judged by
Frames = Iterator[tuple[int, str, np.ndarray]]  # row, name, image (S, S) uint8 of {0, 255}


def understood(recordings: Recordings, network: Perceiver, force: bool) -> Frames:
    """Those of the model's sensor, negatives turned; the others are left out and noted. Raises UserError at once where hardly any is, and
    in the end where none is. With `force`, all as they are."""
    turned = False
    if not force:
        found = verdict(_sample(recordings, network), network.expected)
        turned = found.inverted
        if turned:
            recordings.notes.append(f"{found.reason}: they are turned")
        elif not found.ok:
            raise UserError(f"{recordings.path}: {found.reason}; --force answers all the same")
    return _frames(recordings, network, turned, judged=not force and not turned)


def _sample(recordings: Recordings, network: Perceiver) -> np.ndarray:
    """(N, S, S): up to SAMPLED frames, evenly spaced."""
    files, problem, images = recordings.files, "", []
    for file in files[:: -(-len(files) // SAMPLED)]:
        view = network.view or recordings.common_view(file.parent)
        try:
            images.append(prepare_frame(network.preprocess, read_image(file), view))
        except UserError as error:
            problem = f"{file.name}: {error}"
    if not images:
        raise UserError(f"none of the sampled images in {recordings.path} can be read; the last: {problem}")
    return np.stack(images)


def _frames(recordings: Recordings, network: Perceiver, turned: bool, judged: bool) -> Frames:
    some = False
    for row, name, image in recordings.frames(network.view):
        if judged and plausibility(image, network.expected) < ENOUGH:
            recordings.notes.append(f"left out {name}: its pins are not those of the model's sensor")
            continue
        some = True
        yield row, name, inverse(image) if turned else image
    if not some:
        raise UserError(f"{recordings.path}: no image is one of the model's sensor; --force answers all the same")
