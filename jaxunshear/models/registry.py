"""The networks, by the class of their settings: one entry each, and functions that run any of them.

>>> canonical = unshear(net, variables, sheared)  # images in [0, 1], or pins px
>>> outputs = predict(pose_net, pose_variables, canonical)  # (B, K), see `posenet`
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxunshear.config.networks import (
    PinPoseNet,
    PinRenderer,
    PinUnshear,
    PoseNet,
    UNet,
    UnshearNet,
)
from jaxunshear.models import pin_networks, posenet, unet, unshearnet
from jaxunshear.models.modality import IMAGES, PINS, Modality
from jaxunshear.models.weights import Net, Variables


class DataFacts(NamedTuple):
    """What the variables of a network depend on besides its settings."""

    outputs: int = 0  # of all pose targets together, K
    rest: ArrayLike = np.zeros((0, 2), np.float32)  # (P, 2) px: the untouched pins
    spread: Any = 1.0  # how far pins move, root mean square in px


@dataclass(frozen=True)
class NetworkFunctions:
    """How the networks with settings of one class are built and run.

    A network that unshears has `unshear`; one with codes also `encode` and the decoders. One that
    reads poses has `predict`.
    """

    kind: str  # its name in model.json
    settings: type  # a frozen dataclass
    modality: Modality
    init: Callable[[Net, DataFacts, Array], Variables]
    check: Callable[[Net], None] = lambda net: None  # raises UserError, which names the field
    unshear: Callable[[Net, Variables, Array], Array] | None = None
    # inputs (B, ...) -> (z_p, z_s)
    encode: Callable[[Net, Variables, Array], tuple[Array, Array | None]] | None = None
    decode_canonical: Callable[[Net, Variables, Array], Array] | None = None
    decode_sheared: Callable[[Net, Variables, Array, Array], Array] | None = None
    predict: Callable[[Net, Variables, Array], Array] | None = None
    has_shear_code: Callable[[Net], bool] = lambda net: False


def _init_pin_network(net: Net, facts: DataFacts, key: Array) -> Variables:
    return pin_networks.init(net, facts.rest, facts.spread, key, facts.outputs)


_FUNCTIONS: dict[type, NetworkFunctions] = {
    functions.settings: functions
    for functions in (
        NetworkFunctions(
            "unshear",
            UnshearNet,
            IMAGES,
            lambda net, facts, key: unshearnet.init(net, key),
            unshearnet.check_net,
            unshearnet.unshear,
            unshearnet.encode,
            unshearnet.decode_canonical,
            unshearnet.decode_sheared,
            has_shear_code=lambda net: net.disentangled and net.shear_channels > 0,
        ),
        NetworkFunctions(
            "unet",
            UNet,
            IMAGES,
            lambda net, facts, key: unet.init(net, key),
            unet.check_net,
            unet.unshear,
        ),
        NetworkFunctions(
            "posenet",
            PoseNet,
            IMAGES,
            lambda net, facts, key: posenet.init(net, facts.outputs, key),
            posenet.check_net,
            predict=posenet.predict,
        ),
        NetworkFunctions(
            "pin_unshear",
            PinUnshear,
            PINS,
            _init_pin_network,
            unshear=pin_networks.unshear,
            encode=pin_networks.encode,
            decode_canonical=pin_networks.decode_canonical,
            decode_sheared=pin_networks.decode_sheared,
            has_shear_code=lambda net: net.shear_code > 0,
        ),
        NetworkFunctions(
            "pin_posenet", PinPoseNet, PINS, _init_pin_network, predict=pin_networks.predict
        ),
        NetworkFunctions("renderer", PinRenderer, PINS, _init_pin_network),
    )
}


def get_functions(net: Net) -> NetworkFunctions:
    """Return the functions of a network by its settings."""
    return _FUNCTIONS[type(net)]


def get_net_modality(net: Net) -> Modality:
    """Return the modality of a network."""
    return get_functions(net).modality


def unshear(net: Net, variables: Variables, inputs: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """Unshear images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px."""
    return _require(get_functions(net).unshear)(net, variables, inputs)


def predict(net: Net, variables: Variables, inputs: Float[Array, "B *S"]) -> Float[Array, "B K"]:
    """Predict outputs, see `posenet`, of images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px."""
    return _require(get_functions(net).predict)(net, variables, inputs)


def encode(net: Net, variables: Variables, inputs: Array) -> tuple[Array, Array | None]:
    """Encode images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px, as (z_p, z_s).

    z_s is None without a shear code, as in released weights.
    """
    return _require(get_functions(net).encode)(net, variables, inputs)


def decode_canonical(net: Net, variables: Variables, z_p: Array) -> Array:
    """Decode the pose code to an image in [0, 1] or pins px of the tap."""
    functions = get_functions(net)
    decoded = _require(functions.decode_canonical)(net, variables, z_p)
    return functions.modality.to_output(decoded)


def decode_sheared(net: Net, variables: Variables, z_p: Array, z_s: Array) -> Array:
    """Decode both codes to an image in [0, 1] or pins px of the slide."""
    functions = get_functions(net)
    decoded = _require(functions.decode_sheared)(net, variables, z_p, z_s)
    return functions.modality.to_output(decoded)


def has_shear_code(net: Net) -> bool:
    """Return whether a network has a shear code."""
    return get_functions(net).has_shear_code(net)


def init_like(net: Net, variables: Variables, key: Array) -> Variables:
    """Make fresh variables for the network that unshears and has `variables`."""
    constants = variables.get("batch_stats", {})
    facts = {name: constants[name] for name in ("rest", "spread") if name in constants}
    return get_functions(net).init(net, DataFacts(**facts), key)


def _require(function: Callable[..., Any] | None) -> Callable[..., Any]:
    assert function is not None  # the name of a network says what it does
    return function
