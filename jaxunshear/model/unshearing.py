"""One function for all networks that unshear, told apart by their settings."""

from typing import Any

from jax import Array

from jaxunshear.model import unet, unshearnet
from jaxunshear.model.settings import UNet, UnshearNet


def unshear(net: UnshearNet | UNet, variables: Any, images: Array) -> Array:
    """Sheared images (B, S, S, 1) in [0, 1] -> canonical ones."""
    return unet.unshear(net, variables, images) if isinstance(net, UNet) else unshearnet.unshear(net, variables, images)
