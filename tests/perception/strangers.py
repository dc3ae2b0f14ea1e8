"""Images that a sensor's model must know, and images that are none of its sensor's.

All are binary (S, S) uint8 of {0, 255}. Simulated ones need no contact solved: pins move by smooth
fields of up to two spacings.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.draw import ellipse, rectangle
from skimage.util import montage, view_as_blocks

from jaxunshear.angles import rotation_2d
from jaxunshear.config.configs import PAIRED
from jaxunshear.config.sensor import Camera, Nuisance, Preprocess, Sensor
from jaxunshear.data.simulation import render_images
from jaxunshear.perception.lattice import measure_spacing
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.sensor_check import invert_image
from jaxunshear.simulator.pin_layout import compute_pin_tips

REACH = 2.0  # spacings, the longest way of a pin


def touched(sensor: Sensor, camera: Camera, count: int, seed: int, size: int = 128) -> np.ndarray:
    """Images (count, S, S) of a sensor pressed and slid, with drift, specks and glints."""
    settings = replace(
        PAIRED["demo"],
        camera=camera,
        preprocess=Preprocess(size=size),
        nuisance=Nuisance(drift_px=2.0 * camera.frame_px / 128, drift_brightness=0.1),
        seed=seed,
    )
    rng = np.random.default_rng(seed)
    tips = np.array([_moved(sensor, rng) for _ in range(count)])
    return render_images(settings, sensor, tips, np.arange(count), rng.random(count))[0]


def _moved(sensor: Sensor, rng: Generator) -> np.ndarray:
    """Return pin tips (P, 3) mm that a dent has spread, a slide carried and a twist turned.

    They move less towards the rim, where the skin is held.
    """
    tips = compute_pin_tips(sensor)
    flat = tips[:, :2]
    radius = np.linalg.norm(flat, axis=1).max()
    offset = flat - rng.normal(0, 0.35, 2) * radius
    bump = np.exp(-0.5 * (offset**2).sum(1) / (rng.uniform(0.7, 1.5) * radius) ** 2)
    held = 1 - 0.5 * (np.linalg.norm(flat, axis=1) / radius) ** 4
    angle = rng.uniform(0, 2 * np.pi)
    way = rng.uniform(0, REACH) * np.array([np.cos(angle), np.sin(angle)])
    spread, twist = rng.uniform(-0.3, 0.8), rng.uniform(-0.6, 0.6)
    field = way + (spread * offset + twist * offset[:, ::-1] * [-1, 1]) / radius
    return tips + np.pad(sensor.pin_spacing_mm * (bump * held)[:, None] * field, ((0, 0), (0, 1)))


def varied(image: np.ndarray, rng: Generator) -> np.ndarray:
    """Return the image as of another day.

    It is turned, drifted by up to 2 px of 128, up to 4 % nearer or farther, and has up to a dozen
    specks.
    """
    size = len(image)
    drift = rng.uniform(-2, 2, 2) * size / 128
    image = _resampled(image, rng.uniform(0.96, 1.04), rng.uniform(0, 2 * np.pi), drift).copy()
    for row, column in rng.integers(0, size - 1, (rng.integers(0, 13), 2)):
        image[row : row + rng.integers(1, 3), column : column + rng.integers(1, 3)] = 255
    return image


def _resampled(image: np.ndarray, scale: float, turn: float = 0.0, shift=(0.0, 0.0)) -> np.ndarray:
    """Scale and turn an image about the middle, then shift it by px as (row, column).

    The edge of the mask continues outwards, as housings do: pieces of its ring that black cut off
    would pass for pins.
    """
    middle = (len(image) - 1) / 2
    offset = np.moveaxis(np.indices(image.shape), 0, -1) - middle - np.asarray(shift)
    source = offset @ rotation_2d(turn) / scale
    radius = np.linalg.norm(source, axis=-1, keepdims=True)
    source *= np.minimum(1, (Preprocess().mask_radius * len(image) - 1) / np.maximum(radius, 1))
    place = np.moveaxis(middle + source, -1, 0)
    return _masked(ndimage.map_coordinates(image.astype(np.float32), place, order=1) > 127)


def _masked(white: np.ndarray) -> np.ndarray:
    return invert_image(np.where(white, np.uint8(0), np.uint8(255)))


def _dots(place: np.ndarray, size: int, radius: float) -> np.ndarray:
    """Discs of `radius` px about places (N, 2) px as (column, row)."""
    pixels = np.indices((size, size))[::-1].reshape(2, -1).T
    off = cKDTree(place).query(pixels, distance_upper_bound=radius)[0]
    return _masked(np.isfinite(off).reshape(size, size))


def _white_noise(image: np.ndarray, rng: Generator) -> np.ndarray:
    return _masked(rng.random(image.shape) < rng.uniform(0.03, 0.6))


def _blobs(image: np.ndarray, rng: Generator) -> np.ndarray:
    """Noise of one wavelength, of usual spacings of pins to ten times that."""
    spacing = len(image) * 0.036 * 10 ** rng.random()
    wave = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(len(image))])) * spacing
    band = np.exp(-(((wave - 1) / 0.2) ** 2))
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=image.shape)) * band).real
    return _masked(noise > np.quantile(noise, rng.uniform(0.65, 0.85)))


def _tiles(image: np.ndarray, rng: Generator) -> np.ndarray:
    side = len(image) // int(rng.choice([8, 16, 32]))
    count = len(image) // side
    cut = count * side
    tiles = view_as_blocks(image[:cut, :cut], (side, side)).reshape(-1, side, side)
    shuffled = montage(rng.permutation(tiles), grid_shape=(count, count))
    return np.pad(shuffled, (0, len(image) - cut))


def _scattered(image: np.ndarray, rng: Generator) -> np.ndarray:
    """The sensor's own pins, strewn about by a quarter of their spacing or more."""
    pins = detect_pin_centres(image)
    spacing = measure_spacing(pins)
    strewn = pins + rng.normal(0, rng.uniform(0.25, 1) * spacing, pins.shape)
    return _dots(strewn, len(image), 0.25 * spacing)


def _square_grid(image: np.ndarray, rng: Generator) -> np.ndarray:
    """Even, over the full image: a sieve, a textile, a screen."""
    size = len(image)
    spacing = size * rng.uniform(0.03, 0.12)
    steps = np.arange(-size, size, spacing)
    angle = rng.uniform(0, np.pi)
    place = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) @ rotation_2d(-angle)
    place = place[np.hypot(*place.T) < 0.5 * size]
    return _dots(size / 2 + place, size, 0.3 * spacing)


def _picture(image: np.ndarray, rng: Generator) -> np.ndarray:
    """Things of many sizes and greys before one another, thresholded like any frame."""
    size = len(image)
    grey = np.full(image.shape, rng.random(), np.float32)
    for _ in range(rng.integers(10, 200)):
        row, column = rng.integers(0, size, 2)
        high, wide = np.ceil(size * 10 ** rng.uniform(-2, -0.5, 2)).astype(int)
        if rng.random() < 0.5:
            shape = ellipse(row, column, high, wide, image.shape, rng.uniform(-np.pi, np.pi))
        else:
            shape = rectangle((row, column), extent=(high, wide), shape=image.shape)
        grey[tuple(shape)] = rng.random()
    return _prepared(grey)


def _prepared(grey: np.ndarray) -> np.ndarray:
    full = (0, 0, len(grey), len(grey))
    return prepare_frame(Preprocess(size=len(grey)), grey, View(full))


def _blurred(image: np.ndarray, rng: Generator) -> np.ndarray:
    """Out of focus by half a spacing and more."""
    deviation = len(image) * rng.uniform(0.03, 0.08)
    return _prepared(ndimage.gaussian_filter(image.astype(np.float32) / 255, deviation))


def _off_side(image: np.ndarray, rng: Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    way = rng.uniform(0.15, 0.4) * len(image)
    return _resampled(image, 1.0, 0.0, way * np.array([np.cos(angle), np.sin(angle)]))


def _half_covered(image: np.ndarray, rng: Generator) -> np.ndarray:
    """A straight cover, black or white, over 35 to 75 % of the width."""
    size, angle = len(image), rng.uniform(0, 2 * np.pi)
    rows, columns = np.mgrid[:size, :size] / size - 0.5
    cover = columns * np.cos(angle) + rows * np.sin(angle) > 0.4 - 0.8 * rng.uniform(0.35, 0.75)
    return _masked(np.where(cover, rng.random() < 0.5, image > 127))


# What is made of, or in place of, an image (S, S) of the sensor.
STRANGERS: dict[str, Callable[[np.ndarray, Generator], np.ndarray]] = {
    "white noise": _white_noise,
    "blobs": _blobs,
    "shuffled tiles": _tiles,
    "scattered dots": _scattered,
    "square grid": _square_grid,
    "pictures": _picture,
    "blurred": _blurred,
    "shrunk by 15 % and more": lambda image, rng: _resampled(image, rng.uniform(0.4, 0.85)),
    "zoomed by 15 % and more": lambda image, rng: _resampled(image, rng.uniform(1.15, 2.5)),
    "off by 15 % and more": _off_side,
    "half covered": _half_covered,
    "inverted": lambda image, rng: invert_image(image),
    "blank": lambda image, rng: _masked(np.full(image.shape, rng.random() < 0.5)),
}
