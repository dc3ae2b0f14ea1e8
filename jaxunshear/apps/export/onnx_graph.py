"""A graph of ONNX in the making.

>>> graph = OnnxGraph()
>>> doubled = graph.add("Mul", "given", np.float32(2))     # the name of what the node gives
>>> graph.give("twice", doubled, ("batch",))
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
    """Its nodes in the order in which they run."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[TensorProto] = []
        self._outputs: list[ValueInfoProto] = []

    def add(self, op: str, *inputs: str | np.ndarray | np.generic, **attributes: Any) -> str:
        """The name of the one array that a node gives; arrays among the given ones are its constants."""
        names = [
            each if isinstance(each, str) else self._constant(np.asarray(each)) for each in inputs
        ]
        name = f"{op}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(op, names, [name], **attributes))
        return name

    def add_output(self, name: str, what: str, shape: Shape, kind: int = FLOAT) -> None:
        """Makes an output of what a node gives."""
        self._nodes.append(helper.make_node("Identity", [what], [name]))
        self._outputs.append(helper.make_tensor_value_info(name, kind, shape))

    def model(self, name: str, shape: Shape, kind: int, metadata: dict[str, str]) -> ModelProto:
        """The graph of one input, checked."""
        given = [helper.make_tensor_value_info(name, kind, shape)]
        graph = helper.make_graph(self._nodes, "jaxunshear", given, self._outputs, self._constants)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="jaxunshear",
        )
        helper.set_model_props(model, metadata)
        checker.check_model(model, full_check=True)
        return model

    def _constant(self, array: np.ndarray) -> str:
        name = f"constant_{len(self._constants)}"
        self._constants.append(
            numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        )
        return name
