"""Frames of a folder, and whether the folder is of the sensor that a model learnt from."""

from collections.abc import Iterator

import numpy as np

from jaxunshear.data.recordings import Recordings, read_image
from jaxunshear.errors import UserError
from jaxunshear.inference.perceiver import Perceiver
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.perception.sensor_check import NO_MINIMUM, invert_image, judge_images

SAMPLED_FRAMES = 20  # frames that a folder is judged by
Frames = Iterator[tuple[int, str, np.ndarray]]  # row, name, image (S, S) uint8 of {0, 255}


def open_frames(
    recordings: Recordings, network: Perceiver, force: bool
) -> tuple[Perceiver, Frames]:
    """Give the frames that can be read, negatives turned, and the network that is to answer them.

    Raises UserError at once where hardly any is of the model's sensor. With `force` all are answered as they are, but for those that
    networks over pins find no pins in.
    """
    if force:
        return network._replace(min_plausibility=NO_MINIMUM), recordings.iterate_frames(
            network.view
        )
    found = judge_images(_sample(recordings, network), network.expected)
    if found.inverted:
        recordings.notes.append(f"{found.reason}: they are turned")
        frames = recordings.iterate_frames(network.view)
        # what dark pins leave when they are turned looks less like the sensor than light pins do
        return network._replace(min_plausibility=NO_MINIMUM), (
            (row, name, invert_image(image)) for row, name, image in frames
        )
    if not found.ok:
        raise UserError(f"{recordings.path}: {found.reason}; --force answers all the same")
    return network, recordings.iterate_frames(network.view)


def _sample(recordings: Recordings, network: Perceiver) -> np.ndarray:
    """(N, S, S): up to SAMPLED frames, evenly spaced."""
    files, problem, images = recordings.files, "", []
    for file in files[:: -(-len(files) // SAMPLED_FRAMES)]:
        view = network.view or recordings.find_common_view(file.parent)
        try:
            images.append(prepare_frame(network.preprocess, read_image(file), view))
        except UserError as error:
            problem = f"{file.name}: {error}"
    if not images:
        raise UserError(
            f"none of the sampled images in {recordings.path} can be read; the last: {problem}"
        )
    return np.stack(images)
