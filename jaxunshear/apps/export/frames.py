"""Makes `prepare_frame` of nodes of ONNX, for frames of one size and one crop.

Crop, border and resizing by area are one matrix on the rows and one on the columns.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.apps.export.onnx_graph import BYTE, FLOAT, OnnxGraph
from jaxunshear.config.sensor import Preprocess
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

CHECKED_FRAMES = 8  # frames on which the nodes are compared


class ExportCamera(NamedTuple):
    """Size and crop of a camera's frames, and how they are prepared."""

    preprocess: Preprocess
    box: Box
    frames: np.ndarray  # some of them, (N, H, W) or (N, H, W, channels) uint8


def read_camera(path: Path, preprocess: Preprocess, view: View | None) -> ExportCamera:
    """Read an image of a camera, or a folder of them. Raises UserError.

    `view` is that of the model, if it has one.
    """
    recordings = read_recordings(path, preprocess)
    box = (view or recordings.find_common_view()).box
    step = -(-len(recordings.files) // CHECKED_FRAMES)
    frames = [_read_frame(file) for file in recordings.files[::step]]
    first = frames[0]
    if any(frame.dtype != np.uint8 for frame in frames):
        raise UserError(
            f"--preprocess {path}: a frame of {first.dtype}; "
            "frames of 8 bits are prepared in the file"
        )
    if box is None or any(frame.shape != first.shape for frame in frames):
        raise UserError(f"--preprocess {path}: its images differ in size: name those of one camera")
    left, top, right, bottom = box
    if right - left != bottom - top:
        raise UserError(
            f"--preprocess {path}: the crop {left},{top},{right},{bottom} is no square: "
            "name other frames"
        )
    return ExportCamera(preprocess, box, np.stack(frames))


def _read_frame(file: Path) -> np.ndarray:
    try:
        return read_image(file)
    except UserError as error:
        raise UserError(f"--preprocess {file}: {error}") from None


def add_preprocessing(graph: OnnxGraph, camera: ExportCamera, frame: str) -> str:
    """Add the nodes from frames (B, H, W[, channels]) uint8 to bool images (B, S, S)."""
    preprocess, (left, top, right, bottom) = camera.preprocess, camera.box
    height, width, *channels = camera.frames.shape[1:]
    grey = graph.add("Div", graph.add("Cast", frame, to=FLOAT), np.float32(255))
    if channels:
        weights = np.zeros((channels[0], 1), np.float32)
        weights[:3, 0] = LUMA if channels[0] >= 3 else (1, 0, 0)[: channels[0]]
        grey = graph.add("Squeeze", graph.add("MatMul", grey, weights), np.array([-1]))
    rows = _make_crop_matrix(top, bottom, height, preprocess.size)
    columns = _make_crop_matrix(left, right, width, preprocess.size)
    small = _multiply_both_sides(graph, rows, grey, columns)
    mean = make_mean_matrix(preprocess)
    local_mean = _multiply_both_sides(graph, mean, small, mean)
    level = graph.add("Add", local_mean, np.float32(preprocess.offset))
    binary, middle = _find_levels(graph, grey)
    thresholded = graph.add("And", graph.add("Not", binary), graph.add("Greater", small, level))
    halved = graph.add("And", binary, graph.add("GreaterOrEqual", small, middle))
    white = graph.add("Or", thresholded, halved)
    return graph.add("And", white, make_mask(preprocess))


def add_uint8_cast(graph: OnnxGraph, white: str) -> str:
    """Add the nodes from bool to uint8 of {0, 255}."""
    scaled = graph.add("Mul", graph.add("Cast", white, to=FLOAT), np.float32(255))
    return graph.add("Cast", scaled, to=BYTE)


def preprocess_frames(camera: ExportCamera, frames: np.ndarray) -> np.ndarray:
    """Prepare frames (N, H, W[, channels]) with `prepare_frame`: (N, S, S) uint8 of {0, 255}."""
    return np.stack([prepare_frame(camera.preprocess, frame, View(camera.box)) for frame in frames])


def _make_crop_matrix(start: int, end: int, length: int, size: int) -> np.ndarray:
    """Make a matrix (size, length) that crops from `start` to `end` and resizes by area.

    Beyond the frame its border repeats.
    """
    cut = np.zeros((end - start, length), np.float32)
    cut[np.arange(end - start), np.clip(np.arange(start, end), 0, length - 1)] = 1
    return make_area_matrix(end - start, size) @ cut


def _multiply_both_sides(
    graph: OnnxGraph, rows: np.ndarray, image: str, columns: np.ndarray
) -> str:
    return graph.add("MatMul", rows, graph.add("MatMul", image, columns.T))


def _find_levels(graph: OnnxGraph, grey: str) -> tuple[str, str]:
    """Add nodes that find the level between dark and bright, as `is_binary` does.

    Returns whether a frame has two levels only (B, 1, 1), and their middle (B, 1, 1).
    """
    low = graph.add("ReduceMin", grey, axes=[1, 2])
    high = graph.add("ReduceMax", grey, axes=[1, 2])
    contrast = graph.add("Sub", high, low)
    near = graph.add("Mul", contrast, np.float32(0.1))
    dark = graph.add("Less", graph.add("Sub", grey, low), near)
    bright = graph.add("Less", graph.add("Sub", high, grey), near)
    extreme = graph.add("Cast", graph.add("Or", dark, bright), to=FLOAT)
    share = graph.add("ReduceMean", extreme, axes=[1, 2])
    distinct = graph.add("GreaterOrEqual", contrast, np.float32(0.25))
    binary = graph.add("And", distinct, graph.add("Greater", share, np.float32(0.97)))
    return binary, graph.add("Mul", graph.add("Add", low, high), np.float32(0.5))
