"""The numbers of a frame: which of them is white, and whether there are others than black and white. Imports no JAX."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped

from jaxunshear.errors import UserError

LUMA = np.array(
    [0.299, 0.587, 0.114], np.float32
)  # ITU-R BT.601, as cameras and image libraries make grey
SMALLEST_PX = 16
ONE_BYTE = np.uint8(1)  # after it, as bytes wrap round, 255 and 0 are the only two below 2


def find_white_pixels(raw: np.ndarray) -> Bool[np.ndarray, "H W"] | None:
    """Where a frame of black and white is white; None for every other frame, and for one that is all black or white.

    What `to_grey` and `is_binary` find out in ten times the time for bytes of 0 and 255, and for masks.
    """
    if raw.ndim != 2 or min(raw.shape) < SMALLEST_PX or raw.dtype not in (np.uint8, bool):
        return None
    if raw.dtype == np.uint8 and ((raw + ONE_BYTE) > 1).any():
        return None
    white = raw > 0
    return white if white.any() and not white.all() else None


def find_white_level(raw: np.ndarray) -> float:
    """The number that stands for white in a frame: 1 of masks and floats, 255, or what 10, 12, 14 or 16 bits can hold, which cameras
    keep in wider words. One pixel in a thousand may be brighter than 255, or than 1 in floats: some pixels of a camera are."""
    colours = raw[..., : 1 if raw.shape[-1] < 3 else 3] if raw.ndim == 3 else raw
    most = float(colours.max())
    unit, usual = (
        (1.5, 1.5) if np.issubdtype(raw.dtype, np.floating) else (1.0, 255.0)
    )  # floats may overshoot a little
    if most > usual:
        most = max(usual, float(np.quantile(colours, 0.999)))
    if most <= unit:
        return 1.0
    return next((float(white) for white in (255, 1023, 4095, 16383, 65535) if most <= white), most)


def to_grey(raw: np.ndarray, white: float = 0.0) -> Float32[np.ndarray, "H W"]:
    """An image array -> grey in [0, 1], where 1 is the number `white`, or the frame's own (`find_white_level`) if that is larger, or
    1 itself.

    Raises UserError for a wrong shape, no pixels, values that are no numbers, or numbers below zero (floats may overshoot).
    """
    raw = np.asarray(raw)
    if raw.ndim == 3 and raw.shape[-1] in (1, 2):
        raw = raw[..., 0]
    if raw.ndim not in (2, 3) or (raw.ndim == 3 and raw.shape[-1] not in (3, 4)):
        raise UserError(
            f"this is no image: an array of shape {raw.shape}; give (height, width) or (height, width, channels)"
        )
    if min(raw.shape[:2]) < SMALLEST_PX:
        raise UserError(
            f"this image has {raw.shape[1]} x {raw.shape[0]} pixels: too small to show pins"
        )
    if np.issubdtype(raw.dtype, np.floating):
        if not np.isfinite(raw).all():
            raise UserError("this image holds values that are not finite (NaN or infinity)")
    elif raw.dtype != bool and not np.issubdtype(raw.dtype, np.integer):
        raise UserError(f"this is no image: an array of type {raw.dtype}")
    own = find_white_level(raw)
    if raw.dtype != bool and (least := raw.min()) < (
        -own / 2 if np.issubdtype(raw.dtype, np.floating) else 0
    ):
        raise UserError(
            f"this image holds numbers below zero (down to {least:g}): save it so that black is 0"
        )
    grey = raw.astype(np.float32) / (own if own == 1 else max(own, white))
    return np.clip(grey if grey.ndim == 2 else grey[..., :3] @ LUMA, 0.0, 1.0)


def is_binary(grey: Shaped[np.ndarray, "H W"]) -> bool:
    """Whether (nearly) all pixels are one of two levels far apart: a frame thresholded before (a few greys come of compression)."""
    if grey.dtype == bool:
        return True
    low, high = np.min(grey), np.max(grey)
    if high - low < 0.25:
        return False
    return (
        float(np.mean((grey - low < 0.1 * (high - low)) | (high - grey < 0.1 * (high - low))))
        > 0.97
    )


def compute_middle_level(grey: Shaped[np.ndarray, "H W"]) -> float:
    return float(np.min(grey) + np.max(grey)) / 2


def check_contrast(grey: Float[np.ndarray, "H W"]) -> None:
    """Raises UserError for a frame of one level."""
    if np.ptp(grey) < 0.05:
        raise UserError("this image is one flat grey: there is nothing to see in it")


def check_frame(raw: np.ndarray) -> None:
    """Raises UserError for an array that is no image, too small, or of one level."""
    if find_white_pixels(raw) is None:
        check_contrast(to_grey(raw))
