"""Networks over pins: the paper's structure with dense layers over the motions of all pins, behind pure functions.

>>> variables = init(PinUnshear(), rest, spread, jax.random.key(0))       # rest (P, 2) px: the untouched pins
>>> canonical = unshear(net, variables, sheared)                          # pins (B, P, 2) px -> (B, P, 2) px
>>> outputs = predict(pose_net, pose_variables, canonical)                # -> (B, K), as PoseNet's
>>> pins = render_pins(renderer, its_variables, outputs)                       # (B, K) in [0, 1] -> the pins of a tap there

Ours, not the paper's, whose networks read images. A pin that is not seen is NaN, and counts as one that has not moved.
`rest` and `spread` scale what goes in and what comes out; they are constants that the variables carry, and so is the grid of `pin_grid`.
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
            x = nn.gelu(
                nn.LayerNorm()(
                    nn.Dense(self.net.hidden, kernel_init=nn.initializers.he_normal())(x)
                )
            )
        return x


class Dense(nn.Module):
    """A trunk with a linear output, which starts near zero. The trunk convolves where a grid (P, G) is given, too."""

    net: PinNet
    outputs: int

    @nn.compact
    def __call__(self, x: Array, *grid: Array) -> Array:
        small = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        trunk = GridTrunk(self.net) if grid else Trunk(self.net)
        return nn.Dense(self.outputs, kernel_init=small)(trunk(x, *grid))


class PinUnshearModule(nn.Module):
    """E, DC and DS under their names in the paper, over motions (B, 2 P), where E convolves with the grid (P, G) behind them."""

    net: PinUnshear
    motions: int

    def setup(self) -> None:
        net = self.net
        self.E = GridTrunk(net) if net.convolved else Trunk(net)
        self.pose, self.DC = nn.Dense(net.pose_code), Dense(net, self.motions)
        if net.shear_code:
            self.shear, self.DS = nn.Dense(net.shear_code), Dense(net, self.motions)
            self.ES = Trunk(net) if net.apart else None

    def pose_code(self, *seen: Array) -> Array:
        return self.pose(self.E(*seen))

    def encode(self, *seen: Array) -> tuple[Array, Array | None]:
        z = self.E(*seen)
        if not self.net.shear_code:
            return self.pose(z), None
        return self.pose(z), self.shear(z if self.ES is None else self.ES(seen[0]))

    def decode_canonical(self, z_p: Array) -> Array:
        return self.DC(z_p)

    def decode_sheared(self, z_p: Array, z_s: Array) -> Array:
        return self.DS(jnp.concatenate([z_p, z_s], -1))

    def __call__(self, *seen: Array) -> tuple[Array, Array | None]:
        z_p, z_s = self.encode(*seen)
        return self.DC(z_p), None if z_s is None else self.decode_sheared(z_p, z_s)


def init(
    net: PinNet, rest: Float[ArrayLike, "P 2"], spread: float, key: Array, outputs: int = 0
) -> Variables:
    """Fresh variables for pins that stand untouched at `rest` px and move by `spread` px (root mean square). `outputs`: of the
    pose targets together, for all but PinUnshear."""
    motions = int(np.size(rest))
    given = outputs if isinstance(net, PinRenderer) else motions + (2 if net.turned else 0)
    constants = {"rest": jnp.asarray(rest, jnp.float32), "spread": jnp.asarray(spread, jnp.float32)}
    seen = [jnp.zeros((1, given))]
    if net.convolved and not isinstance(net, PinRenderer):
        constants["grid"] = jnp.asarray(make_grid(rest))
        seen.append(constants["grid"])
    return {
        "params": _module(net, motions, outputs).init(key, *seen)["params"],
        "batch_stats": constants,
    }


def unshear(
    net: PinUnshear, variables: Variables, pins: Float[Array, "B P 2"]
) -> Float[Array, "B P 2"]:
    """Sheared pins px -> canonical ones; needs neither the shear code nor DS, which released weights leave out."""
    return decode_canonical(
        net, variables, _codes(net, variables, "pose_code", *_make_inputs(net, variables, pins))
    )


def encode(
    net: PinUnshear, variables: Variables, pins: Float[Array, "B P 2"]
) -> tuple[Float[Array, "B {net.pose_code}"], Float[Array, "B {net.shear_code}"] | None]:
    """Pins px -> (z_p, z_s, or None as in released weights)."""
    if net.shear_code and not has_part(variables, "shear"):
        return _codes(net, variables, "pose_code", *_make_inputs(net, variables, pins)), None
    return _codes(net, variables, "encode", *_make_inputs(net, variables, pins))


def decode_canonical(
    net: PinUnshear, variables: Variables, z_p: Float[Array, "B F"]
) -> Float[Array, "B P 2"]:
    """DC: pose code -> pins px of the tap."""
    return _places(variables, _codes(net, variables, "decode_canonical", z_p))


def decode_sheared(
    net: PinUnshear, variables: Variables, z_p: Float[Array, "B F"], z_s: Float[Array, "B G"]
) -> Float[Array, "B P 2"]:
    """DS: both codes -> pins px of the slide. Raises UserError for released weights, which leave it out."""
    check_has_sheared_decoder(variables)
    return _places(variables, _codes(net, variables, "decode_sheared", z_p, z_s))


def reconstruct(
    net: PinUnshear,
    variables: Variables,
    pins: Float[Array, "B P 2"],
    key: Array | None = None,
    same_pose: Float[Array, "B P 2"] | None = None,
    same_slide: Float[Array, "B P 2"] | None = None,
) -> Reconstruction:
    """Both decoders over sheared pins px; in training a `key` spoils these a little. `same_pose`: a tap there, or
    the pins after another slide; `same_slide`: of another pose after that other slide."""
    partners = [each for each in (same_slide, same_pose) if each is not None]
    seen = jnp.concatenate([pins, *partners])
    seen = seen if key is None else add_noise(net, seen, key)
    # one by one: where trunks are apart, the partner in the slide passes E by
    z_p, z_s = zip(
        *(encode(net, variables, each) for each in jnp.split(seen, 1 + len(partners))), strict=True
    )
    canonical = decode_canonical(net, variables, z_p[0])
    apart = again = None
    if same_pose is not None:
        apart = measure_disagreement(z_p[0], z_p[-1])
        again = decode_canonical(net, variables, z_p[-1])
    if z_s[0] is None:
        return Reconstruction(canonical, z_p[0], disagreement=apart, same_pose=again)
    held = jax.lax.stop_gradient((z_p, z_s)) if net.apart else (z_p, z_s)
    sheared = decode_sheared(net, variables, held[0][0], held[1][0])
    exchanged = (
        None if same_slide is None else decode_sheared(net, variables, held[0][0], held[1][1])
    )
    return Reconstruction(canonical, z_p[0], sheared, exchanged, apart, z_s[0], again)


def predict(
    net: PinPoseNet, variables: Variables, pins: Float[Array, "B P 2"], radians: ArrayLike = 0.0
) -> Float[Array, "B K"]:
    """Pins px -> outputs, scaled as PoseNet's but not bounded. `radians`: by how much all of them were turned, for
    networks that learn from turned pins."""
    motions, *grid = _make_inputs(net, variables, pins)
    if net.turned:
        turn = jnp.stack([jnp.cos(radians), jnp.sin(radians)]).astype(motions.dtype)
        motions = jnp.concatenate([motions, jnp.broadcast_to(turn, (motions.shape[0], 2))], -1)
    return _dense(net, variables, motions, *grid)


def render_pins(
    net: PinRenderer, variables: Variables, outputs: Float[Array, "B K"]
) -> Float[Array, "B P 2"]:
    """Poses as PoseNet's outputs in [0, 1] -> pins px of a tap there."""
    return _places(variables, _dense(net, variables, 2 * outputs - 1))


def compute_pin_distance(
    pins: Float[Array, "B P 2"], target: Float[Array, "B P 2"], variables: Variables
) -> Float[Array, "B"]:
    """Mean squared distance of pins in units of `spread`, over those that the target shows."""
    seen = jnp.isfinite(target)
    square = jnp.where(
        seen,
        jnp.square((pins - jnp.where(seen, target, 0)) / variables["batch_stats"]["spread"]),
        0,
    )
    return square.sum((1, 2)) / jnp.maximum(seen.sum((1, 2), dtype=square.dtype), 1)


def add_noise(net: PinNet, pins: Float[Array, "B P 2"], key: Array) -> Float[Array, "B P 2"]:
    """Pins with the noise of a training example."""
    return pins + net.noise_px * jax.random.normal(key, pins.shape)


def _module(net: PinNet, motions: int, outputs: int) -> nn.Module:
    if isinstance(net, PinUnshear):
        return PinUnshearModule(net, motions)
    return Dense(net, motions if isinstance(net, PinRenderer) else outputs)


def _dense(net: PinNet, variables: Variables, *seen: Array) -> Array:
    params = variables["params"]
    return Dense(net, len(params["Dense_0"]["bias"])).apply({"params": params}, *seen)  # type: ignore[return-value]


def _codes(net: PinUnshear, variables: Variables, method: str, *inputs: Array) -> Any:
    module = PinUnshearModule(net, variables["batch_stats"]["rest"].size)
    return module.apply({"params": variables["params"]}, *inputs, method=method)


def _make_inputs(net: PinNet, variables: Variables, pins: Array) -> tuple[Array, ...]:
    """What E, or a PoseNet, is given."""
    motions = _motions(variables, pins)
    return (motions, variables["batch_stats"]["grid"]) if net.convolved else (motions,)


def _motions(variables: Variables, pins: Array) -> Array:
    """(B, 2 P) in units of `spread`; 0 for pins that are not seen."""
    constants = variables["batch_stats"]
    motion = (pins - constants["rest"][None]) / constants["spread"]
    return jnp.where(jnp.isfinite(motion), motion, 0).reshape(pins.shape[0], -1)


def _places(variables: Variables, motions: Array) -> Array:
    constants = variables["batch_stats"]
    return constants["rest"][None] + constants["spread"] * motions.reshape(
        motions.shape[0], *constants["rest"].shape
    )
