"""Makes our networks of nodes of ONNX, from their settings and variables.

Inputs are images (B, 1, S, S) in [0, 1], or pins (B, P, 2) px. Batch normalisation of a trained
network is a scale and a shift, which go into the convolution before it.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from jaxunshear.apps.export.onnx_graph import FLOAT, OnnxGraph
from jaxunshear.config.networks import PinNet, PinPoseNet, PinUnshear, PoseNet, UnshearNet
from jaxunshear.config.targets import Targets
from jaxunshear.errors import UserError
from jaxunshear.models.layers import EPSILON
from jaxunshear.models.weights import Net, Variables

LAYER_NORM_EPSILON = 1e-6  # Flax' own
MIN_NORM = np.float32(1e-30)  # of a cosine that may be a denominator
QUARTER = {"strides": (2, 2), "pads": (1, 1, 1, 1)}  # 4x4 convolutions to half the side, or from it


def add_network(graph: OnnxGraph, net: Net, variables: Variables, inputs: str) -> str:
    """Add the nodes of a network: to canonical images or pins, or to outputs (B, K) of `posenet`.

    Raises UserError for a network without a form of ONNX.
    """
    if type(net) not in _FORMS:
        raise UserError(f"{type(net).__name__} has no form of ONNX: use a file of StableHLO")
    return _FORMS[type(net)](graph, net, variables, inputs)


def _add_unshearnet(graph: OnnxGraph, net: UnshearNet, variables: Variables, images: str) -> str:
    x, layers = images, _Layers(graph, variables)
    for name in ("First_0", *(f"Down_{i}" for i in range(len(net.widths) - 1))):
        x = layers.add_convolution(x, ("E", name), **QUARTER)
    if net.disentangled:
        x = layers.add_convolution(x, ("pose",), pads=(1, 1, 1, 1))
    for i in range(len(net.widths) - 1):
        x = layers.add_conv_transpose(x, ("DC", f"Up_{i}"))
    last = variables["params"]["DC"]["Last_0"]
    kernel, bias = _flip_kernel(last["kernel"]), _to_float32(last["bias"])
    return graph.add("Sigmoid", graph.add("ConvTranspose", x, kernel, bias, **QUARTER))


def _add_pin_unshear(graph: OnnxGraph, net: PinUnshear, variables: Variables, pins: str) -> str:
    params, motions = variables["params"], _add_motions(graph, variables, pins)
    if net.conv_channels:
        encoded = _add_grid_trunk(graph, net, variables, params["E"], motions)
    else:
        encoded = _add_trunk(graph, net, params["E"], motions)
    z_p = _add_dense(graph, params["pose"], encoded)
    return _add_positions(graph, variables, _add_pin_dense(graph, net, params["DC"], z_p))


def _add_posenet(graph: OnnxGraph, net: PoseNet, variables: Variables, images: str) -> str:
    params, layers = variables["params"], _Layers(graph, variables)
    x = layers.add_convolution(images, ("First_0",), **QUARTER)
    x = layers.add_convolution(x, ("Down_0",), **QUARTER)
    # Flax counts an outer call before the inner one
    for names in (("Same_1", "Same_0"), ("Same_2",)):
        x = graph.add("MaxPool", x, kernel_shape=(2, 2), strides=(2, 2))
        for name in names:
            x = layers.add_convolution(x, (name,), pads=(1, 1, 1, 1))
    side, kernel = net.size // 16, params["Dense_0"]["kernel"]
    by_place = kernel.reshape(side, side, -1, kernel.shape[-1])
    channels_first = by_place.transpose(2, 0, 1, 3).reshape(kernel.shape)
    dense = params["Dense_0"] | {"kernel": channels_first}
    hidden = _add_dense(graph, dense, graph.add("Flatten", x))
    return graph.add("Sigmoid", _add_dense(graph, params["Dense_1"], graph.add("Relu", hidden)))


def _add_pin_posenet(graph: OnnxGraph, net: PinPoseNet, variables: Variables, pins: str) -> str:
    params, motions = variables["params"], _add_motions(graph, variables, pins)
    if not net.conv_channels:
        return _add_pin_dense(graph, net, params, motions)
    trunk = _add_grid_trunk(graph, net, variables, params["GridTrunk_0"], motions)
    return _add_dense(graph, params["Dense_0"], trunk)


_FORMS: dict[type, Callable[[OnnxGraph, Net, Variables, str], str]] = {
    UnshearNet: _add_unshearnet,
    PinUnshear: _add_pin_unshear,
    PoseNet: _add_posenet,
    PinPoseNet: _add_pin_posenet,
}


def add_pose(graph: OnnxGraph, targets: Targets, outputs: str) -> str:
    """Add the nodes of `posenet.unscale_outputs`: from (B, K) in [0, 1] to a column per target."""
    signed = graph.add("Sub", graph.add("Mul", outputs, np.float32(2)), np.float32(1))
    columns, start = [], 0
    for target in targets:
        first = _add_column(graph, signed, start)
        if target.is_circular:
            columns.append(_add_degrees(graph, first, _add_column(graph, signed, start + 1)))
        elif target.classes:
            columns.append(_add_class(graph, signed, start, target.classes))
        else:
            scaled = graph.add("Mul", first, np.float32(target.half_range))
            columns.append(graph.add("Add", scaled, np.float32(target.centre)))
        start += target.outputs
    return graph.add("Concat", *columns, axis=1)


def _add_column(graph: OnnxGraph, x: str, number: int) -> str:
    return graph.add("Slice", x, np.array([number]), np.array([number + 1]), np.array([1]))


def _add_class(graph: OnnxGraph, x: str, start: int, count: int) -> str:
    """Add the nodes of the number (B, 1) of the largest of some columns."""
    ends = np.array([start]), np.array([start + count]), np.array([1])
    return graph.add("Cast", graph.add("ArgMax", graph.add("Slice", x, *ends), axis=1), to=FLOAT)


def _add_degrees(graph: OnnxGraph, cosine: str, sine: str) -> str:
    """Add the nodes of atan2, which ONNX lacks."""
    zero, half = np.float32(0), np.float32(np.pi)
    tiny = graph.add("Less", graph.add("Abs", cosine), MIN_NORM)
    angle = graph.add("Atan", graph.add("Div", sine, graph.add("Where", tiny, MIN_NORM, cosine)))
    signed_half = graph.add("Where", graph.add("Less", sine, zero), -half, half)
    offset = graph.add("Where", graph.add("Less", cosine, -MIN_NORM), signed_half, zero)
    return graph.add("Mul", graph.add("Add", angle, offset), np.float32(180 / np.pi))


class _Layers:
    """Adds convolutions with normalisation and ReLU, by their path in a network's variables."""

    def __init__(self, graph: OnnxGraph, variables: Variables) -> None:
        self._graph, self._variables = graph, variables

    def add_convolution(self, x: str, path: tuple[str, ...], **attributes: object) -> str:
        kernel, bias = self._fold_normalisation(path)
        y = self._graph.add("Conv", x, kernel.transpose(3, 2, 0, 1), bias, **attributes)
        return self._graph.add("Relu", y)

    def add_conv_transpose(self, x: str, path: tuple[str, ...]) -> str:
        kernel, bias = self._fold_normalisation(path)
        y = self._graph.add("ConvTranspose", x, _flip_kernel(kernel), bias, **QUARTER)
        return self._graph.add("Relu", y)

    def _fold_normalisation(self, path: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Compute kernel (h, w, in, out) and bias (out,) of a convolution and its normalisation."""
        params, stats = self._variables["params"], self._variables["batch_stats"]
        for name in path:
            params, stats = params[name], stats[name]
        norm, norm_stats = params["norm"], stats["norm"]
        scale = np.float64(norm["scale"]) / np.sqrt(np.float64(norm_stats["var"]) + EPSILON)
        return _to_float32(params["kernel"] * scale), _to_float32(
            norm["bias"] - norm_stats["mean"] * scale
        )


def _to_float32(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, np.float32)


def _flip_kernel(kernel: np.ndarray) -> np.ndarray:
    """Flip a kernel: Flax' transposed convolutions correlate, those of ONNX convolve."""
    return _to_float32(kernel)[::-1, ::-1].transpose(2, 3, 0, 1)


def _add_dense(graph: OnnxGraph, params: Variables, x: str) -> str:
    return graph.add("Gemm", x, _to_float32(params["kernel"]), _to_float32(params["bias"]))


def _add_trunk(graph: OnnxGraph, net: PinNet, params: Variables, x: str) -> str:
    for i in range(net.layers):
        x = _add_layer_norm(
            graph, params[f"LayerNorm_{i}"], _add_dense(graph, params[f"Dense_{i}"], x)
        )
    return x


def _add_grid_trunk(
    graph: OnnxGraph, net: PinNet, variables: Variables, params: Variables, motions: str
) -> str:
    """Add the nodes of `pin_layers.GridTrunk`, channels first except in normalisation."""
    grid = _to_float32(variables["batch_stats"]["grid"])
    side = math.isqrt(grid.shape[1])
    by_pin = graph.add("Reshape", motions, np.array([-1, len(grid), 2]))
    by_axis = graph.add("Transpose", by_pin, perm=(0, 2, 1))
    on_grid = graph.add(
        "Reshape", graph.add("MatMul", by_axis, grid), np.array([-1, 2, side, side])
    )
    inside = _to_float32(np.any(grid != 0, axis=0)).reshape(1, 1, side, side)
    first_axis = graph.add("Slice", on_grid, np.array([0]), np.array([1]), np.array([1]))
    zeros = graph.add("Mul", first_axis, np.float32(0))
    x = graph.add("Concat", on_grid, graph.add("Add", zeros, inside), axis=1)
    for i in range(len(net.conv_channels)):
        stride = 2 if i else 1
        side_after = -(-side // stride)
        padding = max((side_after - 1) * stride + 3 - side, 0)
        before = padding // 2
        pads = (before, before, padding - before, padding - before)
        side = side_after
        convolution = params[f"Conv_{i}"]
        kernel = _to_float32(convolution["kernel"]).transpose(3, 2, 0, 1)
        bias = _to_float32(convolution["bias"])
        x = graph.add("Conv", x, kernel, bias, strides=(stride, stride), pads=pads)
        channels_last = graph.add("Transpose", x, perm=(0, 2, 3, 1))
        normalised = _add_layer_norm(graph, params[f"LayerNorm_{i}"], channels_last)
        x = graph.add("Transpose", normalised, perm=(0, 3, 1, 2))
    flat = graph.add("Flatten", graph.add("Transpose", x, perm=(0, 2, 3, 1)))
    norm = params[f"LayerNorm_{len(net.conv_channels)}"]
    return _add_layer_norm(graph, norm, _add_dense(graph, params["Dense_0"], flat))


def _add_layer_norm(graph: OnnxGraph, norm: Variables, x: str) -> str:
    """Add normalisation over the last axis, and GELU by tanh, as Flax computes it."""
    scale, bias = _to_float32(norm["scale"]), _to_float32(norm["bias"])
    x = graph.add("LayerNormalization", x, scale, bias, axis=-1, epsilon=LAYER_NORM_EPSILON)
    cubed = graph.add("Mul", graph.add("Mul", graph.add("Mul", x, x), x), np.float32(0.044715))
    inner = graph.add("Mul", graph.add("Add", x, cubed), np.float32(np.sqrt(2 / np.pi)))
    weight = graph.add("Add", graph.add("Tanh", inner), np.float32(1))
    return graph.add("Mul", graph.add("Mul", x, np.float32(0.5)), weight)


def _add_pin_dense(graph: OnnxGraph, net: PinNet, params: Variables, x: str) -> str:
    """Add the nodes of `pin_layers.Dense`.

    A network with rotation augmentation also takes a rotation as cosine and sine. Here there is
    none, so (1, 0) goes into the bias.
    """
    trunk, last = params["Trunk_0"], params["Dense_0"]
    if net.rotated_share:
        first = trunk["Dense_0"]
        unrotated = {"kernel": first["kernel"][:-2], "bias": first["bias"] + first["kernel"][-2]}
        trunk = trunk | {"Dense_0": unrotated}
    return _add_dense(graph, last, _add_trunk(graph, net, trunk, x))


def _add_motions(graph: OnnxGraph, variables: Variables, pins: str) -> str:
    """Add the nodes to motions (B, 2 P) in units of `spread`, 0 for missing pins."""
    constants = variables["batch_stats"]
    moved = graph.add("Sub", pins, _to_float32(constants["rest"]))
    motion = graph.add("Div", moved, _to_float32(constants["spread"]))
    missing = graph.add("Or", graph.add("IsNaN", motion), graph.add("IsInf", motion))
    return graph.add("Flatten", graph.add("Where", missing, np.float32(0), motion))


def _add_positions(graph: OnnxGraph, variables: Variables, motions: str) -> str:
    """Add the nodes from motions to pins (B, P, 2) px."""
    constants = variables["batch_stats"]
    rest = _to_float32(constants["rest"])
    by_pin = graph.add("Reshape", motions, np.array([-1, *rest.shape]))
    motion = graph.add("Mul", by_pin, _to_float32(constants["spread"]))
    return graph.add("Add", motion, rest)
