"""Images like a tactile sensor's, and ways to corrupt them, for the networks' cases.

batch = make_pairs(step=3, count=4, size=64)  # uint8 (4, 64, 64, 1) of {0, 255}
batch = corrupt_images(KINDS["all black"], corrupt_images(convert_to_floats, batch))
"""

from collections.abc import Callable

import numpy as np

PITCH = 0.125  # of the dots, as a fraction of the image
IMAGES = ("canonical", "sheared", "image")
Batch = dict[str, np.ndarray]


def make_pairs(step: int, count: int, size: int) -> Batch:
    """Make dots about a contact, once as a tap and once slid; the same for the same `step`."""
    place, slide = _sample_contacts(step, count)
    return {
        "canonical": _draw_dots(size, place, 0 * slide),
        "sheared": _draw_dots(size, place, slide),
    }


def make_poses(step: int, count: int, size: int) -> Batch:
    """Make taps with labels: "pose" (count, 4) mm, mm, deg, mm and "edge" (count, 2) mm, deg."""
    place, slide = _sample_contacts(step, count)
    offset = 10 * (place - 0.5)
    pose = np.concatenate([offset, 450 * slide[:, :1], np.full((count, 1), 3.0)], 1)
    edge = np.stack([offset[:, 0], np.rad2deg(np.arctan2(slide[:, 1], slide[:, 0]))], 1)
    return {
        "image": _draw_dots(size, place, 0 * slide),
        "pose": pose.astype(np.float32),
        "edge": edge.astype(np.float32),
    }


def _sample_contacts(step: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample places (count, 2) and slides (count, 2), as fractions of the image."""
    generator = np.random.default_rng(step)
    return generator.uniform(0.3, 0.7, (count, 2)), generator.uniform(-0.08, 0.08, (count, 2))


def _draw_dots(size: int, place: np.ndarray, slide: np.ndarray) -> np.ndarray:
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    away_x, away_y = x - place[:, :1, None], y - place[:, 1:, None]
    bump = np.exp(-(away_x**2 + away_y**2) / 0.05)
    u = x - bump * (0.3 * away_x + slide[:, :1, None])
    v = y - bump * (0.3 * away_y + slide[:, 1:, None])
    away_u, away_v = (u + PITCH / 2) % PITCH - PITCH / 2, (v + PITCH / 2) % PITCH - PITCH / 2
    inside = np.hypot(away_u, away_v) < 0.3 * PITCH
    return (inside[..., None] * 255).astype(np.uint8)


def corrupt_images(kind: Callable[[np.ndarray], np.ndarray], batch: Batch) -> Batch:
    """Apply `kind` to the images of a batch, not to its labels."""
    return {name: kind(values) if name in IMAGES else values for name, values in batch.items()}


def vary_one_pixel(images: np.ndarray) -> np.ndarray:
    """Repeat the first image, each time with another pixel of its first line inverted."""
    same = np.repeat(images[:1], len(images), 0)
    flat = same.reshape(len(same), -1)
    flat[np.arange(len(flat)), np.arange(len(flat))] = 1 - flat[0, : len(flat)]
    return same


def insert_nan(images: np.ndarray) -> np.ndarray:
    """Convert to floats in [0, 1], and put a NaN in the middle of the second image."""
    floats = convert_to_floats(images).copy()
    middle = images.shape[1] // 2
    floats[1, middle, middle] = np.nan
    return floats


def convert_to_floats(images: np.ndarray) -> np.ndarray:
    """Convert to floats in [0, 1]; floats stay as they are."""
    return images / np.float32(255) if images.dtype == np.uint8 else images


# of float images
KINDS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "constant grey": lambda images: np.full_like(images, 0.5),
    "all black": np.zeros_like,
    "all white": np.ones_like,
    "inverted": lambda images: 1 - images,
    "alike": lambda images: np.repeat(images[:1], len(images), 0),
    "one pixel apart": vary_one_pixel,
}
