"""Run any network that unshears, or any PoseNet, chosen by the type of its settings."""

from jax import Array
from jaxtyping import Float

from jaxunshear.config.networks import PinPoseNet, PinUnshear, PoseNet, UNet, UnshearNet
from jaxunshear.models import pin_networks, posenet, unet, unshearnet
from jaxunshear.models.weights import Variables


def unshear(
    net: UnshearNet | UNet | PinUnshear, variables: Variables, inputs: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Unshear images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px."""
    if isinstance(net, PinUnshear):
        return pin_networks.unshear(net, variables, inputs)
    if isinstance(net, UNet):
        return unet.unshear(net, variables, inputs)
    return unshearnet.unshear(net, variables, inputs)


def predict(
    net: PoseNet | PinPoseNet, variables: Variables, inputs: Float[Array, "B *S"]
) -> Float[Array, "B K"]:
    """Predict outputs, see `posenet`, of images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px."""
    if isinstance(net, PinPoseNet):
        return pin_networks.predict(net, variables, inputs)
    return posenet.predict(net, variables, inputs)


def encode(
    net: UnshearNet | PinUnshear, variables: Variables, inputs: Array
) -> tuple[Array, Array | None]:
    """Encode images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px, as (z_p, z_s).

    z_s is None without a shear code, as in released weights.
    """
    if isinstance(net, PinUnshear):
        return pin_networks.encode(net, variables, inputs)
    return unshearnet.encode(net, variables, inputs)
