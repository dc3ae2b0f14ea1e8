"""A model as a file of ONNX, and what onnxruntime computes of it. Needs the extra `onnx`."""

import numpy as np
import onnxruntime

from jaxunshear.apps.export import frames, networks
from jaxunshear.apps.export.frames import ExportCamera
from jaxunshear.apps.export.onnx_graph import BYTE, FLOAT, OnnxGraph
from jaxunshear.apps.export.parts import ExportedModel, Run
from jaxunshear.config.targets import list_target_names
from jaxunshear.files import Json
from jaxunshear.inference.perceiver import UNSHEARED


def build_onnx(
    parts: ExportedModel, batch: int | None, camera: ExportCamera | None, metadata: dict[str, str]
) -> bytes:
    """Input "frame" with a camera, else "image", or "pins"; outputs those of `parts.make_exported_function`, "pose" as one array (B, K), and with a
    camera the prepared "image". `batch`: None for any. Raises ValueError where the graph is not sound."""
    graph, images = OnnxGraph(), parts.rest is None
    name, shape = ("image" if images else "pins"), parts.shape
    many: int | str = "batch" if batch is None else batch
    if camera is not None:
        white = frames.add_preprocessing(graph, camera, "frame")
        graph.add_output("image", frames.add_uint8_cast(graph, white), (many, *shape), BYTE)
        name, shape = "frame", camera.frames.shape[1:]
        seen = graph.add("Cast", white, to=FLOAT)
    else:
        seen = (
            graph.add("Div", graph.add("Cast", name, to=FLOAT), np.float32(255)) if images else name
        )
    if images:
        seen = graph.add("Unsqueeze", seen, np.array([1]))
    after = seen
    if parts.unshear_network is not None:
        after = networks.unshear(
            graph, parts.unshear_network.net, parts.unshear_network.variables, seen
        )
        flat = graph.add("Squeeze", after, np.array([1])) if images else after
        graph.add_output("unsheared", flat, (many, *parts.shape))
        if images:
            graph.add_output("confidence", _confidence(graph, flat), (many,))
    if parts.pose_network is not None:
        read = after if parts.method == UNSHEARED else seen
        outputs = networks.predict(
            graph, parts.pose_network.net, parts.pose_network.variables, read
        )
        graph.add_output(
            "pose", networks.pose(graph, parts.targets, outputs), (many, len(parts.targets))
        )
    model = graph.model(name, (many, *shape), BYTE if images else FLOAT, metadata)
    return bytes(model.SerializeToString())


def _confidence(graph: OnnxGraph, images: str) -> str:
    """As `perception.confidence`, (B,)."""
    total, squares = (
        graph.add("ReduceSum", each, np.array([1, 2]), keepdims=0)
        for each in (images, graph.add("Mul", images, images))
    )
    some = graph.add("Greater", total, np.float32(0))
    return graph.add(
        "Where",
        some,
        graph.add("Div", squares, graph.add("Where", some, total, np.float32(1))),
        np.float32(0),
    )


def make_onnx_runner(model: bytes, parts: ExportedModel) -> Run:
    """onnxruntime on the CPU: a batch -> the outputs by name, "pose" by name of its quantities."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors alone
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    given = session.get_inputs()[0].name
    names = [output.name for output in session.get_outputs()]

    def run(batch: np.ndarray) -> Json:
        found: Json = dict(zip(names, session.run(None, {given: batch}), strict=True))
        if "pose" in found:
            found["pose"] = dict(
                zip(list_target_names(parts.targets), found["pose"].T, strict=True)
            )
        return found

    return run
