"""Opens the frames of a stream: of a folder, a video, a camera, or another program.

Frames of a camera or a connection that come while the robot thinks are dropped, not queued. A
source that gives no frame for a while is lost: a thread reads it, so that one that hangs is, too.

>>> source = open_source("camera:0", Preprocess(), CameraSettings(size=(1280, 720)))
>>> next(source.frames).pixels                                 # (720, 1280, 3) uint8
"""

import contextlib
import functools
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.apps.robot.cameras import (
    CAMERA,
    NO_SETTINGS,
    CameraSettings,
    describe_device,
    find_devices,
    parse_camera,
    read_camera,
)
from jaxunshear.apps.robot.messages import read_messages, read_tcp, read_zmq
from jaxunshear.apps.robot.source_frame import FRAME_REMEDY, SourceFrame, SourceLostError
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.targets import RECORDED_FIELDS
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.data.videos import is_video, read_video_frame
from jaxunshear.errors import UserError
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.preprocess import View

STDIN, TCP, ZMQ = "-", "tcp://", "zmq:"
FIRST_PATIENCE_S = 15.0  # for the first frame: to open a camera may take long
PATIENCE_S = 5.0  # for each frame after it
LIST_PATIENCE_S = 3.0  # for each camera of `stream list`
RELEASE_S = 1.0  # that a reading thread is given to release its camera


class Source(NamedTuple):
    frames: Iterator[SourceFrame]
    is_live: bool  # it may have no end of its own: a key ends it
    has_times: bool = True  # its frames say when they were taken


def open_source(
    source: str, preprocess: Preprocess, settings: CameraSettings = NO_SETTINGS
) -> Source:
    """Open a source by what the command line calls it.

    With `settings.fps` a folder or video plays at that rate, as if it were a camera. Raises
    UserError; frames of a live source may end by SourceLostError.
    """
    check_source(source, settings)
    device = parse_camera(source)
    if device is not None:
        return Source(read_newest(read_camera(source, device, settings), source), True)
    if source == STDIN:  # the program before us in the pipe waits: none is dropped
        return Source(read_messages(sys.stdin.buffer.read, "stdin"), True)
    for prefix, read in ((TCP, read_tcp), (ZMQ, read_zmq)):
        if source.startswith(prefix):
            return Source(read_newest(read(source.removeprefix(prefix)), source), True)
    path = Path(source)
    frames = _read_recordings(path, preprocess)
    if settings.fps:
        return Source(read_newest(_play(frames, settings.fps), source, math.inf), True)
    return Source(frames, False, is_video(path))


def check_source(source: str, settings: CameraSettings) -> None:
    """Check a source without opening it. Raises UserError for one that cannot be opened."""
    settings.check()
    if parse_camera(source) is not None:
        return
    if settings != CameraSettings(fps=settings.fps):
        raise UserError(f"--size and --exposure are of a camera, and {source} is none")
    if source == STDIN or source.startswith((TCP, ZMQ)):
        if settings.fps:
            raise UserError(
                f"--fps is of a camera or files: the program that sends {source} sets it"
            )
        return
    if not os.path.exists(source):  # unlike that of a Path it takes pipelines, which are long
        raise UserError(f"{source} does not exist: name {FRAME_REMEDY}")
    if os.path.isfile(source):
        read_recordings(source, Preprocess())  # refuses what is no image


class CameraText(NamedTuple):
    """What `stream list` says of a camera."""

    source: str
    picture: str  # empty if it gives none
    name: str


def find_cameras() -> list[CameraText]:
    """Find the cameras that may be there, and the size of the pictures that each gives."""
    found = []
    for number in find_devices():
        source, picture = f"{CAMERA}:{number}", ""
        camera = read_camera(source, number, NO_SETTINGS)
        frames = read_newest(camera, source, LIST_PATIENCE_S, LIST_PATIENCE_S)
        with contextlib.suppress(UserError), contextlib.closing(frames):
            shape = np.asarray(next(frames).pixels).shape
            picture = f"{shape[1]} x {shape[0]} px"
        name = describe_device(number)
        if name or picture:
            found.append(CameraText(source, picture, name))
    return found


def make_label_reader(
    source: str, model: TrainedModel
) -> Callable[[int], Mapping[str, float]] | None:
    """Make a function from a frame's number to its labels, for a folder of labelled frames.

    Returns None without labels, and for a model that was not trained on labels of these names.
    """
    if not os.path.isdir(source) or not model.source.has_frame:
        return None
    poses = read_recordings(source, Preprocess()).poses
    if poses is None:
        return None
    return lambda number: dict(zip(RECORDED_FIELDS, poses[number].tolist(), strict=True))


def _read_recordings(path: Path, preprocess: Preprocess) -> Iterator[SourceFrame]:
    recordings = read_recordings(path, preprocess)
    find_view = functools.cache(recordings.find_common_view)

    def read_all() -> Iterator[SourceFrame]:
        pairs = zip(recordings.files, recordings.names, strict=True)
        for number, (file, name) in enumerate(pairs):
            yield _read_frame(number, file, name, find_view(file.parent))

    return read_all()


def _read_frame(number: int, file: Path, name: str, view: View) -> SourceFrame:
    try:
        if not is_video(file.parent):
            return SourceFrame(number, name, read_image(file), view=view)
        pixels, time_s = read_video_frame(file)
        return SourceFrame(number, name, pixels, view=view, time_s=time_s)
    except UserError as error:
        return SourceFrame(number, name, None, str(error))


def _play(frames: Iterator[SourceFrame], fps: float) -> Iterator[SourceFrame]:
    start = time.monotonic()
    for index, frame in enumerate(frames):
        time.sleep(max(0.0, start + index / fps - time.monotonic()))
        yield frame._replace(time_s=time.time())


def read_newest(
    frames: Iterator[SourceFrame | None],
    name: str,
    patience_s: float = PATIENCE_S,
    first_patience_s: float = FIRST_PATIENCE_S,
) -> Generator[SourceFrame, None, None]:
    """Yield frames from a thread that never waits.

    A newer frame takes the place of one that was not fetched in time. None says that a source has
    nothing yet. Raises SourceLostError if no frame comes in time, and what `frames` raises.
    """
    newest = _NewestFrame()
    thread = threading.Thread(target=newest.read, args=(frames,), daemon=True, name="frames")
    thread.start()
    wait_s = max(first_patience_s, patience_s)
    try:
        while (frame := newest.take(name, wait_s)) is not None:
            yield frame
            wait_s = patience_s
    finally:
        newest.stopped.set()
        thread.join(RELEASE_S)


class _NewestFrame:
    """What a reading thread shares with the one that uses its frames."""

    def __init__(self) -> None:
        self.stopped = threading.Event()
        self._news = threading.Condition()
        self._frame: SourceFrame | None = None
        self._error: BaseException | None = None
        self._is_ended = False

    def read(self, frames: Iterator[SourceFrame | None]) -> None:
        try:
            for frame in frames:
                if self.stopped.is_set():
                    break
                if frame is not None:
                    with self._news:
                        self._frame = frame
                        self._news.notify()
        except BaseException as error:  # raised where the frames are used
            self._error = error
        finally:
            if isinstance(frames, Generator):  # which releases a camera
                frames.close()
            with self._news:
                self._is_ended = True
                self._news.notify()

    def take(self, name: str, wait_s: float) -> SourceFrame | None:
        """Return the newest frame, once; None at the end."""
        with self._news:
            limit = None if math.isinf(wait_s) else wait_s
            if not self._news.wait_for(lambda: self._frame or self._is_ended, limit):
                raise SourceLostError(
                    f"{name} gave no frame for {wait_s:g} s: is it still plugged in, or running?"
                )
            frame, self._frame = self._frame, None
        if frame is None and self._error is not None:
            raise self._error
        return frame
