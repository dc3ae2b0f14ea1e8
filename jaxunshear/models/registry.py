"""The networks, by the class of their settings: one entry each, and functions that run any of them.

>>> canonical = unshear(net, variables, sheared)  # images in [0, 1], or pins px
>>> outputs = predict(pose_net, pose_variables, canonical)  # (B, K), see `posenet`

A network of your own is added by `register_network`, see docs/extending.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxunshear.config import networks
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.types import claim_name
from jaxunshear.models import pin_networks, posenet, unet, unshearnet
from jaxunshear.models.modality import IMAGES, PINS, Modality
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import AnyArray, Net, Tree, Variables, get_module, list_leaves


class InitFacts(NamedTuple):
    """What the variables of a network depend on besides its settings."""

    outputs: int = 0  # of all pose targets together, K
    rest: ArrayLike = np.zeros((0, 2), np.float32)  # (P, 2) px: the untouched pins
    spread: float | Array = 1.0  # how far pins move, root mean square in px
    grid: ArrayLike | None = None  # the weights of `make_grid`, which takes seconds, if known
    tasks: ArrayLike | None = None  # (T,) shares of several tasks that stand for an unknown one


@dataclass(frozen=True)
class NetworkFunctions:
    """How the networks with settings of one class are built and run.

    All are pure functions of settings, variables {"params", "batch_stats"} and arrays; inputs are
    images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px. A network that unshears has `reconstruct`,
    one with codes also `encode` and the decoders; one that reads poses has `predict` and
    `predict_training`.
    """

    kind: str  # its name in model.json
    # a frozen dataclass, which may have `find_problems`; over images it has the field `size`, px
    settings: type
    modality: Modality
    init: Callable[[Net, InitFacts, Array], Variables]
    # settings, variables, sheared inputs, key (None but in training), inputs at the same poses and
    # after the same slides, or None -> outputs and new running statistics
    reconstruct: Callable[..., tuple[Reconstruction, Tree]] | None = None
    # for weights without what only training needs; else `reconstruct` unshears
    unshear: Callable[[Net, Variables, Array], Array] | None = None
    encode: Callable[[Net, Variables, Array], tuple[Array, Array | None]] | None = None
    decode_canonical: Callable[[Net, Variables, Array], Array] | None = None
    decode_sheared: Callable[[Net, Variables, Array, Array], Array] | None = None
    has_shear_code: Callable[[Net], bool] = lambda net: False
    # numbers of the shear code that the slide can be taught to; 0 for spatial codes, which are
    # not exchanged between slides either
    count_slide_numbers: Callable[[Net], int] = lambda net: 0
    predict: Callable[[Net, Variables, Array], Array] | None = None
    # inputs, angle by which they were turned (rad) -> outputs (B, K) and new running statistics
    predict_training: Callable[[Net, Variables, Array, ArrayLike], tuple[Array, Tree]] | None = None


def _init_pin_network(net: networks.PinNet, facts: InitFacts, key: Array) -> Variables:
    return pin_networks.init(
        net, facts.rest, facts.spread, key, facts.outputs, facts.grid, facts.tasks
    )


_FUNCTIONS: dict[type, NetworkFunctions] = {
    functions.settings: functions
    for functions in (
        NetworkFunctions(
            "unshear",
            networks.UnshearNet,
            IMAGES,
            lambda net, facts, key: unshearnet.init(net, key),
            reconstruct=unshearnet.reconstruct,
            unshear=unshearnet.unshear,
            encode=unshearnet.encode,
            decode_canonical=unshearnet.decode_canonical,
            decode_sheared=unshearnet.decode_sheared,
            has_shear_code=lambda net: net.disentangled and net.shear_channels > 0,
            count_slide_numbers=lambda net: net.shear_channels if net.separate_encoders else 0,
        ),
        NetworkFunctions(
            "unet",
            networks.UNet,
            IMAGES,
            lambda net, facts, key: unet.init(net, key),
            reconstruct=unet.reconstruct,
        ),
        NetworkFunctions(
            "posenet",
            networks.PoseNet,
            IMAGES,
            lambda net, facts, key: posenet.init(net, facts.outputs, key),
            predict=posenet.predict,
            predict_training=posenet.predict_training,
        ),
        NetworkFunctions(
            "pin_unshear",
            networks.PinUnshear,
            PINS,
            _init_pin_network,
            reconstruct=pin_networks.reconstruct,
            unshear=pin_networks.unshear,
            encode=pin_networks.encode,
            decode_canonical=pin_networks.decode_canonical,
            decode_sheared=pin_networks.decode_sheared,
            has_shear_code=lambda net: net.shear_code > 0,
            count_slide_numbers=lambda net: net.shear_code,
        ),
        NetworkFunctions(
            "pin_posenet",
            networks.PinPoseNet,
            PINS,
            _init_pin_network,
            predict=pin_networks.predict,
            predict_training=pin_networks.predict_training,
        ),
        NetworkFunctions("renderer", networks.PinRenderer, PINS, _init_pin_network),
    )
}


def register_network(
    name: str,
    functions: NetworkFunctions,
    make_settings: Callable[[Experiment], Net],
    title: str = "",
) -> None:
    """Register a network that unshears, which `networks` of an experiment can then name.

    `title` is that of its images in tables and figures. Raises UserError if another network has
    this name.
    """
    claim_name("network", name, networks.REGISTRY, make_settings.__code__.co_filename)
    networks.add_network(
        networks.NetworkSpec(
            name,
            "unshears",
            "pairs",
            title or name,
            modalities=(functions.modality.name,),
            make_settings=make_settings,
        )
    )
    _FUNCTIONS[functions.settings] = functions


def get_functions(net: Net) -> NetworkFunctions:
    """Return the functions of a network by its settings."""
    return _FUNCTIONS[type(net)]


def find_settings_class(kind: str) -> type | None:
    """Find the class of settings that model.json calls `kind`; None if no network has it."""
    # the latest: an experiment file may be read twice
    classes = {functions.kind: functions.settings for functions in _FUNCTIONS.values()}
    return classes.get(kind)


def get_net_modality(net: Net) -> Modality:
    """Return the modality of a network."""
    return get_functions(net).modality


def scale_inputs(inputs: AnyArray) -> AnyArray:
    """Scale images (B, S, S) uint8 to (B, S, S, 1) in [0, 1]; pins and scaled images stay."""
    return inputs[..., None].astype(np.float32) / 255 if inputs.dtype == np.uint8 else inputs


def run_in_batches(run: Callable[[np.ndarray], Tree], inputs: np.ndarray, batch_size: int) -> Tree:
    """Run a function of any number of examples, (N, ...), in batches of one shape.

    One shape is compiled once. The results of `run` are arrays (B, ...), or a tree of them.
    """
    parts = []
    for start in range(0, max(1, len(inputs)), batch_size):
        part = inputs[start : start + batch_size]
        outputs = jax.device_get(run(np.resize(part, (batch_size, *part.shape[1:]))))
        parts.append(jax.tree.map(lambda values, count=len(part): values[:count], outputs))
    return jax.tree.map(lambda *values: np.concatenate(values), *parts)


def unshear(net: Net, variables: Variables, inputs: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """Unshear images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px."""
    functions = get_functions(net)
    if functions.unshear is not None:
        return functions.unshear(net, variables, inputs)
    variables = {"batch_stats": {}} | variables
    outputs, _ = _require(functions.reconstruct)(net, variables, inputs, None, None, None)
    return functions.modality.to_output(outputs.canonical)


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


def init_like(net: Net, variables: Variables, key: Array, outputs: int = 0) -> Variables:
    """Make fresh variables for the network that has `variables`; `outputs` are those of poses."""
    constants = variables.get("batch_stats", {})
    facts = {name: constants[name] for name in InitFacts._fields if name in constants}
    return get_functions(net).init(net, InitFacts(outputs, **facts), key)


def find_misfit(net: Net, variables: Variables, outputs: int) -> str:
    """Say which array is not of the shape that the settings ask for; empty if all are.

    Released weights may lack modules, but no part of one.
    """
    fresh = jax.eval_shape(lambda key: init_like(net, variables, key, outputs), jax.random.key(0))
    found, expected = list_leaves(variables), list_leaves(fresh)
    modules = {get_module(name) for name in found}
    for name in {name for name in expected if get_module(name) in modules} | found.keys():
        here = found[name].shape if name in found else None
        there = expected[name].shape if name in expected else None
        if here != there:
            return f"{name} is {here or 'missing'}, not {there or 'of this network'}"
    return ""


def _require(function: Callable[..., Tree] | None) -> Callable[..., Tree]:
    assert function is not None  # the name of a network says what it does
    return function
