"""Networks over pins: the paper's structure with dense layers over the motions of all pins.

>>> variables = init(net, rest, spread, jax.random.key(0))   # rest (P, 2) px: the untouched pins
>>> canonical = unshear(net, variables, sheared)             # pins (B, P, 2) px -> (B, P, 2) px
>>> outputs = predict(pose_net, pose_variables, canonical)   # -> (B, K), as PoseNet's
>>> pins = render_pins(renderer, its_variables, outputs)     # (B, K) in [0, 1] -> pins of a tap

These networks are ours; the paper's take images. A missing pin is NaN, and counts as one that has
not moved. `rest` and `spread` scale inputs and outputs. They are constants that the variables
carry, as is the square grid on which the motions of pins are interpolated for convolutions:
neighbouring pins move alike, which dense layers have to learn.

A network that learns several tasks takes the shares of the tasks as a further input, see
`give_tasks`: a flat surface that is tilted moves pins much as the side of an edge does.
"""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from jaxunshear.config.networks import PinNet, PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.models.pin_layers import Dense, PinUnshearModule
from jaxunshear.models.reconstruction import Reconstruction, measure_disagreement
from jaxunshear.models.weights import (
    Net,
    Outputs,
    Pins,
    Variables,
    check_has_sheared_decoder,
    has_part,
)
from jaxunshear.perception.lattice import measure_spacing

GRID_NEIGHBOURS = 30  # pins that the motion at a grid point is interpolated from
MAX_DISTANCE = 1.2  # pin spacings from the nearest pin to a point that has a motion


def make_grid(rest: Float[ArrayLike, "P 2"]) -> Float[np.ndarray, "P G"]:
    """Make the grid of pins that rest at `rest` px: G points in rows, in the spacing of the pins.

    Motions at these points are interpolated by linear splines.
    """
    pins = np.asarray(rest, np.float64)
    low, high = pins.min(axis=0), pins.max(axis=0)
    spacing = measure_spacing(pins)
    side = max(2, round(float(np.max(high - low)) / spacing))
    columns, rows = np.meshgrid(*np.linspace(low, high, side).T)
    points = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    spline = RBFInterpolator(
        pins, np.eye(len(pins)), neighbors=min(GRID_NEIGHBOURS, len(pins)), kernel="linear"
    )
    return np.where(find_inside(pins, points)[:, None], spline(points), 0).T.astype(np.float32)


def find_inside(
    pins: Float[np.ndarray, "P 2"], points: Float[np.ndarray, "*N 2"]
) -> Bool[np.ndarray, "*N"]:
    """Find which points px are near enough to pins at rest to have a motion between theirs."""
    return cKDTree(pins).query(points)[0] < MAX_DISTANCE * measure_spacing(pins)


# settings, size of the motions (2 P), outputs of the pose targets -> module, width of its input
_MODULES: dict[type, Callable[[Net, int, int], tuple[nn.Module, int]]] = {
    PinUnshear: lambda net, motions, outputs: (PinUnshearModule(net, motions), motions),
    PinPoseNet: lambda net, motions, outputs: (
        Dense(net, outputs),
        motions + (2 if net.rotated_share else 0),  # cosine and sine of a rotation
    ),
    PinRenderer: lambda net, motions, outputs: (Dense(net, motions), outputs),
}


def init(
    net: PinNet,
    rest: Float[ArrayLike, "P 2"],
    spread: float | Array,
    key: Array,
    outputs: int = 0,
    grid: ArrayLike | None = None,
    tasks: ArrayLike | None = None,
) -> Variables:
    """Make fresh variables for pins that rest at `rest` px.

    Args:
        spread: how far pins move, root mean square in px.
        outputs: how many the pose targets have together, for all but PinUnshear.
        grid: `make_grid(rest)`, if it is known.
        tasks: shares (T,) of the tasks of a contact whose task is unknown, for PinUnshear; None for
            one task.
    """
    module, width = _MODULES[type(net)](net, int(np.size(rest)), outputs)
    constants = {"rest": jnp.asarray(rest, jnp.float32), "spread": jnp.asarray(spread, jnp.float32)}
    inputs = [jnp.zeros((1, width))]
    if net.conv_channels:
        constants["grid"] = jnp.asarray(make_grid(rest) if grid is None else grid)
        inputs.append(constants["grid"])
    if tasks is not None:
        constants["tasks"] = jnp.asarray(tasks, jnp.float32)
        inputs.append(constants["tasks"][None])
    params = module.init(key, *inputs)["params"]
    return {"params": params, "batch_stats": constants}


def unshear(net: PinUnshear, variables: Variables, pins: Pins) -> Pins:
    """Unshear pins px.

    This needs neither the shear code nor DS, which released weights leave out.
    """
    return decode_canonical(net, variables, _encode_pose(net, variables, pins))


def encode(
    net: PinUnshear, variables: Variables, pins: Pins
) -> tuple[Float[Array, "B {net.pose_code}"], Float[Array, "B {net.shear_code}"] | None]:
    """Encode pins px as (z_p, z_s); z_s is None without a shear code, as in released weights."""
    if net.shear_code and not has_part(variables, "shear"):
        return _encode_pose(net, variables, pins), None
    return _apply(net, variables, "encode", *_make_inputs(net, variables, pins))


def decode_canonical(net: PinUnshear, variables: Variables, z_p: Float[Array, "B F"]) -> Pins:
    """Decode the pose code by DC to pins px of the tap."""
    return _convert_to_pins(variables, _apply(net, variables, "decode_canonical", z_p))


def decode_sheared(
    net: PinUnshear, variables: Variables, z_p: Float[Array, "B F"], z_s: Float[Array, "B G"]
) -> Pins:
    """Decode both codes by DS to pins px of the slide.

    Raises UserError for released weights, which leave DS out.
    """
    check_has_sheared_decoder(variables)
    return _convert_to_pins(variables, _apply(net, variables, "decode_sheared", z_p, z_s))


def reconstruct(
    net: PinUnshear,
    variables: Variables,
    pins: Pins,
    key: Array | None = None,
    same_pose: Pins | None = None,
    same_slide: Pins | None = None,
) -> tuple[Reconstruction, Variables]:
    """Run both decoders over sheared pins px; also return the constants.

    Args:
        key: of the noise in training.
        same_pose: pins of taps at the same poses, or of contacts there after other slides.
        same_slide: pins of contacts at other poses after these other slides.
    """
    second_contacts = [each for each in (same_slide, same_pose) if each is not None]
    inputs = jnp.concatenate([pins, *second_contacts])
    inputs = inputs if key is None else add_noise(net, inputs, key)
    # one by one: with separate trunks the pose code of `same_slide` is unused, and XLA drops it
    codes: list[Any] = [
        encode(net, variables, part) for part in jnp.split(inputs, 1 + len(second_contacts))
    ]
    z_p, z_s = codes[0]
    canonical = decode_canonical(net, variables, z_p)
    disagreement = same_pose_canonical = None
    if same_pose is not None:
        second_z_p, _ = codes[-1]
        disagreement = measure_disagreement(z_p, second_z_p)
        same_pose_canonical = decode_canonical(net, variables, second_z_p)
    if z_s is None:
        outputs = Reconstruction(
            canonical, z_p, disagreement=disagreement, same_pose=same_pose_canonical
        )
        return outputs, variables["batch_stats"]
    pose_codes, shear_codes = [code for code, _ in codes], [code for _, code in codes]
    if net.separate_encoders:  # DS does not teach the codes
        pose_codes, shear_codes = jax.lax.stop_gradient((pose_codes, shear_codes))
    sheared = decode_sheared(net, variables, pose_codes[0], shear_codes[0])
    counterfactual = None
    if same_slide is not None:
        counterfactual = decode_sheared(net, variables, pose_codes[0], shear_codes[1])
    outputs = Reconstruction(
        canonical, z_p, sheared, counterfactual, disagreement, z_s, same_pose_canonical
    )
    return outputs, variables["batch_stats"]


def predict(net: PinPoseNet, variables: Variables, pins: Pins, radians: ArrayLike = 0.0) -> Outputs:
    """Predict outputs of pins px, scaled as PoseNet's but not bounded.

    `radians` is the angle by which all pins were turned, for networks that learn from turned pins.
    """
    motions, *grid = _make_inputs(net, variables, pins)
    if net.rotated_share:
        turn = jnp.stack([jnp.cos(radians), jnp.sin(radians)]).astype(motions.dtype)
        motions = jnp.concatenate([motions, jnp.broadcast_to(turn, (motions.shape[0], 2))], -1)
    return _apply_dense(net, variables, motions, *grid)


def predict_training(
    net: PinPoseNet, variables: Variables, pins: Pins, radians: ArrayLike
) -> tuple[Outputs, Variables]:
    """Predict outputs as `predict`; also return the constants."""
    return predict(net, variables, pins, radians), variables["batch_stats"]


def render_pins(net: PinRenderer, variables: Variables, outputs: Outputs) -> Pins:
    """Render the pins px of a tap at poses that are scaled to [0, 1], as PoseNet's outputs are."""
    return _convert_to_pins(variables, _apply_dense(net, variables, 2 * outputs - 1))


def move_frame(variables: Variables, shift: ArrayLike) -> Variables:
    """Move a network to frames whose pins get to its own by `shift` px; it returns theirs."""
    constants = variables["batch_stats"]
    moved = constants["rest"] - jnp.asarray(shift, jnp.float32)
    return variables | {"batch_stats": constants | {"rest": moved}}


def give_tasks(variables: Variables, shares: Float[Array, "B T"]) -> Variables:
    """Give a network of several tasks the task of each contact: 1 for it, 0 for others."""
    return variables | {"batch_stats": variables["batch_stats"] | {"tasks": shares}}


def fold_tasks(variables: Variables, shares: ArrayLike | None = None) -> Variables:
    """Turn a network of several tasks into one of contacts with these shares (T,) of tasks.

    The input that is constant then goes into the first layer. Without `shares` the task is unknown.
    Other networks stay as they are.
    """
    constants, params = dict(variables.get("batch_stats", {})), variables["params"]
    unknown = constants.pop("tasks", None)
    if unknown is None:
        return variables
    weights = unknown if shares is None else jnp.asarray(shares, jnp.float32)
    name = _find_first_layer(variables)
    layer = params["E"][name]
    kernel, tasks = jnp.split(layer["kernel"], [layer["kernel"].shape[-2] - len(weights)], axis=-2)
    added = jnp.einsum("t,...tc->...c", weights, tasks)
    if name == "Conv_0":  # the channel before them is 1 on the skin, as a task's is
        layer = layer | {"kernel": kernel.at[..., -1, :].add(added)}
    else:
        layer = layer | {"kernel": kernel, "bias": layer["bias"] + added}
    folded = params | {"E": params["E"] | {name: layer}}
    return variables | {"params": folded, "batch_stats": constants}


def unfold_tasks(variables: Variables, count: int) -> Variables:
    """Turn a network of one task into one of `count` tasks that serves all of them alike."""
    params, name = variables["params"], _find_first_layer(variables)
    layer = params["E"][name]
    kernel = layer["kernel"]
    zeros = jnp.zeros((*kernel.shape[:-2], count, kernel.shape[-1]), kernel.dtype)
    layer = layer | {"kernel": jnp.concatenate([kernel, zeros], axis=-2)}
    constants = variables["batch_stats"] | {"tasks": jnp.full(count, 1 / count, jnp.float32)}
    return {"params": params | {"E": params["E"] | {name: layer}}, "batch_stats": constants}


def _find_first_layer(variables: Variables) -> str:
    return "Conv_0" if "Conv_0" in variables["params"]["E"] else "Dense_0"


def add_noise(net: PinNet, pins: Pins, key: Array) -> Pins:
    """Add the noise of training examples to pins."""
    return pins + net.noise_px * jax.random.normal(key, pins.shape)


def _apply_dense(net: PinNet, variables: Variables, *inputs: Array) -> Array:
    params = variables["params"]
    module = Dense(net, len(params["Dense_0"]["bias"]))
    return module.apply({"params": params}, *inputs)  # type: ignore[return-value]


def _encode_pose(net: PinUnshear, variables: Variables, pins: Array) -> Array:
    return _apply(net, variables, "pose_code", *_make_inputs(net, variables, pins))


def _apply(net: PinUnshear, variables: Variables, method: str, *inputs: Array) -> Any:
    module = PinUnshearModule(net, variables["batch_stats"]["rest"].size)
    return module.apply({"params": variables["params"]}, *inputs, method=method)


def _make_inputs(net: PinNet, variables: Variables, pins: Array) -> tuple[Array, ...]:
    """Make the inputs of E, or of a PoseNet: motions, the grid if the network convolves, tasks.

    Motions (B, 2 P) are in units of `spread`; 0 for missing pins. Networks of one task take none.
    """
    constants = variables["batch_stats"]
    motion = (pins - constants["rest"][None]) / constants["spread"]
    motions = jnp.where(jnp.isfinite(motion), motion, 0).reshape(pins.shape[0], -1)
    inputs = [motions, *([constants["grid"]] if net.conv_channels else [])]
    if "tasks" in constants:
        tasks = constants["tasks"]
        inputs.append(jnp.broadcast_to(tasks, (len(motions), tasks.shape[-1])))
    return tuple(inputs)


def _convert_to_pins(variables: Variables, motions: Array) -> Array:
    constants = variables["batch_stats"]
    rest = constants["rest"]
    return rest[None] + constants["spread"] * motions.reshape(motions.shape[0], *rest.shape)
