"""Pins seen from inside the dome: a pinhole on its axis, and a square grey frame of the lit pins.

All pins of a frame are drawn by ONE product of matrices (rows x pins)(pins x columns): a Gaussian is separable, and a Gaussian
cut off at 1 is a flat round dot with a soft edge. No gathers and no scatters, so a batch runs at the machine's speed.

    px = project(camera, tips, sensor)                                       # (..., P, 2) column, row
    grey = jax.jit(frame, static_argnums=(0, 1, 2))(camera, sensor, nuisance, tips, key)   # (F, F) in [0, 1]
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Float32

from jaxunshear.config.image import Camera, Nuisance, Preprocess
from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.pin_layout import compute_pin_tips

# Measured on colour frames of a real 331-pin sensor, as fractions of full scale or of the outermost pins' radius.
PIN_GREY = 0.58
DARK_GREY = 0.03
HOUSING_GREY = 0.75
LAMPS = 6  # around the housing

Place = TypeVar("Place", np.ndarray, Array)

PIXEL_BLUR = 12**-0.5  # standard deviation of a pixel's own square aperture
DRIFT_DIRECTION = (0.8, 0.6)  # one fixed direction: a set wears one way


def _focal_px(camera: Camera, sensor: Sensor) -> float:
    apex_pin = sensor.skin_mm + sensor.pin_length_mm
    return camera.frame_px / camera.mm_across * (camera.distance_mm - apex_pin)


def project(camera: Camera, tips: Float[Place, "*B 3"], sensor: Sensor) -> Float[Place, "*B 2"]:
    """Pin tips in mm of the sensor frame -> px of the frame as (column, row); x -> +column, y -> +row."""
    centre = (camera.frame_px - 1) / 2
    return centre + _focal_px(camera, sensor) * tips[..., :2] / (camera.distance_mm - tips[..., 2:])


def compute_drift(nuisance: Nuisance, age: Float[Array, "*B"] | float) -> Float[Array, "*B 2"]:
    """How far the entire view has moved at `age` in [0, 1]: px of the frame as (column, row)."""
    return (
        nuisance.drift_px
        * jnp.asarray(age, jnp.float32)[..., None]
        * np.asarray(DRIFT_DIRECTION, np.float32)
    )


def to_image_px(
    camera: Camera, preprocess: Preprocess, px_frame: Float[Place, "*B 2"]
) -> Float[Place, "*B 2"]:
    """Positions in px of the frame -> px of the preprocessed image (pixel centres lie at integers in both)."""
    return (px_frame + 0.5) * (preprocess.size / camera.frame_px) - 0.5


def compute_outer_fraction(camera: Camera, sensor: Sensor) -> float:
    """Radius of the outermost undeformed pins as a fraction of the frame's width: the framing, comparable with real frames."""
    tips = compute_pin_tips(sensor)
    radius = np.linalg.norm(tips[:, :2], axis=-1) / (camera.distance_mm - tips[:, 2])
    return float(_focal_px(camera, sensor) * radius.max() / camera.frame_px)


def render_frame(
    camera: Camera,
    sensor: Sensor,
    nuisance: Nuisance,
    tips: Float[Array | np.ndarray, "P 3"],
    key: Array,
    age: Float[Array, ""] | float = 0.0,
) -> Float32[Array, "F F"]:
    """One grey frame in [0, 1] of pin tips in mm; `age` in [0, 1] says how far a drifting set has come.

    `camera`, `sensor` and `nuisance` are static under jit; vmap over `tips`, `key` and `age` for a batch.
    """
    tips = jnp.asarray(tips, jnp.float32)
    age = jnp.asarray(age, jnp.float32)
    shift = compute_drift(nuisance, age)
    light_key, noise_key, speck_key = jax.random.split(key, 3)
    dots = _pins(camera, sensor, nuisance, tips, shift)
    specks = _specks(camera, sensor, nuisance, shift, speck_key)
    dots = _Dots(*map(jnp.concatenate, zip(dots, specks, strict=True)))
    wear = 1.0 - nuisance.drift_brightness * age
    light = (PIN_GREY - DARK_GREY) * wear * _light(camera, nuisance, light_key)
    grey = DARK_GREY + light * _draw(camera, nuisance, dots)
    if nuisance.housing_ring:
        grey = grey + (HOUSING_GREY - grey) * _housing(camera, sensor, nuisance, shift)
    if nuisance.noise:
        grey = grey + nuisance.noise * _noise(noise_key, (camera.frame_px, camera.frame_px))
    return jnp.clip(grey, 0.0, 1.0)


class _Dots(NamedTuple):
    centre: Array  # (N, 2) px as (column, row)
    radius: Array  # (N,) px
    weight: Array  # (N,) 1 for a full dot; two dots that share a pin have about a half each


def _softness(nuisance: Nuisance) -> float:
    return float(np.hypot(nuisance.blur_px, PIXEL_BLUR))


def _pins(camera: Camera, sensor: Sensor, nuisance: Nuisance, tips: Array, shift: Array) -> _Dots:
    """The pins' round tips, foreshortened where their axis leans away from the line of sight.

    A leaning disc is an ellipse across the lean, which no product of a row and a column factor can be; the sum of two Gaussians
    of its short radius, set apart along its long axis so that the second moments agree, can.
    """
    centre = project(camera, tips, sensor) + shift[None, :]
    axis = jnp.asarray([0.0, 0.0, sensor.dome_radius_mm])[None, :] - tips
    sight = jnp.asarray([0.0, 0.0, camera.distance_mm])[None, :] - tips
    cosine = jnp.sum(axis * sight, -1) / jnp.sqrt(jnp.sum(axis**2, -1) * jnp.sum(sight**2, -1))
    long = _focal_px(camera, sensor) * sensor.pin_radius_mm / (camera.distance_mm - tips[:, 2])
    short = long * jnp.clip(cosine, 0.7, 1.0)  # beyond it two dots would show as two
    steep = _steepness(nuisance, short)
    across = jnp.stack([-tips[:, 1], tips[:, 0]], -1) / (
        jnp.linalg.norm(tips[:, :2], axis=-1, keepdims=True) + 1e-6
    )
    apart = across * jnp.sqrt(jnp.maximum(long**2 - short**2, 0.0) / (2 * steep))[:, None]
    weight = 0.5 * long / short  # two share a pin; the factor keeps the height of the wider sum
    return _Dots(
        jnp.concatenate([centre - apart, centre + apart]), jnp.tile(short, 2), jnp.tile(weight, 2)
    )


def _specks(camera: Camera, sensor: Sensor, nuisance: Nuisance, shift: Array, key: Array) -> _Dots:
    """Dust and bubbles, and the reflections of the housing's lamps: all stay where they are on the sensor.

    Dust glints more or less from frame to frame; two places for each speck, seen about half the time.
    """
    rng = np.random.default_rng(1)
    places = 2 * nuisance.specks
    lamps = LAMPS if nuisance.housing_ring else 0
    outer = compute_outer_fraction(camera, sensor) * camera.frame_px
    dust = np.where(
        rng.random(places) < 0.7, rng.uniform(1.06, 1.15, places), np.sqrt(rng.random(places))
    )
    radius = np.concatenate([np.full(lamps, 1.165), dust])
    angle = (
        2
        * np.pi
        * np.concatenate(
            [(np.arange(lamps) + 0.4 + 0.2 * rng.random(lamps)) / LAMPS, rng.random(places)]
        )
    )
    centre = (camera.frame_px - 1) / 2 + outer * np.stack(
        [radius * np.cos(angle), radius * np.sin(angle)], -1
    )
    size = camera.frame_px * np.concatenate(
        [rng.uniform(0.006, 0.011, lamps), rng.uniform(0.0025, 0.005, places)]
    )
    glint = jnp.concatenate(
        [jnp.ones(lamps, jnp.float32), jax.random.uniform(key, (places,), jnp.float32)]
    )
    return _Dots(
        jnp.asarray(centre, jnp.float32) + shift[None, :], jnp.asarray(size, jnp.float32), glint
    )


def _steepness(nuisance: Nuisance, radius: Array) -> Array:
    """k of exp(k (1 - d^2 / r^2)) / 2, whose slope at the rim d = r is that of a sharp rim blurred by `blur_px`."""
    return radius / (_softness(nuisance) * (2 * np.pi) ** 0.5)


def _draw(camera: Camera, nuisance: Nuisance, dots: _Dots) -> Array:
    """Coverage (F, F) in [0, 1]: 1/2 at the rim of a dot of weight 1."""
    k = _steepness(nuisance, dots.radius)
    pixel = jnp.arange(camera.frame_px, dtype=jnp.float32)
    narrow = jnp.sqrt(k) / dots.radius
    column, row = (
        jnp.exp(-(((pixel[:, None] - dots.centre[None, :, i]) * narrow[None, :]) ** 2))
        for i in (0, 1)
    )
    row = row * (0.5 * dots.weight * jnp.exp(k))[None, :]
    return jnp.minimum(jnp.matmul(row, column.T, precision=jax.lax.Precision.HIGHEST), 1.0)


def _light(camera: Camera, nuisance: Nuisance, key: Array) -> Array:
    """A gain and a tilt of the light over the frame, (F, F): at most 1 +- nuisance.brightness."""
    gain, tilt_x, tilt_y = jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0) * (
        nuisance.brightness / 3
    )
    across = jnp.linspace(-1.0, 1.0, camera.frame_px)
    return 1.0 + gain + tilt_x * across[None, :] + tilt_y * across[:, None]


def _housing(camera: Camera, sensor: Sensor, nuisance: Nuisance, shift: Array) -> Array:
    """Coverage (F, F) of the lit housing around the dome, with the ragged edge that reflections of its lamps give it.

    The edge belongs to the sensor, so it is the same in all frames: fixed amplitudes and phases.
    """
    rng = np.random.default_rng(0)
    across = np.arange(camera.frame_px) - (camera.frame_px - 1) / 2
    x, y = np.meshgrid(across, across)
    angle = np.arctan2(y, x)
    edge = np.full_like(
        x, camera.housing * compute_outer_fraction(camera, sensor) * camera.frame_px
    )
    for wave, phase in enumerate(rng.uniform(0, 2 * np.pi, 12), start=1):
        edge += 0.0015 * camera.frame_px * np.cos(wave * angle + phase) / np.sqrt(wave)
    inside = jnp.asarray(edge - np.hypot(x, y), jnp.float32)
    outward = jnp.asarray(
        np.stack([x, y], -1) / np.maximum(np.hypot(x, y), 1.0)[..., None], jnp.float32
    )
    # A drift of a pixel or so moves a nearly straight edge by its component along the normal.
    distance = inside + outward[..., 0] * shift[0] + outward[..., 1] * shift[1]
    return jax.nn.sigmoid(-distance * (1.6 / _softness(nuisance)))


def _noise(key: Array, shape: tuple[int, int]) -> Array:
    """Noise of unit variance: the sum of a random word's four bytes is near enough to a Gaussian and costs no erfinv."""
    word = jax.random.bits(key, shape, jnp.uint32)
    total = sum(((word >> (8 * i)) & 0xFF).astype(jnp.float32) for i in range(4))
    return (total - 4 * 127.5) * ((4 * (256**2 - 1) / 12) ** -0.5)
