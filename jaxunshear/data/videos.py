"""Read the frames of videos like images in a folder: `touch.mp4/000012` is the path of one.

OpenCV, of the extra `camera`, is imported when a video is read.
"""

import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.errors import UserError

VIDEOS = {".mp4", ".avi", ".mkv", ".mov", ".webm", ".mpg", ".mpeg", ".m4v"}
FFMPEG_QUIET = "-8"  # FFmpeg's AV_LOG_QUIET
POSITION_MS, FRAMES_PER_S, FRAME_COUNT = 0, 5, 7  # OpenCV's numbers of these properties
COUNT_ERROR = 1  # frames by which a container's own count, often an estimate, may be off
LISTED_VIDEOS = 256  # whose frames are counted once, though a command lists them several times


class VideoFrame(NamedTuple):
    pixels: np.ndarray  # (H, W, 3) uint8, red, green, blue
    time_s: float  # since the first frame


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEOS and os.path.isfile(path)


def import_opencv() -> Any:
    """Import OpenCV, so that it prints nothing by itself. Raises UserError if it is missing."""
    # we print one line ourselves; unlike its functions, its variables are the same in all versions
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", FFMPEG_QUIET)
    try:
        import cv2
    except ImportError:
        raise UserError(
            "videos and cameras need OpenCV, of the extra `camera`: "
            "pip install -c constraints.txt '.[camera]'"
        ) from None
    return cv2


def find_videos(folder: Path, notes: list[str]) -> Iterator[Path]:
    """Find the videos of a folder that can be read; the others are noted. Raises UserError."""
    for video in sorted(folder.iterdir()):
        if is_video(video) and not video.name.startswith("."):
            import_opencv()  # if it is missing, all are in vain
            try:
                list_video_frames(video)
            except UserError as error:
                notes.append(str(error))
                continue
            yield video


def list_video_frames(video: Path) -> tuple[Path, ...]:
    """List the frames of a video, as paths for `read_video_frame`.

    They are counted, as the counts of containers are estimates. A video that breaks off has one
    more, which cannot be read. Raises UserError for what is no video.
    """
    return _list_frames(video, video.stat().st_mtime_ns)


@lru_cache(maxsize=LISTED_VIDEOS)
def _list_frames(video: Path, changed_ns: int) -> tuple[Path, ...]:
    capture = _open_video(video)
    expected, count = capture.get(FRAME_COUNT), 0
    while capture.grab():
        count += 1
    capture.release()
    if not count:
        raise UserError(f"{video} holds no frame that can be read")
    breaks_off = expected > count + COUNT_ERROR
    return tuple(video / f"{number:06d}" for number in range(count + breaks_off))


def read_video_frame(file: Path) -> VideoFrame:
    """Read a frame that `list_video_frames` names. Raises UserError if the video ends before it.

    Frames in order are decoded once each; one before the last that was read starts anew.
    """
    video, number = file.parent, int(file.name)
    return _open_reader(video, video.stat().st_mtime_ns).read(number)


class _VideoReader:
    def __init__(self, video: Path) -> None:
        self._video = video
        self._start()

    def _start(self) -> None:
        self._capture, self._next = _open_video(self._video), 0
        self._last: VideoFrame | None = None  # the frame before the next

    def read(self, number: int) -> VideoFrame:
        if self._last is not None and number == self._next - 1:
            return self._last
        if number < self._next:
            self._start()
        self._last = None
        while self._next <= number:  # seeking is not exact in all containers
            if not self._capture.grab():
                raise UserError(f"the video breaks off after {self._next} frames")
            self._next += 1
        good, pixels = self._capture.retrieve()
        if not good:
            raise UserError("this frame of the video cannot be decoded")
        time_s = self._capture.get(POSITION_MS) / 1000
        if number and time_s <= 0:  # not every reader of OpenCV's knows it
            time_s = number / max(self._capture.get(FRAMES_PER_S), 1.0)
        self._last = VideoFrame(order_colours(pixels), time_s)
        return self._last


@lru_cache(maxsize=1)
def _open_reader(video: Path, changed_ns: int) -> _VideoReader:
    return _VideoReader(video)


def _open_video(video: Path) -> Any:
    capture = import_opencv().VideoCapture(str(video))
    if not capture.isOpened():
        raise UserError(
            f"{video} cannot be read as a video: it is damaged, or its format is unknown"
        )
    return capture


def order_colours(pixels: np.ndarray) -> np.ndarray:
    """Put OpenCV's colours (H, W, 3 or 4) in the order red, green, blue, without alpha.

    Greys (H, W) stay as they are.
    """
    if pixels.ndim < 3 or pixels.shape[-1] < 3:
        return pixels
    return pixels[..., 2::-1]
