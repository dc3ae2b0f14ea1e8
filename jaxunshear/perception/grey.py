"""Convert the numbers of a camera frame to grey, and find what stands for white. Imports no JAX."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped

from jaxunshear.errors import UserError

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601, as cameras make grey
MIN_SIDE_PX = 16
ONE_BYTE = np.uint8(1)  # added to a byte, it makes 255 and 0 the only two values below 2
CAMERA_WHITES = (255, 1023, 4095, 16383, 65535)  # of 8, 10, 12, 14 and 16 bits
BINARY_TOLERANCE = 0.1  # share of the span within which a pixel has one of the two levels
MIN_BINARY_SHARE = 0.97  # share of such pixels: compression leaves a few greys
MIN_CONTRAST = 0.05
LOW_CONTRAST = 0.12  # between dark and bright pixels, below which noise hides pins
DARK_GREY = 0.35  # below which a frame of low contrast needs more light
SATURATED_GREY = 0.98
MAX_SATURATED_SHARE = 0.35  # of the pixels: pins and housing take a quarter
SHARP_SIDE_PX = 256  # to which a frame is reduced before its sharpness is measured
MIN_SHARPNESS = 0.1  # of the contrast, by which neighbouring pixels at the sharpest places differ


def find_white_pixels(raw: np.ndarray) -> Bool[np.ndarray, "H W"] | None:
    """Find the white pixels of a frame of black and white.

    Returns None for every other frame, and for one that is all black or all white. For masks and
    bytes of 0 and 255 this replaces `to_grey` and `is_binary`, in a tenth of their time.
    """
    if raw.ndim != 2 or min(raw.shape) < MIN_SIDE_PX or raw.dtype not in (np.uint8, bool):
        return None
    if raw.dtype == np.uint8 and ((raw + ONE_BYTE) > 1).any():
        return None
    white = raw > 0
    return white if white.any() and not white.all() else None


def find_white_level(raw: np.ndarray) -> float:
    """Find the number that stands for white in a frame.

    It is 1 for masks and floats, else 255 or the largest number of 10, 12, 14 or 16 bits, which
    cameras keep in wider words. One pixel in a thousand may be brighter than 255, or than 1 in
    floats, since some pixels of a camera are.
    """
    colours = raw[..., : 1 if raw.shape[-1] < 3 else 3] if raw.ndim == 3 else raw
    brightest = float(colours.max())
    is_float = np.issubdtype(raw.dtype, np.floating)
    unit, usual = (1.5, 1.5) if is_float else (1.0, 255.0)  # floats may overshoot a little
    if brightest > usual:
        brightest = max(usual, float(np.quantile(colours, 0.999)))
    if brightest <= unit:
        return 1.0
    return next((float(white) for white in CAMERA_WHITES if brightest <= white), brightest)


def to_grey(raw: np.ndarray, white: float = 0.0) -> Float32[np.ndarray, "H W"]:
    """Convert an image array to grey in [0, 1].

    The number that becomes 1 is `white`, or the frame's white level (`find_white_level`) if that
    is larger or is 1. Raises UserError for a wrong shape, no pixels, values that are no numbers,
    or numbers below zero (floats may overshoot).
    """
    raw = np.asarray(raw)
    if raw.ndim == 3 and raw.shape[-1] in (1, 2):
        raw = raw[..., 0]
    _check_shape_and_type(raw)
    level = find_white_level(raw)
    lowest = 0 if raw.dtype == bool else raw.min()
    if lowest < (-level / 2 if np.issubdtype(raw.dtype, np.floating) else 0):
        raise UserError(
            f"this image holds numbers below zero (down to {lowest:g}): save it so that black is 0"
        )
    grey = raw.astype(np.float32) / (level if level == 1 else max(level, white))
    return np.clip(grey if grey.ndim == 2 else grey[..., :3] @ LUMA, 0.0, 1.0)


def _check_shape_and_type(raw: np.ndarray) -> None:
    if raw.ndim not in (2, 3) or (raw.ndim == 3 and raw.shape[-1] not in (3, 4)):
        raise UserError(
            f"this is no image: an array of shape {raw.shape}; "
            "give (height, width) or (height, width, channels)"
        )
    if min(raw.shape[:2]) < MIN_SIDE_PX:
        raise UserError(
            f"this image has {raw.shape[1]} x {raw.shape[0]} pixels: too small to show pins"
        )
    if np.issubdtype(raw.dtype, np.floating):
        if not np.isfinite(raw).all():
            raise UserError("this image holds values that are not finite (NaN or infinity)")
    elif raw.dtype != bool and not np.issubdtype(raw.dtype, np.integer):
        raise UserError(f"this is no image: an array of type {raw.dtype}")


def is_binary(grey: Shaped[np.ndarray, "H W"]) -> bool:
    """Return whether nearly all pixels have one of two levels far apart, as after a threshold."""
    if grey.dtype == bool:
        return True
    low, high = np.min(grey), np.max(grey)
    if high - low < MIN_CONTRAST:
        return False
    tolerance = BINARY_TOLERANCE * (high - low)
    return float(np.mean((grey - low < tolerance) | (high - grey < tolerance))) > MIN_BINARY_SHARE


def compute_middle_level(grey: Shaped[np.ndarray, "H W"]) -> float:
    """Return the mean of the darkest and the brightest level."""
    return float(np.min(grey) + np.max(grey)) / 2


def check_contrast(grey: Float[np.ndarray, "H W"]) -> None:
    """Raise UserError for a frame of one level."""
    if np.ptp(grey) < MIN_CONTRAST:
        raise UserError("this image is one flat grey: there is nothing to see in it")


def explain_exposure(grey: Float[np.ndarray, "H W"]) -> str:
    """Say what is wrong with a frame's light or focus, and what to do; nothing if nothing is."""
    if np.mean(grey > SATURATED_GREY) > MAX_SATURATED_SHARE:
        return "the frames are overexposed: expose for a shorter time"
    low, high = np.percentile(grey, (5, 99))
    if high - low < LOW_CONTRAST:
        shown = f"grey {255 * low:.0f} to {255 * high:.0f} of 255"
        if high < DARK_GREY:
            return f"the frames are too dark ({shown}): expose longer, or light more"
        return f"the frames have too little contrast ({shown}): light the pins, not what is around"
    if is_binary(grey):
        return ""
    step = max(1, min(grey.shape) // SHARP_SIDE_PX)
    height = grey.shape[0] // step * step
    width = grey.shape[1] // step * step
    small = grey[:height, :width].reshape(height // step, step, width // step, step).mean((1, 3))
    sharpness = np.percentile(np.hypot(*np.gradient(small)), 99) / (high - low)
    return "the frames are blurred: focus the camera" if sharpness < MIN_SHARPNESS else ""


def check_frame(raw: np.ndarray) -> None:
    """Raise UserError for an array that is no image, too small, or of one level."""
    if find_white_pixels(raw) is None:
        check_contrast(to_grey(raw))
