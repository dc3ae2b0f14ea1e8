"""A frame of any source of a stream, and how a source ends."""

from typing import NamedTuple

import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.perception.preprocess import View

FRAME_REMEDY = "a folder, an image, a video, camera:0 (`stream list` shows which), or - for stdin"


class SourceFrame(NamedTuple):
    number: int
    name: str
    pixels: np.ndarray | None  # None if it cannot be read
    problem: str = ""  # why it cannot be read
    view: View | None = None  # of the folder that it lies in, if any
    # when it was taken: of a video since its start, else since 1970; None for images in files
    time_s: float | None = None


class SourceLostError(UserError):
    """A live source that gave frames, and gives no more."""
