"""One function for all networks that unshear, and one for all that read poses, distinguished by their settings."""

from jax import Array
from jaxtyping import Float

from jaxunshear.model import pinnets, posenet, unet, unshearnet
from jaxunshear.model.parts import Variables
from jaxunshear.settings.networks import PinPoseNet, PinUnshear, PoseNet, UNet, UnshearNet


def unshear(
    net: UnshearNet | UNet | PinUnshear, variables: Variables, seen: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Sheared images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px -> canonical ones."""
    if isinstance(net, PinUnshear):
        return pinnets.unshear(net, variables, seen)
    return (
        unet.unshear(net, variables, seen)
        if isinstance(net, UNet)
        else unshearnet.unshear(net, variables, seen)
    )


def predict(
    net: PoseNet | PinPoseNet, variables: Variables, seen: Float[Array, "B *S"]
) -> Float[Array, "B K"]:
    """Images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px -> outputs, see `posenet`."""
    return (pinnets if isinstance(net, PinPoseNet) else posenet).predict(net, variables, seen)


def encode(
    net: UnshearNet | PinUnshear, variables: Variables, seen: Array
) -> tuple[Array, Array | None]:
    """Images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px -> (z_p, z_s); z_s None without a shear code, as in released weights."""
    return (pinnets if isinstance(net, PinUnshear) else unshearnet).encode(net, variables, seen)
