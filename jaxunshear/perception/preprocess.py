"""A grey frame becomes a binary image: crop, resize by area, adaptive threshold on a local mean, circular mask.

The same for simulated and real frames. Resizing by area and the local mean are both linear and separable, so each is one fixed
matrix on the rows and one on the columns; a batch is a few products of matrices.

    images = jax.jit(binarise, static_argnums=0)(Preprocess(size=128), grey)       # (..., H, H) -> (..., 128, 128)
    image = prepare_frame(Preprocess(size=128), imageio.imread("frame.png"))       # any real frame
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Float32, Shaped, UInt8
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.measure import label
from threadpoolctl import ThreadpoolController

from jaxunshear.config.image import Preprocess
from jaxunshear.errors import UserError
from jaxunshear.perception.grey import (
    check_contrast,
    compute_middle_level,
    find_white_level,
    find_white_pixels,
    is_binary,
    to_grey,
)
from jaxunshear.perception.pin_detection import find_clustered, find_hull

OUTER_PINS_OF_DISC = (
    0.82  # radius of the outermost pins over that of the dark disc, measured: 172 and 210 px
)

Grey = TypeVar("Grey", np.ndarray, Array)


def binarise(preprocess: Preprocess, grey: Array) -> UInt8[Array, "... S S"]:
    """Square grey crops (..., H, H) in [0, 1] -> binary images of {0, 255}."""
    if grey.ndim < 2 or grey.shape[-1] != grey.shape[-2]:
        raise ValueError(f"binarise takes square crops (..., H, H), got shape {grey.shape}")
    return _binarise(_jax_matmul, preprocess, jnp.asarray(grey, jnp.float32))


def _binarise(
    matmul: Callable[[Grey, np.ndarray], Grey], preprocess: Preprocess, grey: Grey
) -> Grey:
    small = _both_sides(matmul, make_area_matrix(grey.shape[-1], preprocess.size), grey)
    mean = _both_sides(matmul, make_mean_matrix(preprocess), small)
    mask = make_mask(preprocess)
    white = (small > mean + preprocess.offset) & mask.reshape((1,) * (grey.ndim - 2) + mask.shape)
    return white.astype(np.uint8) * np.uint8(255)


def _jax_matmul(a: Array, b: ArrayLike) -> Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _both_sides(
    matmul: Callable[[Grey, np.ndarray], Grey], matrix: np.ndarray, image: Grey
) -> Grey:
    """M X M^T for every image: both products are tall plain ones, which is faster than a batch of small ones."""
    half = matmul(image, matrix.T)
    return matmul(half.swapaxes(-1, -2), matrix.T).swapaxes(-1, -2)


@lru_cache
def make_area_matrix(before: int, after: int) -> Float32[np.ndarray, "{after} {before}"]:
    """The share of each old pixel in each new one, rows summing to 1."""
    edges = np.arange(after + 1) * (before / after)
    old = np.arange(before)
    overlap = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return (np.clip(overlap, 0, None) * (after / before)).astype(np.float32)


@lru_cache
def make_mean_matrix(preprocess: Preprocess) -> Float32[np.ndarray, "S S"]:
    """The mean over the block of pixels around each, mirrored at the border as scipy's mode 'reflect'."""
    size = preprocess.size
    block = max(3, 2 * round(preprocess.block * size / 2) + 1)
    return ndimage.uniform_filter1d(np.eye(size), block, axis=0, mode="reflect").astype(np.float32)


@lru_cache
def make_mask(preprocess: Preprocess) -> Bool[np.ndarray, "S S"]:
    """The circle within which pins are."""
    across = np.arange(preprocess.size) - (preprocess.size - 1) / 2
    return np.hypot(across[:, None], across) <= preprocess.mask_radius * preprocess.size


class View(NamedTuple):
    """What the frames of one camera have in common."""

    box: tuple[int, int, int, int] | None = (
        None  # left, top, right, bottom, px; None: each frame's own
    )
    # (type of number, the one that stands for white), unless a frame is brighter
    whites: tuple[tuple[str, float], ...] = ()


def prepare_frame(
    preprocess: Preprocess, raw: np.ndarray, view: View = View()
) -> UInt8[np.ndarray, "S S"]:
    """A recorded frame (H, W) or (H, W, 1 to 4 channels), of any number type -> binary image of {0, 255}.

    Without a box in `view` the dome is found and cropped. A frame that is binary already is
    not thresholded again, and not cropped unless its framing is clearly another. Raises UserError for what is no image.
    """
    raw = np.asarray(raw)
    grey = find_white_pixels(raw)
    if grey is None:
        grey = to_grey(raw, dict(view.whites).get(raw.dtype.name, 0.0))
        check_contrast(grey)
    square = crop_frame(grey, view.box or _box(preprocess, grey))
    if square.dtype == bool and len(square) == preprocess.size:
        return (square & make_mask(preprocess)).view(np.uint8) * np.uint8(255)
    with _limit_to_one_thread():
        if not is_binary(grey):
            return _binarise(np.matmul, preprocess, square)
        small = _both_sides(np.matmul, make_area_matrix(len(square), preprocess.size), square)
    return ((small >= compute_middle_level(grey)) & make_mask(preprocess)).astype(
        np.uint8
    ) * np.uint8(255)


def _limit_to_one_thread() -> AbstractContextManager[object]:
    """Of BLAS: on busy cores two threads take ten times as long for products as small as these."""
    return _blas().limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController()  # searches for libraries: milliseconds


def find_view(preprocess: Preprocess, raw: np.ndarray) -> View:
    """What one frame shows. Raises UserError for one that is not usable."""
    return View(_box(preprocess, to_grey(raw)), ((raw.dtype.name, find_white_level(raw)),))


def combine_views(views: list[View]) -> View:
    """Of some frames' own views: the median crop, since one that trembled would appear as motion, and the brightest white of each
    type of number, since a contrast that changed would too."""
    boxes = [view.box for view in views if view.box]
    pairs = [pair for view in views for pair in view.whites]
    whites = tuple(
        sorted(
            {
                kind: max(white for other, white in pairs if other == kind) for kind, _ in pairs
            }.items()
        )
    )
    if not boxes:
        return View(None, whites)
    left, top, right, bottom = np.median(boxes, axis=0)
    side = round(max(right - left, bottom - top))
    left, top = round((left + right - side) / 2), round((top + bottom - side) / 2)
    return View((left, top, left + side, top + side), whites)


def _box(preprocess: Preprocess, grey: np.ndarray) -> tuple[int, int, int, int]:
    return (_reframe if is_binary(grey) else find_dome)(grey, preprocess.outer_pins)


def _reframe(grey: np.ndarray, outer_pins: float) -> tuple[int, int, int, int]:
    """Of a binary frame the middle square; where that misses the framing by more than 12%, the one that the pins ask for.

    Resampling costs a binary image its edges, so a framing that is near enough stays.
    """
    pins = _pin_circle(grey > compute_middle_level(grey))
    if pins is None or abs(pins.radius / outer_pins / min(grey.shape) - 1) < 0.12:
        return _middle(grey.shape)
    return _square(pins.row, pins.column, pins.radius / outer_pins)


def find_dome(grey: Float[np.ndarray, "H W"], outer_pins: float) -> tuple[int, int, int, int]:
    """The square (left, top, right, bottom) that puts the outermost pins `outer_pins` of its side from its middle.

    It goes by the dark dome disc in a light surround; without such a disc by the pins; without pins it is the middle square.
    Raises UserError for a frame of one flat grey.
    """
    check_contrast(grey)
    smallest = min(grey.shape)
    disc = _fit_circle(_disc_rim(grey))
    if (
        disc is not None
        and 0.15 * smallest < disc.radius < 0.75 * smallest
        and disc.off < 0.05 * disc.radius
    ):
        return _square(disc.row, disc.column, disc.radius * OUTER_PINS_OF_DISC / outer_pins)
    window = 2 * (smallest // 14) + 1
    pins = _pin_circle(grey > ndimage.uniform_filter(grey, window) + 0.1)
    return (
        _middle(grey.shape)
        if pins is None
        else _square(pins.row, pins.column, pins.radius / outer_pins)
    )


def _disc_rim(grey: np.ndarray) -> np.ndarray:
    """Rim of the largest dark part with its holes (the pins) filled, (N, 2) px as (row, column)."""
    dark = grey < threshold_otsu(grey)
    parts = label(dark, connectivity=1)
    disc = ndimage.binary_fill_holes(parts == 1 + np.argmax(np.bincount(parts[dark])[1:]))
    steps = max(1, min(grey.shape) // 60)
    disc = np.pad(
        disc, steps, mode="edge"
    )  # else the opening rounds the corners of a frame that is dark all over
    disc = ndimage.binary_opening(disc, iterations=steps)[steps:-steps, steps:-steps]
    rim = disc & ~ndimage.binary_erosion(disc)
    rim[[0, -1], :] = rim[:, [0, -1]] = False  # where the frame cuts the disc, its border is no rim
    return np.argwhere(rim).astype(float)


def _pin_circle(white: np.ndarray) -> "_Circle | None":
    """Through the outermost of the white dots (H, W), where they lie on one of a believable size."""
    pins, smallest = _fit_circle(_pin_outline(white)), min(white.shape)
    if (
        pins is None
        or not 0.1 * smallest < pins.radius < 0.75 * smallest
        or pins.off > 0.1 * pins.radius
    ):
        return None
    return pins


def _pin_outline(white: np.ndarray) -> np.ndarray:
    """Outermost of the white dots of the usual size (H, W), (N, 2) px as (row, column)."""
    parts = label(white, connectivity=1)
    area = np.bincount(parts.ravel())[1:]
    if np.count_nonzero(area > 2) < 20:
        return np.zeros((0, 2))
    typical = np.median(area[area > 2])
    dots = 1 + np.flatnonzero((area > 0.4 * typical) & (area < 2.5 * typical))
    centres = np.array(ndimage.center_of_mass(white, parts, dots))
    centres = centres[find_clustered(centres)]
    return centres[find_hull(centres)] if len(centres) >= 20 else np.zeros((0, 2))


class _Circle(NamedTuple):
    row: float
    column: float
    radius: float
    off: float  # median distance of the points from it


def _fit_circle(points: np.ndarray) -> _Circle | None:
    """Least-squares circle through (N, 2) points, refitted without the worst; None for too few."""
    keep = points
    for _ in range(6):
        if len(keep) < 10:
            return None
        design = np.column_stack([2 * keep, np.ones(len(keep))])
        solution = np.linalg.lstsq(design, (keep**2).sum(-1), rcond=None)[0]
        centre, radius = solution[:2], np.sqrt(max(solution[2] + (solution[:2] ** 2).sum(), 0.0))
        off = np.abs(np.linalg.norm(points - centre, axis=-1) - radius)
        keep = points[off <= max(1.0, 2.5 * np.median(off))]
    return _Circle(float(centre[0]), float(centre[1]), float(radius), float(np.median(off)))


def _square(row: float, column: float, side: float) -> tuple[int, int, int, int]:
    full = round(side)
    left, top = round(column + 0.5 - full / 2), round(row + 0.5 - full / 2)
    return left, top, left + full, top + full


def _middle(shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    return _square((shape[0] - 1) / 2, (shape[1] - 1) / 2, min(shape))


def crop_frame(
    grey: Shaped[np.ndarray, "H W"], bbox: tuple[int, int, int, int]
) -> Shaped[np.ndarray, "S S"]:
    """A square crop; what lies outside the frame repeats its border. A bbox that is not square grows about its middle."""
    left, top, right, bottom = (round(edge) for edge in bbox)
    height, width = grey.shape
    if (
        left >= right
        or top >= bottom
        or left >= width
        or top >= height
        or right <= 0
        or bottom <= 0
    ):
        raise UserError(
            f"bbox {left},{top},{right},{bottom} holds no pixels of a frame of {width} x {height}"
        )
    side = max(right - left, bottom - top)
    left, top = (left + right - side) // 2, (top + bottom - side) // 2
    if min(left, top) >= 0 and left + side <= width and top + side <= height:
        return np.ascontiguousarray(grey[top : top + side, left : left + side])
    rows = np.clip(np.arange(top, top + side), 0, height - 1)
    columns = np.clip(np.arange(left, left + side), 0, width - 1)
    return grey.take(rows, 0).take(columns, 1)
