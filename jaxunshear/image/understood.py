"""Whether an image is one of the sensor that a model was made for: networks answer to noise as readily as to pins.

A sensor's appearance is five numbers, read in the same way off its untouched pins and off an image: how many pins, how far apart, the
radius and the middle of their circle, and how even their neighbourhoods are. None of them changes when the sensor is turned.

    expected = expected_of(lattice.place, 128)
    plausibility(image, expected)    # near 1 for its images, near 0 for noise, other sensors and other framings
    verdict(images, expected).reason  # "about 127 pins are found in an image, the model's sensor has 331"
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxunshear.image.pins import glance
from jaxunshear.image.preprocess import mask_of
from jaxunshear.settings.image import Preprocess

FEWEST = 10  # pins that have a spacing and a circle worth the name
FINEST_PX = 4.0  # spacing below which dots and gaps are a pixel or two wide: dust, not pins
RIM_PERCENT = 95  # of the pins stand within the rim: a glint outside does not move it
NEIGHBOURS = 4  # of a pin that stands evenly are at most
EVEN = 0.35  # of the spacing off it
EVEN_ENOUGH = 0.7  # of the share expected: with fewer even pins there is no lattice
ENOUGH = 0.5  # plausibility of an image that is one of the sensor's, and share of them in a folder that is
ANY = 0.0  # in the place of ENOUGH: whatever it looks like
UNSURE = "its pins cannot be identified for sure"
STRANGE = "its pins are not those of the model's sensor"

# How far an image of the right sensor may well be from what is expected; the units of the weights below.
ALLOWED = {"pins": 0.12, "spacing": 0.08, "rim": 0.08, "middle": 0.06, "regular": 0.1}
# Plausibility is logistic(BASE - sum of WEIGHT (difference / ALLOWED)^2). Found by `benchmarks.confidence.calibrate` from 400 images of two
# simulated sensors and of two real ones, taps and slides, half of them turned, drifted and with specks, and from 2,720 strangers of 18
# kinds. Of 520 images of other days, sensors and contacts none was refused (at most 0.7 %, 95 % interval).
BASE = 5.5
WEIGHT = {"pins": 1.33, "spacing": 0.49, "rim": 1.43, "middle": 1.31, "regular": 0.25}


@dataclass(frozen=True)
class Expected:
    """How a sensor's untouched pins appear in the prepared images."""

    pins: int
    spacing: float  # from a pin to its three nearest, the median; of the image's side
    rim: float  # radius within which RIM_PERCENT of the pins stand; of the side
    middle: tuple[float, float]  # column and row of the rim's centre; of the side
    regular: float  # share of the pins that stand evenly


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
    return np.where(mask_of(Preprocess(size=len(image))) & (np.asarray(image) <= 127), np.uint8(255), np.uint8(0))


def _measures(pins: np.ndarray, size: int) -> tuple[float, float, tuple[float, float], float]:
    """Spacing, rim, middle and regularity of pins (N, 2) px."""
    distance = cKDTree(pins).query(pins, k=NEIGHBOURS + 1)[0][:, 1:]
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


def state_doubt(sure: bool, likely: float, least: float = ENOUGH) -> str:
    """Say why an image is not understood, so that it has no pose; empty where it is. All that answer images ask here.

    `sure`: its pins were identified, or the networks need none. `likely`: its plausibility; below `least` it is a stranger.
    """
    return UNSURE if not sure else STRANGE if likely < least else ""


def score(seen: Seen, expected: Expected) -> float:
    """The same of what was seen."""
    if not seen.spacing:
        return 0.0
    off = differences(seen, expected)
    cost = sum(WEIGHT[name] * (off[name] / ALLOWED[name]) ** 2 for name in ALLOWED)
    return 1 / (1 + math.exp(min(cost - BASE, 700.0)))


def verdict(images: np.ndarray, expected: Expected) -> Verdict:
    """On images (N, S, S) uint8 of {0, 255} of one folder; twenty are enough. Raises ValueError for none."""
    if not len(images):
        raise ValueError("no images to judge")
    seen = [seen_of(image) for image in images]
    likely = [score(each, expected) >= ENOUGH for each in seen]
    if np.mean(likely) >= ENOUGH:
        return Verdict(True, "", False)
    dark = [each.dark and _turned(image, expected) >= ENOUGH for image, each in zip(images, seen, strict=True)]
    if np.mean(dark) >= ENOUGH:
        return Verdict(False, "the images are light with dark pins, the model's are dark with light pins", True)
    return Verdict(False, _reason([each for each, ok in zip(seen, likely, strict=True) if not ok], expected), False)


def _turned(image: np.ndarray, expected: Expected) -> float:
    """Plausibility of the inverse, as it is or with thinner pins: around dark pins a local threshold leaves less white than around light
    ones black, so that their inverse touches."""
    turned = inverse(image)
    thinner = ndimage.binary_erosion(turned, iterations=max(1, round(len(image) / 128))) * np.uint8(255)
    return max(plausibility(turned, expected), plausibility(thinner, expected))


def _reason(refused: list[Seen], expected: Expected) -> str:
    """What differs in refused images, by their medians: what explains most first."""
    count = float(np.median([each.pins for each in refused]))
    if count < FEWEST:
        return "no pins are found"
    lattices = [each for each in refused if each.spacing]
    usual = _median(lattices) if 2 * len(lattices) > len(refused) else None
    if usual is None or usual.regular < EVEN_ENOUGH * expected.regular:
        return "dots are scattered, not a lattice"
    off = differences(usual, expected)
    far = {name: abs(off[name]) / ALLOWED[name] for name in ALLOWED}
    number = f"about {count:.0f} pins are found in an image, the model's sensor has {expected.pins}"
    if far["middle"] > 1 >= far["pins"]:
        return f"the pins' circle stands {off['middle']:.2f} of the image off the model's: crop the frames alike"
    if far["middle"] > 1 >= far["spacing"] and off["pins"] < 0:
        return f"{number}: the others are covered or out of view"
    # zoomed in, where the rim is out of view
    if min(far["pins"], far["spacing"], far["rim"]) > 1 and min(off["spacing"], off["rim"]) > 0:
        return f"pins stand {math.exp(off['spacing']):.1f} times as far apart as the model's: crop the frames alike"
    if far["pins"] > 1:
        return number
    if far["rim"] > 1:
        return f"the pins' circle fills {usual.rim:.2f} of the image, the model's {expected.rim:.2f}: crop the frames alike"
    if far["spacing"] > 1:
        return f"pins stand {math.exp(off['spacing']):.1f} times as far apart as the model's"
    return "spacing, circle and number of the pins are each a little off the model's"


def _median(seen: list[Seen]) -> Seen:
    values = [(each.pins, each.spacing, each.rim, *each.middle, each.regular) for each in seen]
    pins, spacing, rim, column, row, regular = np.median(values, axis=0).tolist()
    return Seen(round(pins), spacing, rim, (column, row), regular, dark=False)
