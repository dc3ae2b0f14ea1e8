"""Opens the frames of a stream: a folder, a video file or a camera.

Frames that come while the robot thinks are dropped, not queued.

>>> frames, live = open_frames("camera:0", Preprocess(), fps=None)
>>> next(frames).pixels                                        # (480, 640, 3) uint8
"""

import functools
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.targets import RECORDED_FIELDS
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.preprocess import View

VIDEOS = {".mp4", ".avi", ".mkv", ".mov", ".webm", ".mpg", ".mpeg", ".m4v"}
CAMERA = "camera"
FFMPEG_QUIET = "-8"  # FFmpeg's AV_LOG_QUIET
EXTRA = "pip install 'jaxunshear[camera]'"


class SourceFrame(NamedTuple):
    number: int
    name: str
    pixels: np.ndarray | None  # None if it cannot be read
    problem: str  # why it cannot be read
    view: View | None = None  # of the folder that it lies in, if any


def open_frames(
    source: str, preprocess: Preprocess, fps: float | None
) -> tuple[Iterator[SourceFrame], bool]:
    """Open a folder, an image, a video file or "camera:N"; return frames, and whether it is live.

    With `fps` a folder or video plays at that rate, as if it were a camera. Raises UserError.
    """
    if source == CAMERA or source.startswith(f"{CAMERA}:"):
        return _yield_latest(_open_camera(source)), True
    path = Path(source)
    if not path.exists():
        raise UserError(
            f"{source} does not exist: name a folder, an image, a video file, or camera:0"
        )
    is_video = path.is_file() and path.suffix.lower() in VIDEOS
    frames = _open_video(path) if is_video else _open_folder(path, preprocess)
    if fps:
        return _yield_latest(_play(frames, fps)), True
    return frames, False


def make_label_reader(
    source: str, model: TrainedModel
) -> Callable[[int], Mapping[str, float]] | None:
    """Make a function from a frame's number to its labels, for a folder of labelled frames.

    Returns None without labels, and for a model that was not trained on labels of these names.
    """
    if not Path(source).is_dir() or not model.source.has_frame:
        return None
    poses = read_recordings(source, Preprocess()).poses
    if poses is None:
        return None
    return lambda number: dict(zip(RECORDED_FIELDS, poses[number].tolist(), strict=True))


def _open_folder(path: Path, preprocess: Preprocess) -> Iterator[SourceFrame]:
    recordings = read_recordings(path, preprocess)
    find_view = functools.cache(recordings.find_common_view)

    def read_all() -> Iterator[SourceFrame]:
        pairs = zip(recordings.files, recordings.names, strict=True)
        for number, (file, name) in enumerate(pairs):
            yield _read_frame(number, file, name, find_view(file.parent))

    return read_all()


def _read_frame(number: int, file: Path, name: str, view: View) -> SourceFrame:
    try:
        return SourceFrame(number, name, read_image(file), "", view)
    except UserError as error:
        return SourceFrame(number, name, None, str(error))


def _import_opencv() -> Any:
    # we print one line ourselves; unlike its functions, its variables are the same in all versions
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", FFMPEG_QUIET)
    try:
        import cv2
    except ImportError:
        raise UserError(f"videos and cameras need OpenCV: {EXTRA}") from None
    return cv2


def _open_video(path: Path) -> Iterator[SourceFrame]:
    capture = _import_opencv().VideoCapture(str(path))
    if not capture.isOpened():
        raise UserError(
            f"{path} cannot be read as a video: it is damaged, or its format is unknown"
        )
    return _capture_frames(capture, path.name, float("inf"))


def _open_camera(source: str) -> Iterator[SourceFrame]:
    number = source.partition(":")[2] or "0"
    if not number.isdigit():
        raise UserError(f"{source}: use camera:N with the number of the device, such as camera:0")
    capture = _import_opencv().VideoCapture(int(number))
    if not capture.isOpened():
        raise UserError(f"camera {number} cannot be opened: is it plugged in, and free?")
    return _capture_frames(capture, f"camera {number}", 30)


def _capture_frames(capture: Any, name: str, patience: float) -> Iterator[SourceFrame]:
    """Yield frames until the end, or until `patience` frames of a camera in a row fail."""
    number = failed = 0
    expected = capture.get(7)  # CAP_PROP_FRAME_COUNT; zero or less for a camera
    try:
        while failed < patience:
            good, pixels = capture.read()
            if good:
                failed = 0
                yield SourceFrame(number, f"{name} {number}", order_colours(pixels), "")
            elif number >= expected > 0 or patience == float("inf"):
                if number < expected:
                    problem = f"the video breaks off after {number} of {expected:.0f} frames"
                    yield SourceFrame(number, f"{name} {number}", None, problem)
                return
            else:
                failed += 1
                yield SourceFrame(number, f"{name} {number}", None, "the camera gave no frame")
            number += 1
        raise UserError(f"{name} gave no frame {failed} times in a row: is it still plugged in?")
    finally:
        capture.release()


def order_colours(pixels: np.ndarray) -> np.ndarray:
    """Put OpenCV's colours (H, W, 3 or 4) in the order red, green, blue, without alpha.

    Greys (H, W) stay as they are.
    """
    if pixels.ndim < 3 or pixels.shape[-1] < 3:
        return pixels
    return pixels[..., 2::-1]


def _play(frames: Iterator[SourceFrame], fps: float) -> Iterator[SourceFrame]:
    start = time.monotonic()
    for index, frame in enumerate(frames):
        time.sleep(max(0.0, start + index / fps - time.monotonic()))
        yield frame


def _yield_latest(frames: Iterator[SourceFrame]) -> Iterator[SourceFrame]:
    """Yield frames from a thread that never waits.

    A newer frame takes the place of one that was not fetched in time.
    """
    newest: list[SourceFrame] = []
    errors: list[BaseException] = []
    news = threading.Condition()
    ended = threading.Event()
    stopped = threading.Event()

    def read() -> None:
        try:
            for frame in frames:
                if stopped.is_set():
                    break
                with news:
                    newest[:] = [frame]
                    news.notify()
        except BaseException as error:  # raised where the frames are used
            errors.append(error)
        finally:
            ended.set()
            with news:
                news.notify()

    threading.Thread(target=read, daemon=True, name="frames").start()
    try:
        while True:
            with news:
                news.wait_for(lambda: newest or ended.is_set())
                if not newest:
                    break
                frame = newest.pop()
            yield frame
        if errors:
            raise errors[0]
    finally:
        stopped.set()
