"""The sensor check of an exported file, which has no search for pins: as nodes, or in JAX.

An image is blurred to the size of a pin; its peaks are the dots. Their number, their middle, how
far they spread, and how many stand evenly, are compared with the pins at rest by the weights of
`perception.sensor_check`. Of pins that are given by identity the same is measured, where those
stand evenly that move as their neighbours do.

It is written once, as nodes of ONNX. `JaxGraph` computes each node at once.

>>> check = make_sensor_check(rest, 128)
>>> add_image_plausibility(JaxGraph(), check, images)   # (B, 1, S, S) of 0 and 1 -> (B,)
"""

from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.spatial import cKDTree

from jaxunshear.perception.lattice import measure_spacing
from jaxunshear.perception.pin_track import MAX_NEIGHBOUR_OFFSET, MIN_KNOWN_NEIGHBOURS
from jaxunshear.perception.sensor_check import (
    ALLOWED_DIFFERENCE,
    LOGISTIC_BIAS,
    LOGISTIC_WEIGHTS,
)

# Lengths are in units of the spacing.
BLUR = 0.22  # standard deviation
PEAK_RADIUS = 0.45  # within which a dot has one peak
EVEN_RANGE = (0.55, 1.3)  # halves of squares: no neighbour stands in the smaller one
NEIGHBOURS_RANGE = (3, 10)  # of an even pin, in the larger one
REACH = 1.0  # of dots beyond the outermost pin at rest
MAX_OWN_MOTION = 2.0  # of a pin beyond the mean motion: pins that are mirrored move further
MIN_PEAK = 0.25  # share of white under the blur
MAX_WHITE = 0.5  # share of white among the pins; there is more in an image with dark pins
LEVELS, TIES = 15, 64  # of the blur and of what breaks ties: sums of integers are exact everywhere
NEAREST = 6
FAR_PX = 1e5  # no pin stands there
TINY = np.float32(1e-6)
FLOAT = 1  # of the types of ONNX
Value = Any  # the output of a node: its name, or an array of JAX


class Graph(Protocol):
    """What nodes are added to."""

    def add(self, op: str, *inputs: Value, **attributes: Value) -> Value:
        """Add a node of ONNX and return its output."""


class SensorCheck(NamedTuple):
    """The pins at rest that images, or pins, are compared with."""

    rest: np.ndarray  # (P, 2) px
    spacing: float  # px
    size: int  # S, px
    even_share: float  # of the pins at rest, by the measure of images


class JaxGraph:
    """Computes nodes at once instead of adding them."""

    def add(self, op: str, *inputs: Value, **attributes: Value) -> Value:
        """Compute a node."""
        return _JAX_OPS[op](*inputs, **attributes)


def _pool(x: Value, kernel_shape: tuple[int, int], pads: tuple[int, ...]) -> Value:
    pad = (pads[0], pads[0])
    window = (1, 1, *kernel_shape)
    return lax.reduce_window(x, -np.inf, lax.max, window, (1,) * 4, ((0, 0), (0, 0), pad, pad))


_JAX_OPS: dict[str, Value] = {
    "Add": jnp.add,
    "Sub": jnp.subtract,
    "Mul": jnp.multiply,
    "Div": jnp.divide,
    "Max": jnp.maximum,
    "Abs": jnp.abs,
    "Sqrt": jnp.sqrt,
    "Log": jnp.log,
    "Equal": jnp.equal,
    "And": jnp.logical_and,
    "Where": jnp.where,
    "Sigmoid": jax.nn.sigmoid,
    "GreaterOrEqual": jnp.greater_equal,
    "LessOrEqual": jnp.less_equal,
    "Cast": lambda x, to: x.astype(jnp.float32),
    "MatMul": partial(jnp.matmul, precision="highest"),
    "MaxPool": _pool,
    "Gather": lambda x, rows, axis: jnp.take(x, rows, axis),
    "ReduceSum": lambda x, axes, keepdims: jnp.sum(
        x, tuple(axes.tolist()), keepdims=bool(keepdims)
    ),
    "ReduceMax": lambda x, axes, keepdims: jnp.max(x, tuple(axes), keepdims=bool(keepdims)),
}


def make_sensor_check(rest: np.ndarray, size: int) -> SensorCheck:
    """Make the check of images of `size` px, or pins in them, that rest at (P, 2) px."""
    check = SensorCheck(np.asarray(rest, np.float32), measure_spacing(rest), size, 1.0)
    peaks = np.zeros((1, 1, size, size), np.float32)
    column, row = np.clip(np.round(rest).astype(int), 0, size - 1).T
    peaks[0, 0, row, column] = 1
    even = _add_even_peaks(JaxGraph(), check, peaks)
    return check._replace(even_share=float(np.sum(even) / np.sum(peaks)))


def add_image_plausibility(graph: Graph, check: SensorCheck, images: Value) -> Value:
    """Add the nodes from images (B, 1, S, S) of 0 and 1 to their plausibility (B,).

    It is 0 for images with other numbers, and for those with dark pins in white.
    """
    peaks = _add_peaks(graph, check, images)
    even = _add_even_peaks(graph, check, peaks)
    middle = check.rest.mean(axis=0)
    across = np.arange(check.size, dtype=np.float32)
    columns = np.broadcast_to((across - middle[0])[None], (check.size, check.size))
    rows = np.broadcast_to((across - middle[1])[:, None], (check.size, check.size))

    def total(values: Value) -> Value:
        return graph.add("ReduceSum", values, np.array([1, 2, 3]), keepdims=0)

    def total_at(places: np.ndarray) -> Value:
        return total(graph.add("Mul", peaks, np.ascontiguousarray(places)))

    moments = _Moments(total_at(columns), total_at(rows), total_at(columns**2 + rows**2))
    plausibility = _add_plausibility(graph, check, total(peaks), total(even), moments)
    grey = graph.add("Mul", images, graph.add("Sub", np.float32(1), images))
    most = graph.add("ReduceMax", grey, axes=[1, 2, 3], keepdims=0)
    is_binary = graph.add("LessOrEqual", most, np.float32(1e-3))
    inside = _find_inside(check)
    white = total(graph.add("Mul", images, np.float32(inside)))
    is_dark = graph.add("LessOrEqual", white, np.float32(MAX_WHITE * inside.sum()))
    return graph.add("Where", graph.add("And", is_binary, is_dark), plausibility, np.float32(0))


def add_pin_plausibility(graph: Graph, check: SensorCheck, pins: Value) -> Value:
    """Add the nodes from pins (B, P, 2) px, NaN for missing ones, to their plausibility (B,)."""
    outside = graph.add("LessOrEqual", graph.add("Abs", pins), np.float32(FAR_PX))
    missing = graph.add("Sub", np.float32(1), graph.add("Cast", outside, to=FLOAT))
    missing = graph.add("ReduceMax", missing, axes=[2], keepdims=1)
    known = graph.add("Sub", np.float32(1), missing)  # (B, P, 1) of 0 and 1
    is_known = graph.add("GreaterOrEqual", known, np.float32(0.5))
    motion = graph.add("Where", is_known, graph.add("Sub", pins, check.rest), np.float32(0))

    def total(values: Value, axis: int, keepdims: int = 0) -> Value:
        return graph.add("ReduceSum", values, np.array([axis]), keepdims=keepdims)

    def square(values: Value) -> Value:
        return total(graph.add("Mul", values, values), 2, 1)

    def divide(values: Value, count: Value) -> Value:
        return graph.add("Div", values, graph.add("Max", count, np.float32(1)))

    rows = cKDTree(check.rest).query(check.rest, k=NEAREST + 1)[1][:, 1:]
    support = total(graph.add("Gather", known, rows, axis=1), 2)
    beside = divide(total(graph.add("Gather", motion, rows, axis=1), 2), support)
    mean = divide(total(motion, 1, 1), total(known, 1, 1))
    limits = (
        ("LessOrEqual", square(graph.add("Sub", motion, beside)), MAX_NEIGHBOUR_OFFSET),
        ("LessOrEqual", square(graph.add("Sub", motion, mean)), MAX_OWN_MOTION),
    )
    is_even = graph.add("GreaterOrEqual", support, np.float32(MIN_KNOWN_NEIGHBOURS))
    for op, squared, limit in limits:
        near = graph.add(op, squared, np.float32((limit * check.spacing) ** 2))
        is_even = graph.add("And", is_even, near)
    even = graph.add("Mul", known, graph.add("Cast", is_even, to=FLOAT))
    centred = check.rest - check.rest.mean(axis=0)
    place = graph.add("Mul", known, graph.add("Add", motion, centred))

    def total_axis(axis: int) -> Value:
        return total(graph.add("Gather", place, np.array([axis]), axis=2), 1)

    column, row = total_axis(0), total_axis(1)

    def flatten(values: Value) -> Value:  # (B, 1) -> (B,)
        return total(values, 1)

    moments = _Moments(flatten(column), flatten(row), flatten(total(square(place), 1)))
    count = flatten(total(known, 1))
    even_count = flatten(total(even, 1))
    check = check._replace(even_share=1.0)
    return _add_plausibility(graph, check, count, even_count, moments)


class _Moments(NamedTuple):
    """Sums over dots, (B,) each, of places px from the middle of the pins at rest."""

    column: Value
    row: Value
    square: Value


def _add_plausibility(
    graph: Graph, check: SensorCheck, count: Value, even: Value, moments: _Moments
) -> Value:
    some = graph.add("Max", count, np.float32(1))
    column = graph.add("Div", moments.column, some)
    row = graph.add("Div", moments.row, some)
    square = graph.add("Div", moments.square, some)
    shift = graph.add("Add", graph.add("Mul", column, column), graph.add("Mul", row, row))
    spread = graph.add("Max", graph.add("Sub", square, shift), TINY)
    centred = check.rest - check.rest.mean(axis=0)
    expected = np.float32(np.square(centred).sum(axis=1).mean())
    lacking = graph.add("Sub", np.float32(check.even_share), graph.add("Div", even, some))
    # of the squared spread, whose logarithm is twice the rim's
    rim = graph.add("Log", graph.add("Div", spread, expected))
    differences = {
        "pins": graph.add("Log", graph.add("Div", some, np.float32(len(check.rest)))),
        "rim": graph.add("Mul", rim, np.float32(0.5)),
        "middle": graph.add("Div", graph.add("Sqrt", shift), np.float32(check.size)),
        "regular": graph.add("Max", lacking, np.float32(0)),
    }
    logit: Value = np.float32(LOGISTIC_BIAS)
    for name, difference in differences.items():
        factor = np.float32(LOGISTIC_WEIGHTS[name] / ALLOWED_DIFFERENCE[name] ** 2)
        cost = graph.add("Mul", graph.add("Mul", difference, difference), factor)
        logit = graph.add("Sub", logit, cost)
    return graph.add("Sigmoid", logit)


def _add_peaks(graph: Graph, check: SensorCheck, images: Value) -> Value:
    """Add the nodes from images to maps (B, 1, S, S) that are 1 at the peak of each dot, else 0."""
    across = _measure_distances(check.size) / (BLUR * check.spacing)
    blur = np.round(LEVELS * np.exp(-(across**2) / 2))
    blurred = _add_both_sides(graph, np.sqrt(TIES) * blur, images)
    rows, columns = np.mgrid[: check.size, : check.size]
    untied = graph.add("Add", blurred, np.float32((3 * rows + 5 * columns) % TIES))
    radius = max(1, int(PEAK_RADIUS * check.spacing))
    highest = graph.add("MaxPool", untied, kernel_shape=(2 * radius + 1,) * 2, pads=(radius,) * 4)
    is_peak = graph.add("And", graph.add("Equal", untied, highest), _find_inside(check))
    least = MIN_PEAK * TIES * blur.sum(axis=1).max() ** 2
    is_white = graph.add("GreaterOrEqual", untied, np.float32(least))
    return graph.add("Cast", graph.add("And", is_peak, is_white), to=FLOAT)


def _find_inside(check: SensorCheck) -> np.ndarray:
    """Find the pixels (S, S) where the pins may be."""
    rows, columns = np.mgrid[: check.size, : check.size]
    middle = check.rest.mean(axis=0)
    reach = np.hypot(*(check.rest - middle).T).max() + REACH * check.spacing
    return np.asarray(np.hypot(columns - middle[0], rows - middle[1]) <= reach)


def _add_even_peaks(graph: Graph, check: SensorCheck, peaks: Value) -> Value:

    def count_within(limit: float) -> Value:
        is_near = _measure_distances(check.size) <= limit * check.spacing
        return _add_both_sides(graph, is_near, peaks)

    near, around = count_within(EVEN_RANGE[0]), count_within(EVEN_RANGE[1])
    low, high = NEIGHBOURS_RANGE
    is_even = graph.add("LessOrEqual", near, np.float32(1))  # itself
    for op, limit in (("GreaterOrEqual", 1 + low), ("LessOrEqual", 1 + high)):
        is_even = graph.add("And", is_even, graph.add(op, around, np.float32(limit)))
    return graph.add("Mul", peaks, graph.add("Cast", is_even, to=FLOAT))


def _measure_distances(size: int) -> np.ndarray:
    """Measure the distances px (S, S) between the rows of an image, or its columns."""
    return np.abs(np.subtract.outer(np.arange(size), np.arange(size)))


def _add_both_sides(graph: Graph, matrix: np.ndarray, images: Value) -> Value:
    """Add the nodes of a symmetric matrix on rows and columns: a sum over a window of each pixel.

    A convolution takes longer here.
    """
    matrix = np.asarray(matrix, np.float32)
    return graph.add("MatMul", matrix, graph.add("MatMul", images, matrix))
