"""Networks over pins: the paper's structure with dense layers over the motions of all pins.

>>> variables = init(net, rest, spread, jax.random.key(0))   # rest (P, 2) px: the untouched pins
>>> canonical = unshear(net, variables, sheared)             # pins (B, P, 2) px -> (B, P, 2) px
>>> outputs = predict(pose_net, pose_variables, canonical)   # -> (B, K), as PoseNet's
>>> pins = render_pins(renderer, its_variables, outputs)     # (B, K) in [0, 1] -> pins of a tap

These networks are ours; the paper's take images. A missing pin is NaN, and counts as one that has
not moved. `rest` and `spread` scale inputs and outputs. They are constants that the variables
carry, as is the grid of `pin_grid`.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxunshear.config.networks import PinNet, PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.models.pin_grid import GridTrunk, make_grid
from jaxunshear.models.reconstruction import Reconstruction, measure_disagreement
from jaxunshear.models.weights import Variables, check_has_sheared_decoder, has_part


class Trunk(nn.Module):
    """Dense layers, each normalised over its units."""

    net: PinNet

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for _ in range(self.net.layers):
            dense = nn.Dense(self.net.hidden, kernel_init=nn.initializers.he_normal())
            x = nn.gelu(nn.LayerNorm()(dense(x)))
        return x


class Dense(nn.Module):
    """A trunk with a linear output, which starts near zero. With a grid (P, G), it convolves."""

    net: PinNet
    outputs: int

    @nn.compact
    def __call__(self, x: Array, *grid: Array) -> Array:
        small = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        trunk = GridTrunk(self.net) if grid else Trunk(self.net)
        return nn.Dense(self.outputs, kernel_init=small)(trunk(x, *grid))


class PinUnshearModule(nn.Module):
    """E, DC and DS under their names in the paper, over motions (B, 2 P).

    With a grid (P, G) after the motions, E convolves.
    """

    net: PinUnshear
    motions: int

    def setup(self) -> None:
        net = self.net
        self.E = GridTrunk(net) if net.convolved else Trunk(net)
        self.pose, self.DC = nn.Dense(net.pose_code), Dense(net, self.motions)
        if net.shear_code:
            self.shear, self.DS = nn.Dense(net.shear_code), Dense(net, self.motions)
            self.ES = Trunk(net) if net.apart else None

    def pose_code(self, motions: Array, *grid: Array) -> Array:
        return self.pose(self.E(motions, *grid))

    def encode(self, motions: Array, *grid: Array) -> tuple[Array, Array | None]:
        z = self.E(motions, *grid)
        if not self.net.shear_code:
            return self.pose(z), None
        return self.pose(z), self.shear(z if self.ES is None else self.ES(motions))

    def decode_canonical(self, z_p: Array) -> Array:
        return self.DC(z_p)

    def decode_sheared(self, z_p: Array, z_s: Array) -> Array:
        return self.DS(jnp.concatenate([z_p, z_s], -1))

    def __call__(self, motions: Array, *grid: Array) -> tuple[Array, Array | None]:
        z_p, z_s = self.encode(motions, *grid)
        return self.DC(z_p), None if z_s is None else self.decode_sheared(z_p, z_s)


def init(
    net: PinNet, rest: Float[ArrayLike, "P 2"], spread: float, key: Array, outputs: int = 0
) -> Variables:
    """Make fresh variables for pins that rest at `rest` px.

    Args:
        spread: how far pins move, root mean square in px.
        outputs: how many the pose targets have together, for all but PinUnshear.
    """
    motions = int(np.size(rest))
    width = outputs if isinstance(net, PinRenderer) else motions + (2 if net.turned else 0)
    constants = {"rest": jnp.asarray(rest, jnp.float32), "spread": jnp.asarray(spread, jnp.float32)}
    inputs = [jnp.zeros((1, width))]
    if net.convolved and not isinstance(net, PinRenderer):
        constants["grid"] = jnp.asarray(make_grid(rest))
        inputs.append(constants["grid"])
    params = _make_module(net, motions, outputs).init(key, *inputs)["params"]
    return {"params": params, "batch_stats": constants}


def unshear(
    net: PinUnshear, variables: Variables, pins: Float[Array, "B P 2"]
) -> Float[Array, "B P 2"]:
    """Unshear pins px.

    This needs neither the shear code nor DS, which released weights leave out.
    """
    return decode_canonical(net, variables, _encode_pose(net, variables, pins))


def encode(
    net: PinUnshear, variables: Variables, pins: Float[Array, "B P 2"]
) -> tuple[Float[Array, "B {net.pose_code}"], Float[Array, "B {net.shear_code}"] | None]:
    """Encode pins px as (z_p, z_s); z_s is None without a shear code, as in released weights."""
    if net.shear_code and not has_part(variables, "shear"):
        return _encode_pose(net, variables, pins), None
    return _apply(net, variables, "encode", *_make_inputs(net, variables, pins))


def decode_canonical(
    net: PinUnshear, variables: Variables, z_p: Float[Array, "B F"]
) -> Float[Array, "B P 2"]:
    """Decode the pose code by DC to pins px of the tap."""
    return _convert_to_pins(variables, _apply(net, variables, "decode_canonical", z_p))


def decode_sheared(
    net: PinUnshear, variables: Variables, z_p: Float[Array, "B F"], z_s: Float[Array, "B G"]
) -> Float[Array, "B P 2"]:
    """Decode both codes by DS to pins px of the slide.

    Raises UserError for released weights, which leave DS out.
    """
    check_has_sheared_decoder(variables)
    return _convert_to_pins(variables, _apply(net, variables, "decode_sheared", z_p, z_s))


def reconstruct(
    net: PinUnshear,
    variables: Variables,
    pins: Float[Array, "B P 2"],
    key: Array | None = None,
    same_pose: Float[Array, "B P 2"] | None = None,
    same_slide: Float[Array, "B P 2"] | None = None,
) -> Reconstruction:
    """Run both decoders over sheared pins px.

    Args:
        key: of the noise in training.
        same_pose: pins of taps at the same poses, or of contacts there after other slides.
        same_slide: pins of contacts at other poses after these other slides.
    """
    partners = [each for each in (same_slide, same_pose) if each is not None]
    inputs = jnp.concatenate([pins, *partners])
    inputs = inputs if key is None else add_noise(net, inputs, key)
    # one by one: with separate trunks the pose code of `same_slide` is unused, and XLA drops it
    codes: list[Any] = [
        encode(net, variables, part) for part in jnp.split(inputs, 1 + len(partners))
    ]
    z_p, z_s = codes[0]
    canonical = decode_canonical(net, variables, z_p)
    disagreement = same_pose_canonical = None
    if same_pose is not None:
        partner_z_p, _ = codes[-1]
        disagreement = measure_disagreement(z_p, partner_z_p)
        same_pose_canonical = decode_canonical(net, variables, partner_z_p)
    if z_s is None:
        return Reconstruction(
            canonical, z_p, disagreement=disagreement, same_pose=same_pose_canonical
        )
    pose_codes, shear_codes = [code for code, _ in codes], [code for _, code in codes]
    if net.apart:  # DS does not teach the codes
        pose_codes, shear_codes = jax.lax.stop_gradient((pose_codes, shear_codes))
    sheared = decode_sheared(net, variables, pose_codes[0], shear_codes[0])
    counterfactual = None
    if same_slide is not None:
        counterfactual = decode_sheared(net, variables, pose_codes[0], shear_codes[1])
    return Reconstruction(
        canonical, z_p, sheared, counterfactual, disagreement, z_s, same_pose_canonical
    )


def predict(
    net: PinPoseNet, variables: Variables, pins: Float[Array, "B P 2"], radians: ArrayLike = 0.0
) -> Float[Array, "B K"]:
    """Predict outputs of pins px, scaled as PoseNet's but not bounded.

    `radians` is the angle by which all pins were turned, for networks that learn from turned pins.
    """
    motions, *grid = _make_inputs(net, variables, pins)
    if net.turned:
        turn = jnp.stack([jnp.cos(radians), jnp.sin(radians)]).astype(motions.dtype)
        motions = jnp.concatenate([motions, jnp.broadcast_to(turn, (motions.shape[0], 2))], -1)
    return _apply_dense(net, variables, motions, *grid)


def render_pins(
    net: PinRenderer, variables: Variables, outputs: Float[Array, "B K"]
) -> Float[Array, "B P 2"]:
    """Render the pins px of a tap at poses that are scaled to [0, 1], as PoseNet's outputs are."""
    return _convert_to_pins(variables, _apply_dense(net, variables, 2 * outputs - 1))


def add_noise(net: PinNet, pins: Float[Array, "B P 2"], key: Array) -> Float[Array, "B P 2"]:
    """Add the noise of training examples to pins."""
    return pins + net.noise_px * jax.random.normal(key, pins.shape)


def _make_module(net: PinNet, motions: int, outputs: int) -> nn.Module:
    if isinstance(net, PinUnshear):
        return PinUnshearModule(net, motions)
    return Dense(net, motions if isinstance(net, PinRenderer) else outputs)


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
    """Make the inputs of E, or of a PoseNet: motions, and the grid if the network convolves."""
    motions = _compute_motions(variables, pins)
    return (motions, variables["batch_stats"]["grid"]) if net.convolved else (motions,)


def _compute_motions(variables: Variables, pins: Array) -> Array:
    """Compute motions (B, 2 P) of pins px in units of `spread`; 0 for missing pins."""
    constants = variables["batch_stats"]
    motion = (pins - constants["rest"][None]) / constants["spread"]
    return jnp.where(jnp.isfinite(motion), motion, 0).reshape(pins.shape[0], -1)


def _convert_to_pins(variables: Variables, motions: Array) -> Array:
    constants = variables["batch_stats"]
    rest = constants["rest"]
    return rest[None] + constants["spread"] * motions.reshape(motions.shape[0], *rest.shape)
