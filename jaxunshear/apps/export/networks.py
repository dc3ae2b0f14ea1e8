"""Our networks as nodes of ONNX, from their settings and variables: images (B, 1, S, S) in [0, 1], or pins (B, P, 2) px.

Batch normalisation of a trained network is a scale and a shift, which go into the convolution before it.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from jaxunshear.apps.export.onnx_graph import OnnxGraph
from jaxunshear.config.networks import PinPoseNet, PinUnshear, PoseNet, UnshearNet
from jaxunshear.config.targets import Targets
from jaxunshear.models.layers import EPSILON
from jaxunshear.models.weights import Variables

LAYER_NORM_EPSILON = 1e-6  # Flax' own
MIN_NORM = np.float32(1e-30)  # a cosine that may stand in a denominator
QUARTER = {"strides": (2, 2), "pads": (1, 1, 1, 1)}  # 4x4 convolutions to half the side, or from it


def unshear(
    graph: OnnxGraph, net: UnshearNet | PinUnshear, variables: Variables, inputs: str
) -> str:
    """Sheared images or pins -> canonical ones."""
    params = variables["params"]
    if isinstance(net, PinUnshear):
        motions = _motions(graph, variables, inputs)
        encoder = (
            _grid_trunk(graph, net, variables, params["E"], motions)
            if net.convolved
            else _trunk(graph, net, params["E"], motions)
        )
        z_p = _dense(graph, params["pose"], encoder)
        return _places(graph, variables, _trunk_dense(graph, net, params["DC"], z_p))
    x, layers = inputs, _Layers(graph, variables)
    for name in ("First_0", *(f"Down_{i}" for i in range(len(net.widths) - 1))):
        x = layers.convolution(x, ("E", name), **QUARTER)
    if net.disentangled:
        x = layers.convolution(x, ("pose",), pads=(1, 1, 1, 1))
    for i in range(len(net.widths) - 1):
        x = layers.add_conv_transpose(x, ("DC", f"Up_{i}"))
    last = params["DC"]["Last_0"]
    logits = graph.add(
        "ConvTranspose", x, _flip_kernel(last["kernel"]), _single(last["bias"]), **QUARTER
    )
    return graph.add("Sigmoid", logits)


def predict(graph: OnnxGraph, net: PoseNet | PinPoseNet, variables: Variables, inputs: str) -> str:
    """Images or pins -> outputs (B, K), see `posenet`."""
    params = variables["params"]
    if isinstance(net, PinPoseNet):
        motions = _motions(graph, variables, inputs)
        if not net.convolved:
            return _trunk_dense(graph, net, params, motions)
        trunk = _grid_trunk(graph, net, variables, params["GridTrunk_0"], motions)
        return _dense(graph, params["Dense_0"], trunk)
    layers = _Layers(graph, variables)
    x = layers.convolution(
        layers.convolution(inputs, ("First_0",), **QUARTER), ("Down_0",), **QUARTER
    )
    for names in (
        ("Same_1", "Same_0"),
        ("Same_2",),
    ):  # Flax counts an outer call before the inner one
        x = graph.add("MaxPool", x, kernel_shape=(2, 2), strides=(2, 2))
        for name in names:
            x = layers.convolution(x, (name,), pads=(1, 1, 1, 1))
    side, kernel = net.size // 16, params["Dense_0"]["kernel"]
    channels_first = (
        kernel.reshape(side, side, -1, kernel.shape[-1]).transpose(2, 0, 1, 3).reshape(kernel.shape)
    )
    hidden = _dense(graph, params["Dense_0"] | {"kernel": channels_first}, graph.add("Flatten", x))
    return graph.add("Sigmoid", _dense(graph, params["Dense_1"], graph.add("Relu", hidden)))


def pose(graph: OnnxGraph, targets: Targets, outputs: str) -> str:
    """Outputs (B, K) in [0, 1] -> mm and deg, a column a target: `posenet.unscale_outputs`."""
    signed = graph.add("Sub", graph.add("Mul", outputs, np.float32(2)), np.float32(1))
    columns, start = [], 0
    for target in targets:
        first = _column(graph, signed, start)
        if target.is_circular:
            columns.append(_degrees(graph, first, _column(graph, signed, start + 1)))
        else:
            scaled = graph.add("Mul", first, np.float32(target.half_range))
            columns.append(graph.add("Add", scaled, np.float32(target.centre)))
        start += target.outputs
    return graph.add("Concat", *columns, axis=1)


def _column(graph: OnnxGraph, x: str, number: int) -> str:
    return graph.add("Slice", x, np.array([number]), np.array([number + 1]), np.array([1]))


def _degrees(graph: OnnxGraph, cosine: str, sine: str) -> str:
    """atan2, which ONNX lacks."""
    zero, half = np.float32(0), np.float32(np.pi)
    tiny = graph.add("Less", graph.add("Abs", cosine), MIN_NORM)
    angle = graph.add("Atan", graph.add("Div", sine, graph.add("Where", tiny, MIN_NORM, cosine)))
    there = graph.add("Where", graph.add("Less", sine, zero), -half, half)
    turned = graph.add("Where", graph.add("Less", cosine, -MIN_NORM), there, zero)
    return graph.add("Mul", graph.add("Add", angle, turned), np.float32(180 / np.pi))


class _Layers:
    """Convolutions with their normalisation and ReLU, by their place in a network's variables."""

    def __init__(self, graph: OnnxGraph, variables: Variables) -> None:
        self._graph, self._variables = graph, variables

    def convolution(self, x: str, path: tuple[str, ...], **attributes: object) -> str:
        kernel, bias = self._fold_normalisation(path)
        return self._graph.add(
            "Relu", self._graph.add("Conv", x, kernel.transpose(3, 2, 0, 1), bias, **attributes)
        )

    def add_conv_transpose(self, x: str, path: tuple[str, ...]) -> str:
        kernel, bias = self._fold_normalisation(path)
        return self._graph.add(
            "Relu", self._graph.add("ConvTranspose", x, _flip_kernel(kernel), bias, **QUARTER)
        )

    def _fold_normalisation(self, path: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Kernel (h, w, in, out) and bias (out,) of a convolution and its normalisation together."""
        params, stats = self._variables["params"], self._variables["batch_stats"]
        for name in path:
            params, stats = params[name], stats[name]
        norm, known = params["norm"], stats["norm"]
        scale = np.float64(norm["scale"]) / np.sqrt(np.float64(known["var"]) + EPSILON)
        return _single(params["kernel"] * scale), _single(norm["bias"] - known["mean"] * scale)


def _single(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, np.float32)


def _flip_kernel(kernel: np.ndarray) -> np.ndarray:
    """Flax' transposed convolutions correlate where those of ONNX convolve."""
    return _single(kernel)[::-1, ::-1].transpose(2, 3, 0, 1)


def _dense(graph: OnnxGraph, params: Variables, x: str) -> str:
    return graph.add("Gemm", x, _single(params["kernel"]), _single(params["bias"]))


def _trunk(graph: OnnxGraph, net: PinUnshear | PinPoseNet, params: Variables, x: str) -> str:
    for i in range(net.layers):
        x = _add_layer_norm(graph, params[f"LayerNorm_{i}"], _dense(graph, params[f"Dense_{i}"], x))
    return x


def _grid_trunk(
    graph: OnnxGraph,
    net: PinUnshear | PinPoseNet,
    variables: Variables,
    params: Variables,
    motions: str,
) -> str:
    """`pin_grid.GridTrunk`, channels first but where they are normalised."""
    grid = _single(variables["batch_stats"]["grid"])
    side = math.isqrt(grid.shape[1])
    by_axis = graph.add(
        "Transpose", graph.add("Reshape", motions, np.array([-1, len(grid), 2])), perm=(0, 2, 1)
    )
    laid = graph.add("Reshape", graph.add("MatMul", by_axis, grid), np.array([-1, 2, side, side]))
    inside = _single(np.any(grid != 0, axis=0)).reshape(1, 1, side, side)
    alike = graph.add(
        "Mul", graph.add("Slice", laid, np.array([0]), np.array([1]), np.array([1])), np.float32(0)
    )
    x = graph.add("Concat", laid, graph.add("Add", alike, inside), axis=1)
    for i in range(len(net.convolved)):
        stride = 2 if i else 1
        after = -(-side // stride)
        short = max((after - 1) * stride + 3 - side, 0)
        pads, side = (short // 2, short // 2, short - short // 2, short - short // 2), after
        kernel, bias = (
            _single(params[f"Conv_{i}"]["kernel"]).transpose(3, 2, 0, 1),
            _single(params[f"Conv_{i}"]["bias"]),
        )
        x = graph.add("Conv", x, kernel, bias, strides=(stride, stride), pads=pads)
        last = graph.add("Transpose", x, perm=(0, 2, 3, 1))
        x = graph.add(
            "Transpose", _add_layer_norm(graph, params[f"LayerNorm_{i}"], last), perm=(0, 3, 1, 2)
        )
    flat = graph.add("Flatten", graph.add("Transpose", x, perm=(0, 2, 3, 1)))
    return _add_layer_norm(
        graph, params[f"LayerNorm_{len(net.convolved)}"], _dense(graph, params["Dense_0"], flat)
    )


def _add_layer_norm(graph: OnnxGraph, norm: Variables, x: str) -> str:
    """Over the last axis, and GELU."""
    scale, bias = _single(norm["scale"]), _single(norm["bias"])
    return _gelu(
        graph, graph.add("LayerNormalization", x, scale, bias, axis=-1, epsilon=LAYER_NORM_EPSILON)
    )


def _gelu(graph: OnnxGraph, x: str) -> str:
    """By tanh, as Flax computes it."""
    cubed = graph.add("Mul", graph.add("Mul", graph.add("Mul", x, x), x), np.float32(0.044715))
    inner = graph.add("Mul", graph.add("Add", x, cubed), np.float32(np.sqrt(2 / np.pi)))
    weight = graph.add("Add", graph.add("Tanh", inner), np.float32(1))
    return graph.add("Mul", graph.add("Mul", x, np.float32(0.5)), weight)


def _trunk_dense(graph: OnnxGraph, net: PinUnshear | PinPoseNet, params: Variables, x: str) -> str:
    """`pin_networks.Dense`. Where the network is also given a turn, as cosine and sine, there is none: (1, 0) goes into the bias."""
    trunk, last = params["Trunk_0"], params["Dense_0"]
    if isinstance(net, PinPoseNet) and net.turned:
        first = trunk["Dense_0"]
        unturned = {"kernel": first["kernel"][:-2], "bias": first["bias"] + first["kernel"][-2]}
        trunk = trunk | {"Dense_0": unturned}
    return _dense(graph, last, _trunk(graph, net, trunk, x))


def _motions(graph: OnnxGraph, variables: Variables, pins: str) -> str:
    """(B, 2 P) in units of `spread`; 0 for pins that are not seen."""
    constants = variables["batch_stats"]
    moved = graph.add("Sub", pins, _single(constants["rest"]))
    motion = graph.add("Div", moved, _single(constants["spread"]))
    unseen = graph.add("Or", graph.add("IsNaN", motion), graph.add("IsInf", motion))
    return graph.add("Flatten", graph.add("Where", unseen, np.float32(0), motion))


def _places(graph: OnnxGraph, variables: Variables, motions: str) -> str:
    constants = variables["batch_stats"]
    rest = _single(constants["rest"])
    moved = graph.add(
        "Mul",
        graph.add("Reshape", motions, np.array([-1, *rest.shape])),
        _single(constants["spread"]),
    )
    return graph.add("Add", moved, rest)
