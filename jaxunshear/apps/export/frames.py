"""A camera's frame to a binary image as nodes of ONNX: what `prepare_frame` does, for frames of one size and one crop.

Crop, border and resizing by area are one matrix on the rows and one on the columns.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.apps.export.onnx_graph import BYTE, FLOAT, OnnxGraph
from jaxunshear.config.image import Preprocess
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.perception.grey import LUMA
from jaxunshear.perception.preprocess import (
    Box,
    View,
    make_area_matrix,
    make_mask,
    make_mean_matrix,
    prepare_frame,
)

CHECKED_FRAMES = 8  # frames that the nodes are compared by


class ExportCamera(NamedTuple):
    """What the frames of a robot's camera have in common."""

    preprocess: Preprocess
    box: Box
    frames: np.ndarray  # some of them, (N, H, W) or (N, H, W, channels) uint8


def read_camera(path: Path, preprocess: Preprocess, view: View | None) -> ExportCamera:
    """From an image, or a folder of them, as the camera will give them; `view` is the model's own, if it has one. Raises UserError."""
    recordings = read_recordings(path, preprocess)
    box = (view or recordings.find_common_view()).box
    frames = [
        _read(file) for file in recordings.files[:: -(-len(recordings.files) // CHECKED_FRAMES)]
    ]
    first = frames[0]
    if any(frame.dtype != np.uint8 for frame in frames):
        raise UserError(
            f"--preprocess {path}: a frame of {first.dtype}; frames of 8 bits are prepared in the file"
        )
    if box is None or any(frame.shape != first.shape for frame in frames):
        raise UserError(f"--preprocess {path}: its images differ in size: name those of one camera")
    left, top, right, bottom = box
    if right - left != bottom - top:
        raise UserError(
            f"--preprocess {path}: the crop {left},{top},{right},{bottom} is no square: name other frames"
        )
    return ExportCamera(preprocess, box, np.stack(frames))


def _read(file: Path) -> np.ndarray:
    try:
        return read_image(file)
    except UserError as error:
        raise UserError(f"--preprocess {file}: {error}") from None


def add_preprocessing(graph: OnnxGraph, camera: ExportCamera, frame: str) -> str:
    """Frames (B, H, W) or (B, H, W, channels) uint8 -> bool images (B, S, S)."""
    preprocess, (left, top, right, bottom) = camera.preprocess, camera.box
    height, width, *channels = camera.frames.shape[1:]
    grey = graph.add("Div", graph.add("Cast", frame, to=FLOAT), np.float32(255))
    if channels:
        weights = np.zeros((channels[0], 1), np.float32)
        weights[:3, 0] = LUMA if channels[0] >= 3 else (1, 0, 0)[: channels[0]]
        grey = graph.add("Squeeze", graph.add("MatMul", grey, weights), np.array([-1]))
    rows, columns = (
        _cut(*edges, preprocess.size) for edges in ((top, bottom, height), (left, right, width))
    )
    small = _both_sides(graph, rows, grey, columns)
    local = make_mean_matrix(preprocess)
    level = graph.add("Add", _both_sides(graph, local, small, local), np.float32(preprocess.offset))
    binary, middle = _levels(graph, grey)
    thresholded = graph.add("And", graph.add("Not", binary), graph.add("Greater", small, level))
    halved = graph.add("And", binary, graph.add("GreaterOrEqual", small, middle))
    white = graph.add("Or", thresholded, halved)
    return graph.add("And", white, make_mask(preprocess))


def add_uint8_cast(graph: OnnxGraph, white: str) -> str:
    """Bool -> uint8 of {0, 255}."""
    return graph.add(
        "Cast", graph.add("Mul", graph.add("Cast", white, to=FLOAT), np.float32(255)), to=BYTE
    )


def preprocess_frames(camera: ExportCamera, frames: np.ndarray) -> np.ndarray:
    """The same as `prepare_frame` makes of frames (N, H, W) or (N, H, W, channels): (N, S, S) uint8 of {0, 255}."""
    return np.stack([prepare_frame(camera.preprocess, frame, View(camera.box)) for frame in frames])


def _cut(start: int, end: int, length: int, size: int) -> np.ndarray:
    """(size, length): the pixels from `start` to `end` resized by area; beyond the frame its border repeats."""
    cut = np.zeros((end - start, length), np.float32)
    cut[np.arange(end - start), np.clip(np.arange(start, end), 0, length - 1)] = 1
    return make_area_matrix(end - start, size) @ cut


def _both_sides(graph: OnnxGraph, rows: np.ndarray, image: str, columns: np.ndarray) -> str:
    return graph.add("MatMul", rows, graph.add("MatMul", image, columns.T))


def _levels(graph: OnnxGraph, grey: str) -> tuple[str, str]:
    """(B, 1, 1) each: whether a frame is of two levels already, as `is_binary` finds it, and the level in their middle."""
    low, high = (graph.add(op, grey, axes=[1, 2]) for op in ("ReduceMin", "ReduceMax"))
    reach = graph.add("Sub", high, low)
    near = graph.add("Mul", reach, np.float32(0.1))
    dark, bright = (
        graph.add("Less", graph.add("Sub", *pair), near) for pair in ((grey, low), (high, grey))
    )
    of_two = graph.add("Cast", graph.add("Or", dark, bright), to=FLOAT)
    share = graph.add("ReduceMean", of_two, axes=[1, 2])
    apart = graph.add("GreaterOrEqual", reach, np.float32(0.25))
    binary = graph.add("And", apart, graph.add("Greater", share, np.float32(0.97)))
    return binary, graph.add("Mul", graph.add("Add", low, high), np.float32(0.5))
