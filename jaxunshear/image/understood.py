"""Whether an image is one of the sensor that a model was made for: networks answer to noise as readily as to pins.

What a sensor looks like is five numbers, read in the same way off its untouched pins and off an image: how many pins, how far apart, the
radius and the middle of their circle, and how even their neighbourhoods are. None of them changes when the sensor is turned.

    expected = expected_of(lattice.place, 128)
    plausibility(image, expected)    # near 1 for its images, near 0 for noise, other sensors and other framings
    verdict(images, expected).reason  # "about 127 pins are found in an image, the model's sensor has 331"
"""

import math
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxunshear.errors import UserError
from jaxunshear.image.pins import glance

FEWEST = 10  # pins that have a spacing and a circle worth the name
FINEST_PX = 4.0  # spacing below which dots and gaps are a pixel or two wide: dust, not pins
RIM_PERCENT = 95  # of the pins stand within the rim: a glint outside does not move it
EVEN = 0.35  # of the spacing, by which the six nearest of a pin that stands evenly may be off it
MASK = 0.48  # of the side, radius of the circular mask, as `Preprocess.mask_radius`
ENOUGH = 0.5  # plausibility of an image that is one of the sensor's, and share of them in a folder that is

# How far an image of the right sensor usually is from what is expected, at most; the units of the weights below.
ALLOWED = {"pins": 0.12, "spacing": 0.08, "rim": 0.08, "middle": 0.06, "regular": 0.15}
# plausibility = logistic(BASE - sum of WEIGHT (difference / ALLOWED)^2), by `checks.confidence.calibrate`
BASE = 5.0
WEIGHT = {"pins": 1.0, "spacing": 1.0, "rim": 1.0, "middle": 1.0, "regular": 1.0}


@dataclass(frozen=True)
class Expected:
    """What a sensor's untouched pins look like in the prepared images."""

    pins: int
    spacing: float  # from a pin to its three nearest, the median; of the image's side
    rim: float  # radius within which RIM_PERCENT of the pins stand; of the side
    middle: tuple[float, float]  # column and row of the rim's centre; of the side
    regular: float  # share of the pins whose six nearest are within EVEN of the spacing

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"middle": list(self.middle)}

    @staticmethod
    def from_json(values: dict[str, Any]) -> "Expected":
        """Raises UserError for values that `to_json` did not write."""
        try:
            known = {field.name: values[field.name] for field in fields(Expected)}
            column, row = map(float, known.pop("middle"))
            return Expected(int(known.pop("pins")), middle=(column, row), **{k: float(v) for k, v in known.items()})
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"what is expected of a sensor's images cannot be read: {error!r}") from error


@dataclass(frozen=True)
class Seen:
    """The same of one image; zeros where fewer than FEWEST pins are found."""

    pins: int
    spacing: float
    rim: float
    middle: tuple[float, float]
    regular: float
    dark: bool  # dark dots in white, going by the parts of the image and of its inverse


@dataclass(frozen=True)
class Verdict:
    """On a sample of a folder's images."""

    ok: bool
    reason: str  # one line that says what differs; empty where `ok`
    inverted: bool  # light images with dark pins, whose inverse is the sensor's


def expected_of(place_px: np.ndarray, size: int) -> Expected:
    """From the untouched pins' places (P, 2) px as (column, row) in images of `size` px. Raises ValueError for fewer than FEWEST."""
    if len(place_px) < FEWEST:
        raise ValueError(f"{len(place_px)} pins do not describe a sensor: at least {FEWEST} are needed")
    return Expected(len(place_px), *_measures(np.asarray(place_px, float), size))


def seen_of(image: np.ndarray) -> Seen:
    """Of a binary image (S, S) uint8 of {0, 255}."""
    white = np.asarray(image) > 127
    size = len(white)
    parts = ndimage.label(white)[1]
    dark = bool(ndimage.label(inverse(image))[1] > parts)
    if parts > (size / FINEST_PX) ** 2:  # looking for pins in dust takes long
        return Seen(parts, 0.0, 0.0, (0.0, 0.0), 0.0, dark)
    pins = glance(image)
    if len(pins) < FEWEST:
        return Seen(len(pins), 0.0, 0.0, (0.0, 0.0), 0.0, dark)
    return Seen(len(pins), *_measures(pins, size), dark)


def inverse(image: np.ndarray) -> np.ndarray:
    """White for black and black for white within the circular mask; (S, S) uint8 of {0, 255}."""
    return np.where(_within(len(image)) & (np.asarray(image) <= 127), np.uint8(255), np.uint8(0))


@lru_cache(maxsize=8)
def _within(size: int) -> np.ndarray:
    across = np.arange(size) - (size - 1) / 2
    return np.hypot(across[:, None], across) <= MASK * size


def _measures(pins: np.ndarray, size: int) -> tuple[float, float, tuple[float, float], float]:
    """Spacing, rim, middle and regularity of pins (N, 2) px."""
    distance = cKDTree(pins).query(pins, k=7)[0][:, 1:]
    spacing = float(np.median(distance[:, :3]))
    low, high = np.percentile(pins, [1, 99], axis=0)
    middle = (low + high) / 2
    rim = float(np.percentile(np.hypot(*(pins - middle).T), RIM_PERCENT))
    regular = float(np.mean(np.all(np.abs(distance - spacing) <= EVEN * spacing, axis=1)))
    column, row = ((middle + 0.5) / size).tolist()
    return spacing / size, rim / size, (column, row), regular


def differences(seen: Seen, expected: Expected) -> dict[str, float]:
    """How far an image with pins is from what is expected: logarithms of ratios, the way between the middles over the side, and how
    much less even it is."""
    return {
        "pins": math.log(seen.pins / expected.pins),
        "spacing": math.log(seen.spacing / expected.spacing),
        "rim": math.log(seen.rim / expected.rim),
        "middle": math.dist(seen.middle, expected.middle),
        "regular": max(expected.regular - seen.regular, 0.0),
    }


def plausibility(image: np.ndarray, expected: Expected) -> float:
    """How likely a binary image (S, S) uint8 of {0, 255} is one of this sensor's, in [0, 1]."""
    return score(seen_of(image), expected)


def score(seen: Seen, expected: Expected) -> float:
    """The same of what was seen."""
    if not seen.spacing:
        return 0.0
    costs = _costs(differences(seen, expected))
    return 1 / (1 + math.exp(min(sum(costs.values()) - BASE, 700.0)))


def _costs(off: dict[str, float]) -> dict[str, float]:
    return {name: WEIGHT[name] * (off[name] / ALLOWED[name]) ** 2 for name in WEIGHT}


def verdict(images: np.ndarray, expected: Expected) -> Verdict:
    """On images (N, S, S) uint8 of {0, 255} of one folder; twenty tell enough. Raises ValueError for none."""
    if not len(images):
        raise ValueError("no images to judge")
    seen = [seen_of(image) for image in images]
    likely = np.array([score(each, expected) for each in seen])
    if np.mean(likely >= ENOUGH) >= ENOUGH:
        return Verdict(True, "", False)
    if np.mean([each.dark for each in seen]) >= ENOUGH:
        turned = [plausibility(inverse(image), expected) for image in images]
        if np.mean(np.array(turned) >= ENOUGH) >= ENOUGH:
            return Verdict(False, "the images are light with dark pins, the model's dark with light pins", True)
    return Verdict(False, _reason([each for each, p in zip(seen, likely, strict=True) if p < ENOUGH], expected), False)


def _reason(refused: list[Seen], expected: Expected) -> str:
    """What most of the refused images have in common, by their median."""
    count = float(np.median([each.pins for each in refused]))
    if count < FEWEST:
        return "no pins are found"
    usual = {
        name: float(np.median([getattr(each, name) for each in refused if each.spacing] or [0.0]))
        for name in ("spacing", "rim", "regular")
    }
    if expected.regular - usual["regular"] > ALLOWED["regular"] or not usual["spacing"]:
        return "dots are scattered, not a lattice"
    column, row = np.median([each.middle for each in refused if each.spacing], axis=0)
    off = differences(Seen(round(count), middle=(column, row), dark=False, **usual), expected)
    costs = _costs(off)
    alike = costs["rim"] < 1
    if costs["pins"] >= 1 and (alike or costs["spacing"] < 1) and costs["middle"] < costs["pins"]:
        return f"about {count:.0f} pins are found in an image, the model's sensor has {expected.pins}"
    return ""
