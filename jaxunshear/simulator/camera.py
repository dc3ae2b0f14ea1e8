"""The pins' view from inside the sensor: a pinhole on its axis, and a square grey frame.

All pins of a frame are drawn by one product of matrices (rows x pins)(pins x columns): a Gaussian
is separable, and a Gaussian cut off at 1 is a flat round dot with a soft edge. There are no gathers
and no scatters, so a batch runs at the machine's speed.

    px = project(camera, tips, sensor)  # (..., P, 2) column, row
    render = jax.jit(render_frame, static_argnums=(0, 1, 2))
    grey = render(camera, sensor, nuisance, tips, key)  # (F, F) in [0, 1]
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Float32

from jaxunshear.config.sensor import Camera, Nuisance, Preprocess, Sensor
from jaxunshear.simulator.pin_layout import compute_pin_tips

# Measured on colour frames of a real 331-pin sensor, as fractions of full scale or of the outermost
# pins' radius.
PIN_GREY = 0.58
DARK_GREY = 0.03
HOUSING_GREY = 0.75
LAMPS = 6  # around the housing

Place = TypeVar("Place", np.ndarray, Array)

PIXEL_BLUR = 12**-0.5  # standard deviation of a pixel's own square aperture
DRIFT_DIRECTION = (0.8, 0.6)  # one fixed direction: a set wears one way


def _compute_focal_px(camera: Camera, sensor: Sensor) -> float:
    apex_pin = sensor.skin_mm + sensor.pin_length_mm
    return camera.frame_px / camera.mm_across * (camera.distance_mm - apex_pin)


def project(camera: Camera, tips: Float[Place, "*B 3"], sensor: Sensor) -> Float[Place, "*B 2"]:
    """Project pin tips in mm of the sensor frame to px of the frame as (column, row).

    x is projected to +column, y to +row.
    """
    centre = (camera.frame_px - 1) / 2
    focal_px = _compute_focal_px(camera, sensor)
    return centre + focal_px * tips[..., :2] / (camera.distance_mm - tips[..., 2:])


def compute_drift(nuisance: Nuisance, age: Float[Array, "*B"] | float) -> Float[Array, "*B 2"]:
    """Compute by how many px (column, row) the entire view has moved at `age` in [0, 1]."""
    return (
        nuisance.drift_px
        * jnp.asarray(age, jnp.float32)[..., None]
        * np.asarray(DRIFT_DIRECTION, np.float32)
    )


def to_image_px(
    camera: Camera, preprocess: Preprocess, px_frame: Float[Place, "*B 2"]
) -> Float[Place, "*B 2"]:
    """Convert px of the frame to px of the preprocessed image; pixel centres lie at integers."""
    return (px_frame + 0.5) * (preprocess.size / camera.frame_px) - 0.5


def compute_outer_fraction(camera: Camera, sensor: Sensor) -> float:
    """Compute the radius of the outermost undeformed pins as a fraction of the frame's width.

    This describes the framing, and can be compared with real frames.
    """
    tips = compute_pin_tips(sensor)
    radius = np.linalg.norm(tips[:, :2], axis=-1) / (camera.distance_mm - tips[:, 2])
    return float(_compute_focal_px(camera, sensor) * radius.max() / camera.frame_px)


def render_frame(
    camera: Camera,
    sensor: Sensor,
    nuisance: Nuisance,
    tips: Float[Array | np.ndarray, "P 3"],
    key: Array,
    age: Float[Array, ""] | float = 0.0,
) -> Float32[Array, "F F"]:
    """Render one grey frame in [0, 1] of pin tips in mm.

    `age` in [0, 1] says how far a drifting set has come. `camera`, `sensor` and `nuisance` are
    static under jit; vmap over `tips`, `key` and `age` for a batch.
    """
    tips = jnp.asarray(tips, jnp.float32)
    age = jnp.asarray(age, jnp.float32)
    shift = compute_drift(nuisance, age)
    light_key, noise_key, speck_key = jax.random.split(key, 3)
    dots = _make_pin_dots(camera, sensor, nuisance, tips, shift)
    specks = _make_specks(camera, sensor, nuisance, shift, speck_key)
    dots = jax.tree.map(lambda *fields: jnp.concatenate(fields), dots, specks)
    wear = 1.0 - nuisance.drift_brightness * age
    light = (PIN_GREY - DARK_GREY) * wear * _draw_light(camera, nuisance, light_key)
    grey = DARK_GREY + light * _draw_dots(camera, nuisance, dots)
    if nuisance.housing_ring:
        grey = grey + (HOUSING_GREY - grey) * _draw_housing(camera, sensor, nuisance, shift)
    if nuisance.noise:
        grey = grey + nuisance.noise * _draw_noise(noise_key, (camera.frame_px, camera.frame_px))
    return jnp.clip(grey, 0.0, 1.0)


class _Dots(NamedTuple):
    centre: Array  # (N, 2) px as (column, row)
    radius: Array  # (N,) px
    weight: Array  # (N,) 1 for a full dot; two dots that share a pin have about a half each


def _compute_softness(nuisance: Nuisance) -> float:
    return float(np.hypot(nuisance.blur_px, PIXEL_BLUR))


def _make_pin_dots(
    camera: Camera, sensor: Sensor, nuisance: Nuisance, tips: Array, shift: Array
) -> _Dots:
    """Make the dots of the pins' round tips, foreshortened where pins lean out of sight.

    A leaning disc is an ellipse across the lean, which no product of a row and a column factor can
    be. The sum of two Gaussians of its short radius can, placed along its long axis so that the
    second moments agree.
    """
    centre = project(camera, tips, sensor) + shift[None, :]
    axis = jnp.asarray([0.0, 0.0, sensor.dome_radius_mm])[None, :] - tips
    if sensor.is_flat:
        axis = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), tips.shape)
    sight = jnp.asarray([0.0, 0.0, camera.distance_mm])[None, :] - tips
    cosine = jnp.sum(axis * sight, -1) / jnp.sqrt(jnp.sum(axis**2, -1) * jnp.sum(sight**2, -1))
    focal_px = _compute_focal_px(camera, sensor)
    long = focal_px * sensor.pin_radius_mm / (camera.distance_mm - tips[:, 2])
    short = long * jnp.clip(cosine, 0.7, 1.0)  # beyond it two dots would show as two
    steep = _compute_steepness(nuisance, short)
    across = jnp.stack([-tips[:, 1], tips[:, 0]], -1) / (
        jnp.linalg.norm(tips[:, :2], axis=-1, keepdims=True) + 1e-6
    )
    spacing = across * jnp.sqrt(jnp.maximum(long**2 - short**2, 0.0) / (2 * steep))[:, None]
    weight = 0.5 * long / short  # two share a pin; the factor keeps the height of the wider sum
    return _Dots(
        jnp.concatenate([centre - spacing, centre + spacing]),
        jnp.tile(short, 2),
        jnp.tile(weight, 2),
    )


def _make_specks(
    camera: Camera, sensor: Sensor, nuisance: Nuisance, shift: Array, key: Array
) -> _Dots:
    """Make dots of dust and bubbles, and of the reflections of the housing's lamps.

    All stay where they are on the sensor. Dust glints more or less from frame to frame: there are
    two places for each speck, visible about half the time.
    """
    rng = np.random.default_rng(1)
    places = 2 * nuisance.specks
    lamps = LAMPS if nuisance.housing_ring else 0
    outer = compute_outer_fraction(camera, sensor) * camera.frame_px
    dust = np.where(
        rng.random(places) < 0.7, rng.uniform(1.06, 1.15, places), np.sqrt(rng.random(places))
    )
    radius = np.concatenate([np.full(lamps, 1.165), dust])
    lamp_turn = (np.arange(lamps) + 0.4 + 0.2 * rng.random(lamps)) / LAMPS
    angle = 2 * np.pi * np.concatenate([lamp_turn, rng.random(places)])
    direction = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    centre = (camera.frame_px - 1) / 2 + outer * direction
    size = camera.frame_px * np.concatenate(
        [rng.uniform(0.006, 0.011, lamps), rng.uniform(0.0025, 0.005, places)]
    )
    glint = jnp.concatenate(
        [jnp.ones(lamps, jnp.float32), jax.random.uniform(key, (places,), jnp.float32)]
    )
    return _Dots(
        jnp.asarray(centre, jnp.float32) + shift[None, :], jnp.asarray(size, jnp.float32), glint
    )


def _compute_steepness(nuisance: Nuisance, radius: Array) -> Array:
    """Compute k of exp(k (1 - d^2 / r^2)) / 2.

    Its slope at the rim d = r is that of a sharp rim blurred by `blur_px`.
    """
    return radius / (_compute_softness(nuisance) * (2 * np.pi) ** 0.5)


def _draw_dots(camera: Camera, nuisance: Nuisance, dots: _Dots) -> Array:
    """Draw the coverage (F, F) in [0, 1]: 1/2 at the rim of a dot of weight 1."""
    k = _compute_steepness(nuisance, dots.radius)
    pixel = jnp.arange(camera.frame_px, dtype=jnp.float32)
    narrow = jnp.sqrt(k) / dots.radius

    def draw_profile(centre: Array) -> Array:
        return jnp.exp(-(((pixel[:, None] - centre[None, :]) * narrow[None, :]) ** 2))

    column, row = draw_profile(dots.centre[:, 0]), draw_profile(dots.centre[:, 1])
    row = row * (0.5 * dots.weight * jnp.exp(k))[None, :]
    return jnp.minimum(jnp.matmul(row, column.T, precision=jax.lax.Precision.HIGHEST), 1.0)


def _draw_light(camera: Camera, nuisance: Nuisance, key: Array) -> Array:
    """Draw a gain and a tilt of the light over the frame, (F, F): 1 +- nuisance.brightness."""
    gain, tilt_x, tilt_y = jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0) * (
        nuisance.brightness / 3
    )
    across = jnp.linspace(-1.0, 1.0, camera.frame_px)
    return 1.0 + gain + tilt_x * across[None, :] + tilt_y * across[:, None]


def _draw_housing(camera: Camera, sensor: Sensor, nuisance: Nuisance, shift: Array) -> Array:
    """Draw the coverage (F, F) of the lit housing around the dome.

    Reflections of its lamps make its edge ragged. The edge belongs to the sensor, so it is the same
    in all frames: amplitudes and phases are fixed.
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
    return jax.nn.sigmoid(-distance * (1.6 / _compute_softness(nuisance)))


def _draw_noise(key: Array, shape: tuple[int, int]) -> Array:
    """Draw noise of unit variance: the sum of a random word's four bytes.

    It is near enough to a Gaussian and costs no erfinv.
    """
    word = jax.random.bits(key, shape, jnp.uint32)
    total = sum(((word >> (8 * i)) & 0xFF).astype(jnp.float32) for i in range(4))
    return (total - 4 * 127.5) * ((4 * (256**2 - 1) / 12) ** -0.5)
