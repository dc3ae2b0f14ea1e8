"""Builds a graph of ONNX.

>>> graph = OnnxGraph()
>>> doubled = graph.add("Mul", "input", np.float32(2))     # the name of the node's output
>>> graph.add_output("twice", doubled, ("batch",))
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, ValueInfoProto, checker, helper, numpy_helper

# What runtimes of 2022 and later read: LayerNormalization came with it.
OPSET, IR_VERSION = 17, 8
FLOAT, BYTE = TensorProto.FLOAT, TensorProto.UINT8
Shape = Sequence[int | str]


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
