"""Builds a file of ONNX, and runs it with onnxruntime. Needs the extra `onnx`."""

import numpy as np
import onnxruntime

from jaxunshear.apps.export import networks, onnx_graph, sensor_check
from jaxunshear.apps.export.onnx_graph import BOOL, BYTE, FLOAT, ExportCamera, OnnxGraph
from jaxunshear.apps.export.parts import ExportedModel, Run
from jaxunshear.config.targets import list_target_names
from jaxunshear.files import Json
from jaxunshear.inference.forward import UNSHEARED
from jaxunshear.perception.sensor_check import MIN_PLAUSIBILITY


def build_onnx(
    parts: ExportedModel, batch: int | None, camera: ExportCamera | None, metadata: dict[str, str]
) -> bytes:
    """Build the file. Raises ValueError if the graph is not sound.

    The input is "frame" with a camera, else "image" or "pins". The outputs are those of
    `parts.make_exported_function`, with "pose" as one array (B, K), and with a camera the prepared
    "image". `batch` is None for any.
    """
    graph, images = OnnxGraph(), parts.rest is None
    name, shape = ("image" if images else "pins"), parts.shape
    count: int | str = "batch" if batch is None else batch
    if camera is not None:
        white = onnx_graph.add_preprocessing(graph, camera, "frame")
        graph.add_output("image", onnx_graph.add_uint8_cast(graph, white), (count, *shape), BYTE)
        name, shape = "frame", camera.frames.shape[1:]
        inputs = graph.add("Cast", white, to=FLOAT)
    elif images:
        inputs = graph.add("Div", graph.add("Cast", name, to=FLOAT), np.float32(255))
    else:
        inputs = name
    if images:
        inputs = graph.add("Unsqueeze", inputs, np.array([1]))
    if images:
        confidence = sensor_check.add_image_plausibility(graph, parts.check, inputs)
    else:
        confidence = sensor_check.add_pin_plausibility(graph, parts.check, inputs)
    sure = graph.add("GreaterOrEqual", confidence, np.float32(MIN_PLAUSIBILITY))
    graph.add_output("sure", sure, (count,), BOOL)
    unsheared = inputs
    if parts.unshear_network is not None:
        net, variables, _ = parts.unshear_network
        unsheared = networks.add_network(graph, net, variables, inputs)
        flat = graph.add("Squeeze", unsheared, np.array([1])) if images else unsheared
        by_place = graph.add("Unsqueeze", sure, np.array([1, 2]))
        graph.add_output("unsheared", _keep(graph, by_place, flat), (count, *parts.shape))
        if images:
            confidence = graph.add("Mul", confidence, _add_confidence(graph, flat))
    if parts.pose_network is not None:
        pose_inputs = unsheared if parts.method == UNSHEARED else inputs
        net, variables, targets = parts.pose_network
        outputs = networks.add_network(graph, net, variables, pose_inputs)
        pose = networks.add_pose(graph, targets, outputs)
        by_row = graph.add("Unsqueeze", sure, np.array([1]))
        graph.add_output("pose", _keep(graph, by_row, pose), (count, len(targets)))
    graph.add_output("confidence", graph.add("Where", sure, confidence, np.float32(0)), (count,))
    model = graph.build(name, (count, *shape), BYTE if images else FLOAT, metadata)
    return bytes(model.SerializeToString())


def _keep(graph: OnnxGraph, sure: str, values: str) -> str:
    return graph.add("Where", sure, values, np.float32(np.nan))


def _add_confidence(graph: OnnxGraph, images: str) -> str:
    """Add the nodes of `perception.confidence` (B,)."""
    axes = np.array([1, 2])
    total = graph.add("ReduceSum", images, axes, keepdims=0)
    squares = graph.add("ReduceSum", graph.add("Mul", images, images), axes, keepdims=0)
    is_positive = graph.add("Greater", total, np.float32(0))
    divisor = graph.add("Where", is_positive, total, np.float32(1))
    share = graph.add("Div", squares, divisor)
    return graph.add("Where", is_positive, share, np.float32(0))


def make_onnx_runner(model: bytes, parts: ExportedModel) -> Run:
    """Make a function from a batch to the outputs by name, with "pose" by name of its quantities.

    It runs on the CPU.
    """
    session = open_session(model)
    input_name = session.get_inputs()[0].name
    names = [output.name for output in session.get_outputs()]

    def run(batch: np.ndarray) -> Json:
        outputs: Json = dict(zip(names, session.run(None, {input_name: batch}), strict=True))
        if "pose" in outputs:
            targets = list_target_names(parts.targets)
            outputs["pose"] = dict(zip(targets, outputs["pose"].T, strict=True))
        return outputs

    return run


def open_session(model: bytes) -> onnxruntime.InferenceSession:
    """Open a session on the CPU for the bytes of a model."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors alone
    # threads that wait for work in a loop take cores from a camera's driver
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
