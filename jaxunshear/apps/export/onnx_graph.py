"""Builds a graph of ONNX, and `prepare_frame` of its nodes for frames of one size and one crop.

>>> graph = OnnxGraph()
>>> doubled = graph.add("Mul", "input", np.float32(2))     # the name of the node's output
>>> graph.add_output("twice", doubled, ("batch",))

Crop, border and resizing by area are one matrix on the rows and one on the columns.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from onnx import ModelProto, TensorProto, ValueInfoProto, checker, helper, numpy_helper

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.perception.grey import LUMA, MIN_CONTRAST
from jaxunshear.perception.preprocess import (
    MIN_THRESHOLD_SCALE,
    USUAL_CONTRAST,
    Box,
    View,
    make_area_matrix,
    make_mask,
    make_mean_matrix,
    prepare_frame,
)

# What runtimes of 2022 and later read: LayerNormalization came with it.
OPSET, IR_VERSION = 17, 8
FLOAT, BYTE, BOOL = TensorProto.FLOAT, TensorProto.UINT8, TensorProto.BOOL
Shape = Sequence[int | str]
CHECKED_FRAMES = 8  # frames on which the nodes are compared


class OnnxGraph:
    """Nodes in the order in which they run."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[TensorProto] = []
        self._outputs: list[ValueInfoProto] = []

    def add(self, op: str, *inputs: str | np.ndarray | np.generic, **attributes: Any) -> str:
        """Add a node and return the name of its output; arrays among its inputs are constants."""
        names = [
            each if isinstance(each, str) else self._add_constant(np.asarray(each))
            for each in inputs
        ]
        name = f"{op}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(op, names, [name], **attributes))
        return name

    def add_output(self, name: str, node: str, shape: Shape, kind: int = FLOAT) -> None:
        """Make an output of the graph from that of a node."""
        self._nodes.append(helper.make_node("Identity", [node], [name]))
        self._outputs.append(helper.make_tensor_value_info(name, kind, shape))

    def build(self, name: str, shape: Shape, kind: int, metadata: dict[str, str]) -> ModelProto:
        """Build and check the model of a graph with one input."""
        inputs = [helper.make_tensor_value_info(name, kind, shape)]
        graph = helper.make_graph(self._nodes, "jaxunshear", inputs, self._outputs, self._constants)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="jaxunshear",
        )
        helper.set_model_props(model, metadata)
        checker.check_model(model, full_check=True)
        return model

    def _add_constant(self, array: np.ndarray) -> str:
        name = f"constant_{len(self._constants)}"
        contiguous = np.ascontiguousarray(array).reshape(array.shape)  # which has a dimension more
        self._constants.append(numpy_helper.from_array(contiguous, name))
        return name


class ExportCamera(NamedTuple):
    """Size and crop of a camera's frames, and how they are prepared."""

    preprocess: Preprocess
    box: Box
    frames: np.ndarray  # some of them, (N, H, W) or (N, H, W, channels) uint8
    dark: bool  # whether markers are dark on a light ground


def read_camera(path: Path, preprocess: Preprocess, view: View | None) -> ExportCamera:
    """Read an image of a camera, or a folder of them. Raises UserError.

    `view` crops the frames; without it the crop is found in them.
    """
    recordings = read_recordings(path, preprocess)
    view = view or recordings.find_common_view()
    box = view.box
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
    return ExportCamera(preprocess, box, np.stack(frames), view.dark)


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
    if camera.dark:
        grey = graph.add("Sub", np.float32(1), grey)
    rows = _make_crop_matrix(top, bottom, height, preprocess.size)
    columns = _make_crop_matrix(left, right, width, preprocess.size)
    small = _multiply_both_sides(graph, rows, grey, columns)
    mean = make_mean_matrix(preprocess)
    local_mean = _multiply_both_sides(graph, mean, small, mean)
    difference = graph.add("Sub", small, local_mean)
    level = _find_threshold(graph, difference, preprocess)
    binary, middle = _find_levels(graph, grey)
    above = graph.add("Greater", difference, level)
    thresholded = graph.add("And", graph.add("Not", binary), above)
    halved = graph.add("And", binary, graph.add("GreaterOrEqual", small, middle))
    white = graph.add("Or", thresholded, halved)
    return graph.add("And", white, make_mask(preprocess))


def add_uint8_cast(graph: OnnxGraph, white: str) -> str:
    """Add the nodes from bool to uint8 of {0, 255}."""
    scaled = graph.add("Mul", graph.add("Cast", white, to=FLOAT), np.float32(255))
    return graph.add("Cast", scaled, to=BYTE)


def preprocess_frames(camera: ExportCamera, frames: np.ndarray) -> np.ndarray:
    """Prepare frames (N, H, W[, channels]) with `prepare_frame`: (N, S, S) uint8 of {0, 255}."""
    view = View(camera.box, dark=camera.dark)
    return np.stack([prepare_frame(camera.preprocess, frame, view) for frame in frames])


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


def _find_threshold(graph: OnnxGraph, difference: str, preprocess: Preprocess) -> str:
    """Add nodes that scale the threshold by the contrast (B, 1, 1), as `binarise` does."""
    mask = make_mask(preprocess).astype(np.float32)
    power = graph.add("Mul", graph.add("Mul", difference, difference), mask / mask.mean())
    contrast = graph.add("Sqrt", graph.add("ReduceMean", power, axes=[1, 2]))
    scale = graph.add("Div", contrast, np.float32(USUAL_CONTRAST))
    scale = graph.add("Clip", scale, np.float32(MIN_THRESHOLD_SCALE), np.float32(1))
    return graph.add("Mul", scale, np.float32(preprocess.offset))


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
    distinct = graph.add("GreaterOrEqual", contrast, np.float32(MIN_CONTRAST))
    binary = graph.add("And", distinct, graph.add("Greater", share, np.float32(0.97)))
    return binary, graph.add("Mul", graph.add("Add", low, high), np.float32(0.5))
