"""One function for all networks that unshear, and one for all that read poses, distinguished by their settings."""

from jax import Array
from jaxtyping import Float

from jaxunshear.config.networks import PinPoseNet, PinUnshear, PoseNet, UNet, UnshearNet
from jaxunshear.models import pin_networks, posenet, unet, unshearnet
from jaxunshear.models.weights import Variables


def unshear(
    net: UnshearNet | UNet | PinUnshear, variables: Variables, inputs: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Sheared images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px -> canonical ones."""
    if isinstance(net, PinUnshear):
        return pin_networks.unshear(net, variables, inputs)
    return (
        unet.unshear(net, variables, inputs)
        if isinstance(net, UNet)
        else unshearnet.unshear(net, variables, inputs)
    )


def predict(
    net: PoseNet | PinPoseNet, variables: Variables, inputs: Float[Array, "B *S"]
) -> Float[Array, "B K"]:
    """Images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px -> outputs, see `posenet`."""
    return (pin_networks if isinstance(net, PinPoseNet) else posenet).predict(
        net, variables, inputs
    )


def encode(
    net: UnshearNet | PinUnshear, variables: Variables, inputs: Array
) -> tuple[Array, Array | None]:
    """Images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px -> (z_p, z_s); z_s None without a shear code, as in released weights."""
    return (pin_networks if isinstance(net, PinUnshear) else unshearnet).encode(
        net, variables, inputs
    )
