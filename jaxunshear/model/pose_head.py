"""A head that reads the pose off the pose code, in training alone: what it is taught of poses, the encoder learns.

>>> params = init((4, 4, 256), 5, jax.random.key(0))
>>> outputs = predict(params, z_p)                                # (B, 4, 4, 256) -> (B, 5) in [0, 1]
>>> pose_from_outputs(outputs, targets)["edge_mm"]                 # (B,); outputs are those of PoseNet

Ours, not the paper's. It sees the entire code, as PoseNet's two dense layers see their features.
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxunshear.model.layers import INIT
from jaxunshear.model.parts import Variables

HIDDEN = 128  # as many as PoseNet has


class Network(nn.Module):
    """Two dense layers over the entire code, sigmoid outputs. The first is normalised over its units: codes are never negative, and
    without it steps that lower all units at once, as Muon's are, leave most of them at zero for good."""

    outputs: int

    @nn.compact
    def __call__(self, z_p: Array) -> Array:
        x = nn.Dense(HIDDEN, kernel_init=INIT)(z_p.reshape(z_p.shape[0], -1))
        x = nn.relu(nn.LayerNorm(name="norm")(x))
        return nn.sigmoid(nn.Dense(self.outputs, kernel_init=INIT)(x))


def init(code: tuple[int, ...], outputs: int, key: Array) -> Variables:
    """Fresh parameters for codes of shape `code`, (s, s, channels), and as many `outputs` as the targets have."""
    return Network(outputs).init(key, jnp.zeros((1, *code)))["params"]


def of(variables: Variables) -> Variables | None:
    """The head's parameters among those of the network that it was trained with; None where there is none, or one of an earlier form,
    which was not normalised."""
    head = variables["params"].get("head", {})
    return head if "norm" in head else None


def predict(params: Variables, z_p: Float[Array, "B s s channels"]) -> Float[Array, "B K"]:
    """Pose codes -> outputs in [0, 1], in float32 or wider."""
    known = len(params["Dense_1"]["bias"])
    outputs: Array = Network(known).apply({"params": params}, z_p.astype(np.promote_types(z_p.dtype, np.float32)))  # type: ignore[assignment]
    return outputs
