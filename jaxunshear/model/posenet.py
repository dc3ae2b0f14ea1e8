"""PoseNet: a tap image -> pose (paper appendix A), behind pure functions.

>>> variables = init(net, jax.random.key(0))
>>> outputs = predict(net, variables, images)                     # (B, S, S, 1) in [0, 1] -> (B, 5) in [0, 1]
>>> pose_from_outputs(outputs, ranges)["edge_mm"]                 # (B,)

The paper predicts x and yaw; distance to the edge and the edge's direction are added because they stay unambiguous
where the edge is smooth. All five are scaled to [0, 1] for the sigmoid output.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxunshear.dataset.settings import Ranges
from jaxunshear.model import conv, settings
from jaxunshear.model.layers import INIT, Down, First, Same

OUTPUTS = ("x", "yaw", "edge", "cos", "sin")
WEIGHTS = (
    1.0,
    1.0,
    4.0,
    1.0,
    1.0,
)  # in the loss: edge distance has the widest scale, and would drown in the ambiguous yaw

Variables = dict[str, Any]


class Network(nn.Module):
    """Five convolutions, the first two of stride 2, max pooling after the 2nd and 4th, two dense layers."""

    net: settings.PoseNet

    @nn.compact
    def __call__(self, images: Array, train: bool) -> Array:
        first, second, *rest = self.net.widths
        x = Down(second, "plain")(First(first)(images, train), train)
        x = _halve(x)
        x = Same(rest[1])(Same(rest[0])(x, train), train)
        x = _halve(x)
        x = Same(rest[2])(x, train)
        x = nn.relu(nn.Dense(self.net.hidden, kernel_init=INIT)(x.reshape(x.shape[0], -1)))
        return nn.sigmoid(nn.Dense(len(OUTPUTS), kernel_init=INIT)(x))


def _halve(x: Array) -> Array:
    """2x2 max pooling (whose windowed form has a slow gradient in XLA's CPU backend)."""
    b, h, w, c = x.shape
    return conv.to_blocks(x, 2).reshape(b, h // 2, w // 2, 4, c).max(3)


def init(net: settings.PoseNet, key: Array) -> Variables:
    """Fresh variables. Raises ValueError where `size` and `widths` do not fit the network."""
    check(net)
    return dict(Network(net).init(key, jnp.zeros((1, net.size, net.size, 1)), True))


def check(net: settings.PoseNet) -> None:
    """Raises ValueError that names the field where a network of these settings cannot be built."""
    if len(net.widths) != 5:
        raise ValueError(f"widths: PoseNet has five convolutions, got {len(net.widths)} widths")
    if net.size % 16:
        raise ValueError(f"size: {net.size} px is no multiple of 16")


def predict(net: settings.PoseNet, variables: Variables, images: Array) -> Array:
    """Images (B, S, S, 1) in [0, 1] -> outputs (B, 5) in [0, 1]; each image on its own."""
    outputs: Array = Network(net).apply(variables, images, False)  # type: ignore[assignment]
    return outputs


def predict_training(net: settings.PoseNet, variables: Variables, images: Array) -> tuple[Array, Variables]:
    """The same with the batch's statistics, and the updated running ones."""
    outputs, updates = Network(net).apply(variables, images, True, mutable=["batch_stats"])
    return outputs, updates["batch_stats"]


def pose_targets(pose: Array, edge: Array, ranges: Ranges) -> Array:
    """pose (B, 4) [x mm, y mm, yaw deg, depth mm], edge (B, 2) [distance mm, direction deg] -> targets (B, 5) in [0,
    1]."""
    x, yaw, distance = _scales(ranges)
    angle = jnp.deg2rad(edge[:, 1])
    signed = (pose[:, 0] / x, pose[:, 2] / yaw, edge[:, 0] / distance, jnp.cos(angle), jnp.sin(angle))
    return (jnp.stack(signed, -1) + 1) / 2


def pose_from_outputs(outputs: Array, ranges: Ranges) -> dict[str, Array]:
    """Outputs (B, 5) -> x_mm, yaw_deg, edge_mm, edge_deg in (-180, 180], each (B,)."""
    x, yaw, distance = _scales(ranges)
    signed = 2 * outputs - 1
    return {
        "x_mm": x * signed[:, 0],
        "yaw_deg": yaw * signed[:, 1],
        "edge_mm": distance * signed[:, 2],
        "edge_deg": jnp.rad2deg(jnp.arctan2(signed[:, 4], signed[:, 3])),
    }


def mean_pose(one: dict[str, Array], other: dict[str, Array]) -> dict[str, Array]:
    """The mean of two answers in the form of `pose_from_outputs`; of the edge's direction that of the unit vectors."""
    mean = {name: (one[name] + other[name]) / 2 for name in one}
    a, b = jnp.deg2rad(one["edge_deg"]), jnp.deg2rad(other["edge_deg"])
    return mean | {"edge_deg": jnp.rad2deg(jnp.arctan2(jnp.sin(a) + jnp.sin(b), jnp.cos(a) + jnp.cos(b)))}


def _scales(ranges: Ranges) -> tuple[float, float, float]:
    """Largest |x| mm, |yaw| deg and |edge distance| mm: the target point lies on the edge, so the distance to it is a
    bound. A range of zero still needs a scale."""
    lateral = ranges.lateral_mm or 1.0
    return lateral, ranges.yaw_deg or 1.0, 2**0.5 * lateral
