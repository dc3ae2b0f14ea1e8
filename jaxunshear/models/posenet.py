"""PoseNet: a tap image -> pose (paper appendix A), behind pure functions.

>>> variables = init(net, count_outputs(targets), jax.random.key(0))
>>> outputs = predict(net, variables, images)     # (B, S, S, 1) in [0, 1] -> (B, K) in [0, 1]
>>> unscale_outputs(outputs, targets)["edge_mm"]  # (B,)

The network predicts `targets` (config/targets.py), each scaled to [0, 1] for the sigmoid output.
The paper predicts x and yaw. For simulated shapes the distance to the edge and the edge's direction
are added, as these stay unambiguous where the edge is smooth.
"""

from collections.abc import Mapping

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxunshear.config import networks
from jaxunshear.config.targets import Target, Targets
from jaxunshear.config.types import raise_first_problem
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import networks as fast
from jaxunshear.models.layers import INIT, Down, Same
from jaxunshear.models.weights import Images, Outputs, PerExample, Variables


class Network(nn.Module):
    """Five convolutions and two dense layers.

    The first two convolutions have stride 2; max pooling follows the second and the fourth.
    """

    net: networks.PoseNet
    outputs: int

    @nn.compact
    def __call__(self, images: Array, train: bool) -> Array:
        first, second, *rest = self.net.widths
        x = Down(second)(Down(first, name="First_0")(images, train), train)
        x = nn.max_pool(x, (2, 2), (2, 2))
        x = Same(rest[1])(Same(rest[0])(x, train), train)
        x = nn.max_pool(x, (2, 2), (2, 2))
        x = Same(rest[2])(x, train)
        x = nn.relu(nn.Dense(self.net.hidden, kernel_init=INIT)(x.reshape(x.shape[0], -1)))
        return nn.sigmoid(nn.Dense(self.outputs, kernel_init=INIT)(x))


def _make_network(net: networks.PoseNet, outputs: int) -> nn.Module:
    return layer_choice.pick_layer(Network, fast.PoseNet)(net, outputs)


def init(net: networks.PoseNet, outputs: int, key: Array) -> Variables:
    """Make fresh variables of a network with as many `outputs` as the targets have together.

    Raises UserError if `size` and `widths` do not fit the network.
    """
    raise_first_problem(net, "PoseNet")
    images = jnp.zeros((1, net.size, net.size, 1))
    with layer_choice.use_layers(layer_choice.FAST):  # for the same weights with any layers
        return dict(_make_network(net, outputs).init(key, images, True))


def predict(net: networks.PoseNet, variables: Variables, images: Images) -> Outputs:
    """Predict outputs in [0, 1] of images in [0, 1], each image independently."""
    network = _make_network_for(net, variables)
    outputs: Array = network.apply(variables, images, False)  # type: ignore[assignment]
    return outputs


def predict_training(
    net: networks.PoseNet, variables: Variables, images: Images, radians: ArrayLike = 0.0
) -> tuple[Outputs, Variables]:
    """Predict outputs with the statistics of the batch, and return the updated running ones.

    Images are not turned, and `radians` is for networks over pins.
    """
    network = _make_network_for(net, variables)
    outputs, updates = network.apply(variables, images, True, mutable=["batch_stats"])
    return outputs, updates["batch_stats"]


def _make_network_for(net: networks.PoseNet, variables: Variables) -> nn.Module:
    return _make_network(net, len(variables["params"]["Dense_1"]["bias"]))


def list_output_weights(targets: Targets) -> tuple[float, ...]:
    """List the weight of each of the K outputs in the loss."""
    return tuple(target.weight for target in targets for _ in range(target.outputs))


def scale_poses(batch: Mapping[str, ArrayLike], targets: Targets) -> Outputs:
    """Scale the labels (B, _) of a batch, mm and deg by field, to outputs in [0, 1]."""
    signed: list[Array] = []
    for target in targets:
        value = jnp.asarray(batch[target.field])[:, target.column]
        if target.is_circular:
            angle = jnp.deg2rad(value)
            signed += [jnp.cos(angle), jnp.sin(angle)]
        elif target.classes:
            one_hot = jnp.where(jnp.isnan(value[:, None]), jnp.nan, _encode_class(value, target))
            signed += list(2 * one_hot.T - 1)
        else:
            signed.append((value - target.centre) / target.half_range)
    return (jnp.stack(signed, -1) + 1) / 2


def sample_outputs(targets: Targets, count: int, key: Array) -> Float[Array, "{count} K"]:
    """Sample outputs in [0, 1] of poses that are uniform over the targets' ranges and circles."""
    signed: list[Array] = []
    for target, target_key in zip(targets, jax.random.split(key, len(targets)), strict=True):
        value = jax.random.uniform(target_key, (count,), minval=-1.0)
        if target.is_circular:
            signed += [jnp.cos(jnp.pi * value), jnp.sin(jnp.pi * value)]
        elif target.classes:
            classes = jnp.floor((value + 1) / 2 * target.classes)
            signed += list(2 * _encode_class(classes, target).T - 1)
        else:
            signed.append(value)
    return (jnp.stack(signed, -1) + 1) / 2


def _encode_class(value: Float[Array, "B"], target: Target) -> Float[Array, "B K"]:
    return (value[:, None] == jnp.arange(target.classes)).astype(jnp.float32)


def unscale_outputs(outputs: Outputs, targets: Targets) -> dict[str, PerExample]:
    """Turn outputs into mm and deg by target, and classes into their numbers.

    Angles of a full circle are in (-180, 180].
    """
    signed = 2 * outputs - 1
    pose, column = {}, 0
    for target in targets:
        if target.is_circular:
            pose[target.name] = jnp.rad2deg(jnp.arctan2(signed[:, column + 1], signed[:, column]))
        elif target.classes:
            likeness = signed[:, column : column + target.classes]
            pose[target.name] = jnp.argmax(likeness, axis=-1).astype(signed.dtype)
        else:
            pose[target.name] = target.centre + target.half_range * signed[:, column]
        column += target.outputs
    return pose
