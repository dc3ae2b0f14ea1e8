"""PNG data addresses, and the difference of two images in colour."""

import base64
import io

import numpy as np
from PIL import Image

MISSING, SURPLUS = (255, 122, 26), (64, 150, 255)  # orange: the tap has it, the image does not; blue: the reverse


def png_address(pixels: np.ndarray) -> str:
    """(H, W) or (H, W, 3) uint8 -> a `data:` address of a PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png", optimize=True)
    return address_of(buffer.getvalue())


def address_of(png: bytes) -> str:
    """A `data:` address of a PNG, so that the page needs no second file."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def difference(image: np.ndarray, tap: np.ndarray) -> np.ndarray:
    """(H, W) uint8 pairs -> (H, W, 3) uint8: what both have in grey, what is missing in orange, what is surplus in blue."""
    a, b = image.astype(np.float32)[..., None] / 255, tap.astype(np.float32)[..., None] / 255
    shared = np.minimum(a, b) * 90
    missing = np.clip(b - a, 0, 1) * np.array(MISSING, np.float32)
    surplus = np.clip(a - b, 0, 1) * np.array(SURPLUS, np.float32)
    return np.clip(np.rint(shared + missing + surplus), 0, 255).astype(np.uint8)
