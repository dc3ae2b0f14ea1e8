"""Images as PNG files."""

import io

import numpy as np
from PIL import Image


def png(pixels: np.ndarray, level: int = 6) -> bytes:
    """(H, W) uint8 -> a grey PNG; `level` of zlib: 1 is fast, 9 small."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png", compress_level=level)
    return buffer.getvalue()


def eight_bit(image: np.ndarray) -> np.ndarray:
    """Floats in [0, 1] -> uint8; what lies outside is clipped."""
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
