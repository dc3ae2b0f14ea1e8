"""Turn a grey frame into a binary image: crop, resize, adaptive threshold, circular mask.

Simulated and real frames are treated alike. Resizing by area and the local mean are both linear and
separable, so each is one fixed matrix on the rows and one on the columns; a batch is a few products
of matrices.

    prepare = jax.jit(binarise, static_argnums=0)
    images = prepare(Preprocess(size=128), grey)  # (..., H, H) -> (..., 128, 128)
    image = prepare_frame(Preprocess(size=128), imageio.imread("frame.png"))  # any real frame
"""

from collections.abc import Callable
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

from jaxunshear.config.sensor import Preprocess
from jaxunshear.errors import UserError
from jaxunshear.perception.grey import (
    check_contrast,
    compute_middle_level,
    find_white_level,
    find_white_pixels,
    is_binary,
    to_grey,
)
from jaxunshear.perception.pin_detection import find_clusters, find_hull

# Least rms difference of grey from the mean around it that simulated sensors show, soft or worn.
USUAL_CONTRAST = 0.14
MIN_THRESHOLD_SCALE = 0.125  # below which noise and steps of grey would pass a threshold
# Radius of the outermost pins over that of the dark disc, measured: 172 and 210 px.
OUTER_PINS_OF_DISC = 0.82
MAX_ASPECT_ERROR = 0.02  # of width over height, within which frames show the same part of a scene
MAX_FRAMING_ERROR = 0.12  # of a binary frame's scale, below which it is not resampled
DISC_RADIUS_RANGE = (0.15, 0.75)  # of the frame's shorter side
MAX_DISC_ERROR = 0.05  # of the radius: usual distance of the rim from the circle
PIN_RADIUS_RANGE = (0.1, 0.75)
MAX_PIN_CIRCLE_ERROR = 0.1
MAX_RECTANGLE_ERROR = 0.04  # of the radius: mean distance of the outermost dots from its sides
DOT_AREA_RANGE = (0.4, 2.5)  # of the usual dot
MIN_DOT_PX = 3
MIN_DOTS = 20
MIN_CIRCLE_POINTS = 10
CIRCLE_FITS = 6

Grey = TypeVar("Grey", np.ndarray, Array)


def binarise(preprocess: Preprocess, grey: Array) -> UInt8[Array, "... S S"]:
    """Threshold square grey crops (..., H, H) in [0, 1] to binary images of {0, 255}.

    Raises ValueError for crops that are not square.
    """
    if grey.ndim < 2 or grey.shape[-1] != grey.shape[-2]:
        raise ValueError(f"binarise takes square crops (..., H, H), got shape {grey.shape}")
    return _binarise(_jax_matmul, preprocess, jnp.asarray(grey, jnp.float32))


def _binarise(
    matmul: Callable[[Grey, np.ndarray], Grey], preprocess: Preprocess, grey: Grey
) -> Grey:
    small = _both_sides(matmul, make_area_matrix(grey.shape[-1], preprocess.size), grey)
    mean = _both_sides(matmul, make_mean_matrix(preprocess), small)
    mask = make_mask(preprocess)
    mask = mask.reshape((1,) * (grey.ndim - 2) + mask.shape)
    offset = preprocess.offset * _scale_threshold(small - mean, mask)
    white = (small > mean + offset) & mask
    return white.astype(np.uint8) * np.uint8(255)


def _scale_threshold(difference: Grey, where: np.ndarray | bool) -> Grey:
    """Compute the factor (..., 1, 1) of a threshold: 1 in usual light, less at lower contrast.

    The contrast is the rms difference (..., H, W) of the grey from the mean around it, `where`.
    """
    contrast = (difference**2).mean((-2, -1), keepdims=True, where=where) ** 0.5
    return (contrast / USUAL_CONTRAST).clip(MIN_THRESHOLD_SCALE, 1)


def _jax_matmul(a: Array, b: ArrayLike) -> Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _both_sides(
    matmul: Callable[[Grey, np.ndarray], Grey], matrix: np.ndarray, image: Grey
) -> Grey:
    """Return M X M^T of each image: two products of tall matrices, faster than many small ones."""
    half = matmul(image, matrix.T)
    return matmul(half.swapaxes(-1, -2), matrix.T).swapaxes(-1, -2)


@lru_cache
def make_area_matrix(before: int, after: int) -> Float32[np.ndarray, "{after} {before}"]:
    """Make the shares of each old pixel in each new one, rows summing to 1."""
    edges = np.arange(after + 1) * (before / after)
    old = np.arange(before)
    overlap = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return (np.clip(overlap, 0, None) * (after / before)).astype(np.float32)


@lru_cache
def make_mean_matrix(preprocess: Preprocess) -> Float32[np.ndarray, "S S"]:
    """Make the mean over the block around each pixel, with a border as scipy's mode 'reflect'."""
    size = preprocess.size
    block = max(3, 2 * round(preprocess.block * size / 2) + 1)
    return ndimage.uniform_filter1d(np.eye(size), block, axis=0, mode="reflect").astype(np.float32)


@lru_cache
def make_mask(preprocess: Preprocess) -> Bool[np.ndarray, "S S"]:
    """Make the circle within which pins are."""
    across = np.arange(preprocess.size) - (preprocess.size - 1) / 2
    return np.hypot(across[:, None], across) <= preprocess.mask_radius * preprocess.size


class Box(NamedTuple):
    """The edges of a crop, px."""

    left: int
    top: int
    right: int
    bottom: int


class View(NamedTuple):
    """What the frames of one camera have in common."""

    box: Box | None = None  # None: each frame has its own
    # (type of number, the one that stands for white), unless a frame is brighter
    whites: tuple[tuple[str, float], ...] = ()
    frame_px: tuple[int, int] | None = None  # height and width of the frames that `box` is of
    dark: bool = False  # whether markers are dark on a light ground: frames are inverted


def prepare_frame(
    preprocess: Preprocess, raw: np.ndarray, view: View = View()
) -> UInt8[np.ndarray, "S S"]:
    """Turn a recorded frame into a binary image of {0, 255}.

    The frame has any type of number, and the shape (H, W) or (H, W, 1 to 4 channels). Without a box
    in `view` the dome is found and cropped; a box of frames of another size is scaled. A frame that
    is binary already is not thresholded again, and not cropped unless its framing clearly differs.
    Raises UserError for what is no image, and for a frame of another shape than the box is of.
    """
    raw = np.asarray(raw)
    grey = find_white_pixels(raw)
    if grey is None:
        grey = to_grey(raw, dict(view.whites).get(raw.dtype.name, 0.0))
        check_contrast(grey)
    grey = _invert(grey) if view.dark else grey
    square = crop_frame(grey, _scale_box(view, grey.shape) or _find_box(preprocess, grey))
    mask = make_mask(preprocess)
    if square.dtype == bool and len(square) == preprocess.size:
        return (square & mask).view(np.uint8) * np.uint8(255)
    # on busy cores two threads take ten times as long for products as small as these
    with _blas().limit(limits=1, user_api="blas"):
        if not is_binary(grey):
            return _binarise(np.matmul, preprocess, square)
        small = _both_sides(np.matmul, make_area_matrix(len(square), preprocess.size), square)
    white = (small >= compute_middle_level(grey)) & mask
    return white.astype(np.uint8) * np.uint8(255)


def _scale_box(view: View, frame_px: tuple[int, ...]) -> Box | None:
    """Scale the box of a view to frames of another height and width, as of another camera mode."""
    if view.box is None or view.frame_px is None or view.frame_px == frame_px:
        return view.box
    (height, width), (own_height, own_width) = view.frame_px, frame_px
    scale = own_width / width
    if abs(scale * height / own_height - 1) > MAX_ASPECT_ERROR:
        raise UserError(
            f"a frame of {own_width} x {own_height} px, but the dome was found in frames of "
            f"{width} x {height}: another part of the picture; use one camera mode for both"
        )
    left, top, right, _ = view.box
    side = round(scale * (right - left))
    left, top = round(scale * left), round(scale * top)
    return Box(left, top, left + side, top + side)


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController()  # searches for libraries: milliseconds


def _invert(grey: np.ndarray) -> np.ndarray:
    return ~grey if grey.dtype == bool else 1 - grey


def find_view(preprocess: Preprocess, raw: np.ndarray, dark: bool = False) -> View:
    """Find the crop and the white of one frame. Raises UserError for one that is not usable.

    `dark`: its markers are dark on a light ground.
    """
    grey = to_grey(raw)
    box = _find_box(preprocess, _invert(grey) if dark else grey)
    return View(box, ((raw.dtype.name, find_white_level(raw)),), grey.shape, dark)


def combine_views(views: list[View]) -> View:
    """Combine the views of some frames of one size.

    The crop is the median, since one that trembled would appear as motion. The whites are the
    brightest of each type of number, since a contrast that changed would, too.
    """
    boxes = [view.box for view in views if view.box]
    brightest: dict[str, float] = {}
    for view in views:
        for kind, white in view.whites:
            brightest[kind] = max(white, brightest.get(kind, white))
    whites = tuple(sorted(brightest.items()))
    if not boxes:
        return View(None, whites, dark=views[0].dark if views else False)
    left, top, right, bottom = np.median(boxes, axis=0)
    side = round(max(right - left, bottom - top))
    left, top = round((left + right - side) / 2), round((top + bottom - side) / 2)
    return View(Box(left, top, left + side, top + side), whites, *views[0][2:])


def _find_box(preprocess: Preprocess, grey: np.ndarray) -> Box:
    return (_frame_pins if is_binary(grey) else find_dome)(grey, preprocess.outer_pins)


def _frame_pins(grey: np.ndarray, outer_pins: float) -> Box:
    """Frame the pins of a binary frame; resampling costs it its edges, so needs a clear reason."""
    pins = _find_pin_circle(grey > compute_middle_level(grey))
    if pins is None or abs(pins.radius / outer_pins / min(grey.shape) - 1) < MAX_FRAMING_ERROR:
        return _make_middle_box(grey.shape)
    return _make_box(pins.row, pins.column, pins.radius / outer_pins)


def find_dome(grey: Float[np.ndarray, "H W"], outer_pins: float) -> Box:
    """Find the square whose side is the outermost pins' distance from its middle over `outer_pins`.

    The square follows the dark disc of the dome in a light surround; without such a disc the pins;
    without pins it is the middle square. Raises UserError for a frame of one flat grey.
    """
    check_contrast(grey)
    disc = _fit_circle(_find_disc_rim(grey))
    if disc is not None and _is_plausible(disc, grey, DISC_RADIUS_RANGE, MAX_DISC_ERROR):
        return _make_box(disc.row, disc.column, disc.radius * OUTER_PINS_OF_DISC / outer_pins)
    window = 2 * (min(grey.shape) // 14) + 1
    difference = grey - ndimage.uniform_filter(grey, window)
    pins = _find_pin_circle(difference > 0.1 * _scale_threshold(difference, where=True))
    if pins is None:
        return _make_middle_box(grey.shape)
    return _make_box(pins.row, pins.column, pins.radius / outer_pins)


def _find_disc_rim(grey: np.ndarray) -> np.ndarray:
    """Find the rim (N, 2) px, as (row, column), of the largest dark part with its holes filled."""
    dark = grey < threshold_otsu(grey)
    parts = label(dark, connectivity=1)
    disc = ndimage.binary_fill_holes(parts == 1 + np.argmax(np.bincount(parts[dark])[1:]))
    steps = max(1, min(grey.shape) // 60)
    # Without padding the opening rounds the corners of a frame that is dark all over.
    disc = np.pad(disc, steps, mode="edge")
    disc = ndimage.binary_opening(disc, iterations=steps)[steps:-steps, steps:-steps]
    rim = disc & ~ndimage.binary_erosion(disc)
    rim[[0, -1], :] = rim[:, [0, -1]] = False  # where the frame cuts the disc, its border is no rim
    return np.argwhere(rim).astype(float)


def _find_pin_circle(white: np.ndarray) -> "_Circle | None":
    """Fit a circle to the outermost of the white dots (H, W), or around them if in a rectangle.

    None if it is not plausible.
    """
    dots = _find_outer_dots(white)
    circle = _enclose_rectangle(dots) or _fit_circle(dots)
    return circle if _is_plausible(circle, white, PIN_RADIUS_RANGE, MAX_PIN_CIRCLE_ERROR) else None


def _enclose_rectangle(dots: np.ndarray) -> "_Circle | None":
    """Fit a circle around the corners of a rectangle; None if the dots (N, 2) are on none."""
    if not len(dots):
        return None
    low, high = dots.min(axis=0), dots.max(axis=0)
    row, column = (low + high) / 2
    radius = float(np.hypot(*(high - low)) / 2)
    off = np.minimum(dots - low, high - dots).min(axis=1)  # from the nearest side
    is_rectangle = off.mean() < MAX_RECTANGLE_ERROR * radius
    return _Circle(row, column, radius, 0.0) if is_rectangle else None


def _find_outer_dots(white: np.ndarray) -> np.ndarray:
    """Find the outermost (N, 2) px, as (row, column), of the white dots (H, W) of usual size."""
    parts = label(white, connectivity=1)
    area = np.bincount(parts.ravel())[1:]
    large = area[area >= MIN_DOT_PX]
    if len(large) < MIN_DOTS:
        return np.zeros((0, 2))
    usual = np.median(large)
    is_dot = (area > DOT_AREA_RANGE[0] * usual) & (area < DOT_AREA_RANGE[1] * usual)
    centres = np.array(ndimage.center_of_mass(white, parts, 1 + np.flatnonzero(is_dot)))
    centres = centres[find_clusters(centres)]
    return centres[find_hull(centres)] if len(centres) >= MIN_DOTS else np.zeros((0, 2))


class _Circle(NamedTuple):
    row: float
    column: float
    radius: float
    error: float  # median distance of the points from it


def _fit_circle(points: np.ndarray) -> _Circle | None:
    """Fit a circle to (N, 2) points by least squares, again without the worst; None for too few."""
    good = points
    for _ in range(CIRCLE_FITS):
        if len(good) < MIN_CIRCLE_POINTS:
            return None
        design = np.column_stack([2 * good, np.ones(len(good))])
        solution = np.linalg.lstsq(design, (good**2).sum(-1), rcond=None)[0]
        centre, radius = solution[:2], np.sqrt(max(solution[2] + (solution[:2] ** 2).sum(), 0.0))
        error = np.abs(np.linalg.norm(points - centre, axis=-1) - radius)
        good = points[error <= max(1.0, 2.5 * np.median(error))]
    return _Circle(float(centre[0]), float(centre[1]), float(radius), float(np.median(error)))


def _is_plausible(
    circle: _Circle | None, image: np.ndarray, radius_range: tuple[float, float], max_error: float
) -> bool:
    if circle is None:
        return False
    side = min(image.shape)
    is_sized = radius_range[0] * side < circle.radius < radius_range[1] * side
    return is_sized and circle.error <= max_error * circle.radius


def _make_box(row: float, column: float, side: float) -> Box:
    whole_side = round(side)
    left, top = round(column + 0.5 - whole_side / 2), round(row + 0.5 - whole_side / 2)
    return Box(left, top, left + whole_side, top + whole_side)


def _make_middle_box(shape: tuple[int, ...]) -> Box:
    return _make_box((shape[0] - 1) / 2, (shape[1] - 1) / 2, min(shape))


def crop_frame(grey: Shaped[np.ndarray, "H W"], box: Box) -> Shaped[np.ndarray, "S S"]:
    """Crop a square; outside the frame its border is repeated.

    A box that is not square grows about its middle. Raises UserError if it holds no pixels.
    """
    left, top, right, bottom = map(round, box)
    height, width = grey.shape
    is_empty = left >= right or top >= bottom
    if is_empty or left >= width or top >= height or right <= 0 or bottom <= 0:
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
