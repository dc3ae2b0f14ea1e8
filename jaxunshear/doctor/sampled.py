"""What a few images of a recording show: their kind, whether they are negatives, and whose pins they are."""

from dataclasses import dataclass

import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.image.fitting import fit_lattice, layout_of
from jaxunshear.image.grey import is_binary, middle_level, to_grey, white_of
from jaxunshear.image.lattice import spacing_of
from jaxunshear.image.pins import Found, detect, find_pins
from jaxunshear.image.preprocess import View, common_view, own_view, prepare_frame
from jaxunshear.image.tracking import follow_all
from jaxunshear.settings.image import Preprocess
from jaxunshear.settings.sensor import TACTIP_127, TACTIP_331, Sensor

SENSORS = (TACTIP_331, TACTIP_127)
LIKE = (0.85, 1.1)  # of a sensor's pins, found: fewer or more are another sensor's
LEAST_PINS = 20  # images with fewer show none
LEAST_PX, LARGEST_PX = 32, 256  # of the prepared images, which have the size of the recorded ones between these
TRIED = 5  # images that are also seen as negatives
BINARY = "binary"
CLEARER = 1.5  # times as many pins make a negative


@dataclass(frozen=True)
class Pixels:
    kind: str  # BINARY, "grey" or "colour"
    white: float  # share, of the prepared images where the recorded ones are not binary
    negative: bool  # dark pins on a light ground


@dataclass(frozen=True)
class Pins:
    """Of the prepared images, turned positive where they are negatives."""

    images: int
    median: float
    least: int
    most: int
    pitch: float | None  # usual distance between neighbours over the side of the image
    pitch_px: float | None  # in the image as it was recorded
    sensor: str | None  # None: of no known sensor
    sure: float | None  # share of the images in which every pin's identity is sure; None without a sensor


@dataclass(frozen=True)
class Sample:
    name: str
    image: np.ndarray  # (S, S) uint8
    pins: np.ndarray  # (N, 2) px as (column, row)


@dataclass(frozen=True)
class Seen:
    pixels: Pixels
    pins: Pins
    samples: tuple[Sample, ...]


def seen(named: list[tuple[str, np.ndarray]]) -> Seen:
    """What images of one camera show, from their names and raw pixels. Raises UserError where not one of them can be prepared."""
    usable, problem = [], UserError("there are no images")
    for name, raw in named:
        try:
            own_view(Preprocess(), raw)
            usable.append((name, raw))
        except UserError as error:
            problem = error
    if not usable:
        raise problem
    raws = [raw for _, raw in usable]
    preprocess = Preprocess(size=int(np.clip(min(raws[0].shape[:2]), LEAST_PX, LARGEST_PX)))
    images, view = _prepared(preprocess, raws)
    some = raws[:: -(-len(raws) // TRIED)]
    kind = _kind(raws[0])
    white = np.mean([_white(raw) for raw in some] if kind == BINARY else np.array(images) > 127)
    pixels = Pixels(kind, float(white), _negative(preprocess, some))
    if pixels.negative:
        images, view = _prepared(preprocess, [_inverted(raw) for raw in raws])
    found = [detect(image) for image in images]
    samples = (Sample(name, image, each.pins) for (name, _), image, each in zip(usable, images, found, strict=True))
    side = view.box[2] - view.box[0] if view.box else min(raws[0].shape[:2])
    return Seen(pixels, _pins(found, preprocess.size, side), tuple(samples))


def _prepared(preprocess: Preprocess, raws: list[np.ndarray]) -> tuple[list[np.ndarray], View]:
    """Binary images (S, S), cropped alike."""
    view = common_view([own_view(preprocess, raw) for raw in raws])
    if len({raw.shape[:2] for raw in raws}) > 1:
        view = view._replace(box=None)
    return [prepare_frame(preprocess, raw, view) for raw in raws], view


def _kind(raw: np.ndarray) -> str:
    if is_binary(to_grey(raw)):
        return BINARY
    coloured = raw.ndim == 3 and raw.shape[-1] >= 3 and (raw[..., :3] != raw[..., :1]).any()
    return "colour" if coloured else "grey"


def _white(raw: np.ndarray) -> float:
    grey = to_grey(raw)
    return float(np.mean(grey > middle_level(grey)))


def _inverted(raw: np.ndarray) -> np.ndarray:
    if raw.dtype == bool:
        return ~raw
    turned = (white_of(raw) - np.minimum(raw, white_of(raw))).astype(raw.dtype)
    if raw.ndim == 3 and raw.shape[-1] in (2, 4):
        turned[..., -1] = raw[..., -1]  # opacity
    return turned


def _negative(preprocess: Preprocess, raws: list[np.ndarray]) -> bool:
    """Whether the pins of images are dark: turned round they show many more."""
    as_they_are, turned = (
        np.median([len(find_pins(image)) for image in _prepared(preprocess, some)[0]])
        for some in (raws, [_inverted(raw) for raw in raws])
    )
    return bool(turned >= LEAST_PINS and turned > CLEARER * as_they_are)


def _pins(found: list[Found], size: int, side: int) -> Pins:
    counts = [len(each.pins) for each in found]
    median = float(np.median(counts))
    pitches = [spacing_of(each.pins) / size for each in found if len(each.pins) > 1]
    pitch = float(np.median(pitches)) if pitches and median >= LEAST_PINS else None
    sensor, sure = None, None
    for known in SENSORS:
        if LIKE[0] * known.pins <= median <= LIKE[1] * known.pins:
            sure = _sure(found, known)
            sensor = None if sure is None else known.name
    pitch_px = None if pitch is None else pitch * side
    return Pins(len(found), median, min(counts), max(counts), pitch, pitch_px, sensor, sure)


def _sure(found: list[Found], sensor: Sensor) -> float | None:
    """The share of images whose pins can be distinguished, or None where they do not form the sensor's lattice."""
    try:
        lattice = fit_lattice([each.pins for each in found], layout_of(sensor))
    except UserError:
        return None
    return float(np.mean([track.sure for track in follow_all(lattice, found)]))
