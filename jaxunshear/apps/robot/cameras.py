"""Cameras, by OpenCV: by number, by path, by URL, or by a pipeline of GStreamer.

>>> frames = read_camera("camera:0", 0, CameraSettings(size=(640, 480)))
>>> next(frames).pixels                                        # (480, 640, 3) uint8
"""

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxunshear.apps.robot.source_frame import SourceFrame
from jaxunshear.data.videos import import_opencv, order_colours
from jaxunshear.errors import UserError

Capture = Any  # OpenCV's, which has no types

CAMERA = "camera"
URL_SCHEMES = ("rtsp", "rtsps", "rtmp", "http", "https", "udp", "rtp", "srt")
# OpenCV's numbers, which are the same in all its versions
WIDTH, HEIGHT, FRAMES_PER_S, EXPOSURE, AUTO_EXPOSURE = 3, 4, 5, 15, 21
BY_HAND = 1.0  # of AUTO_EXPOSURE, as Video4Linux counts
GSTREAMER = 1800
MAX_FPS_ERROR = 0.1  # share by which a camera's rate may differ from the one asked for
RETRY_S = 0.01  # between reads that fail
MAX_FPS = 10_000
DEVICES = Path("/dev")
DEVICE_NAMES = Path("/sys/class/video4linux")
PROBED_CAMERAS = 10  # numbers that are tried if the system has no list of devices


@dataclass(frozen=True)
class CameraSettings:
    """What a camera is asked for; None leaves it as it is."""

    size: tuple[int, int] | None = None  # width and height, px
    fps: float | None = None
    exposure: float | None = None  # in the camera's own unit

    def check(self) -> None:
        """Raise UserError for what no camera can do."""
        if self.fps is not None and not 0 < self.fps <= MAX_FPS:
            raise UserError(f"--fps {self.fps:g}: use more than 0, at most {MAX_FPS}")
        if self.exposure is not None and not math.isfinite(self.exposure):
            raise UserError(f"--exposure {self.exposure:g}: use a number of the camera's own unit")


NO_SETTINGS = CameraSettings()


def parse_size(text: str) -> tuple[int, int]:
    """Parse a size such as 1280x720. Raises UserError."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if found is None:
        raise UserError(f"--size {text}: use width x height in px, such as 1280x720")
    return int(found[1]), int(found[2])


def parse_camera(source: str) -> int | str | None:
    """Return the number, path, URL or pipeline of a camera; None if `source` is no camera.

    Raises UserError for a camera that cannot be.
    """
    kind, _, device = source.partition(":")
    if kind != CAMERA:
        is_url = source.partition("://")[0] in URL_SCHEMES and "://" in source
        is_device = source.startswith(f"{DEVICES}/video")
        device = source if is_url or is_device or " ! " in source else ""
        if not device:
            return None
    if re.fullmatch(r"[0-9]{0,3}", device):
        return int(device or 0)
    if device.startswith("/") and not Path(device).exists():
        raise UserError(f"{device} does not exist: `jaxunshear stream list` shows the cameras")
    if not device.startswith("/") and "://" not in device and " ! " not in device:
        raise UserError(
            f"{source}: use camera:N with the number of the device, such as camera:0; "
            "`jaxunshear stream list` shows them"
        )
    return device


def read_camera(
    name: str, device: int | str, settings: CameraSettings
) -> Iterator[SourceFrame | None]:
    """Yield the frames of a camera without end, and None for a read that failed.

    Raises UserError if it cannot be opened, or does not do what it is asked for.
    """
    capture = _open(name, device)
    try:
        _configure(capture, name, settings)
        number = 0
        while True:
            pixels = _read(capture)
            if pixels is None:
                time.sleep(RETRY_S)
                yield None
                continue
            height, width = pixels.shape[:2]
            if not number and settings.size not in (None, (width, height)):
                raise UserError(
                    f"{name} gives {width} x {height} px, not --size "
                    "{}x{}: name a size that it has".format(*settings.size or ())
                )
            yield SourceFrame(number, f"{name} {number}", order_colours(pixels), time_s=time.time())
            number += 1
    finally:
        capture.release()


def _read(capture: Capture) -> np.ndarray | None:
    """Return a frame; None for a read that failed, by its answer or by an error of OpenCV's."""
    try:
        good, pixels = capture.read()
    except Exception:
        return None
    return pixels if good and np.size(pixels) else None


def _open(name: str, device: int | str) -> Capture:
    cv2 = import_opencv()
    is_pipeline = isinstance(device, str) and " ! " in device
    capture = cv2.VideoCapture(device, GSTREAMER) if is_pipeline else cv2.VideoCapture(device)
    if capture.isOpened():
        return capture
    if is_pipeline and not re.search(r"GStreamer: +YES", cv2.getBuildInformation()):
        raise UserError(
            f"{name}: this OpenCV was built without GStreamer, as those of PyPI are; "
            "use the system's own (python3-opencv of Debian)"
        )
    raise UserError(f"{name} cannot be opened: is it plugged in, and free?")


def _configure(capture: Capture, name: str, settings: CameraSettings) -> None:
    """Set what is asked for. Raises UserError if the camera refuses; the frames show the size."""
    if settings.size is not None:
        capture.set(WIDTH, settings.size[0])
        capture.set(HEIGHT, settings.size[1])
    if settings.fps is not None:
        capture.set(FRAMES_PER_S, settings.fps)
        fps = capture.get(FRAMES_PER_S)
        if fps > 0 and abs(fps / settings.fps - 1) > MAX_FPS_ERROR:
            raise UserError(
                f"{name} gives {fps:g} frames per s, not --fps {settings.fps:g}: "
                "name a rate that it has at this size"
            )
    if settings.exposure is not None:
        capture.set(AUTO_EXPOSURE, BY_HAND)
        if not capture.set(EXPOSURE, settings.exposure):
            raise UserError(f"{name} takes no --exposure: leave it out, or set it by its own tool")


def find_devices() -> list[int]:
    """Find the numbers of cameras that may be there."""
    if not DEVICE_NAMES.parent.is_dir():
        return list(range(PROBED_CAMERAS))
    numbers = (path.name.removeprefix("video") for path in DEVICES.glob("video*"))
    return sorted(int(number) for number in numbers if number.isdecimal())


def describe_device(number: int) -> str:
    """Return what the system calls a camera; empty if it does not say."""
    try:
        return (DEVICE_NAMES / f"video{number}" / "name").read_text().strip()
    except OSError:
        return ""
