"""The frames of a folder, and whether they are of a model's sensor."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxunshear.data.recordings import Recordings, read_image
from jaxunshear.errors import UserError
from jaxunshear.inference.perceiver import Perceiver
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.perception.sensor_check import NO_MINIMUM, invert_image, judge_images

SAMPLED_FRAMES = 20  # frames by which a folder is judged


class Frame(NamedTuple):
    row: int  # of the recordings
    name: str
    image: np.ndarray  # (S, S) uint8 of {0, 255}


def open_frames(
    recordings: Recordings, perceiver: Perceiver, force: bool
) -> tuple[Perceiver, Iterator[Frame]]:
    """Open the readable frames; return the perceiver with the rule that these images need.

    Negatives are inverted. Raises UserError at once if hardly any frame is of the model's sensor.
    With `force` all frames are used as they are, except those without pins for pin networks.
    """
    frames = (Frame(*frame) for frame in recordings.iterate_frames(perceiver.view))
    if force:
        return perceiver._replace(min_plausibility=NO_MINIMUM), frames
    verdict = judge_images(_sample_images(recordings, perceiver), perceiver.expected)
    if verdict.inverted:
        recordings.notes.append(f"{verdict.reason}: they are turned")
        # inverted dark pins are less like the sensor's than light pins
        return perceiver._replace(min_plausibility=NO_MINIMUM), (
            frame._replace(image=invert_image(frame.image)) for frame in frames
        )
    if not verdict.ok:
        raise UserError(f"{recordings.path}: {verdict.reason}; --force answers all the same")
    return perceiver, frames


def _sample_images(recordings: Recordings, perceiver: Perceiver) -> np.ndarray:
    """Read (N, S, S) from up to SAMPLED_FRAMES files, evenly spaced."""
    files, problem, images = recordings.files, "", []
    for file in files[:: -(-len(files) // SAMPLED_FRAMES)]:
        view = perceiver.view or recordings.find_common_view(file.parent)
        try:
            images.append(prepare_frame(perceiver.preprocess, read_image(file), view))
        except UserError as error:
            problem = f"{file.name}: {error}"
    if not images:
        raise UserError(
            f"none of the sampled images in {recordings.path} can be read; the last: {problem}"
        )
    return np.stack(images)
