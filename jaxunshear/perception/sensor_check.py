"""Judge whether an image is of the sensor that a model was made for: networks answer noise, too.

A sensor's appearance is five numbers, measured in the same way on its untouched pins and on an image.
None of them changes when the sensor is turned.

    expected = measure_sensor_appearance(lattice.place, 128)
    compute_plausibility(image, expected)    # near 1 for its images, near 0 for noise and other sensors
    judge_images(images, expected).reason  # "about 127 pins are found, the model's sensor has 331"
"""

import math
from dataclasses import astuple, dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxunshear.config.image import Preprocess
from jaxunshear.perception.pin_detection import detect_pins_fast
from jaxunshear.perception.preprocess import make_mask

MIN_PINS = 10  # pins that have a spacing and a circle worth the name
MIN_SPACING_PX = 4.0  # spacing below which dots and gaps are a pixel or two wide: dust, not pins
RIM_PERCENT = 95  # of the pins stand within the rim: a glint outside does not move it
NEIGHBOURS = 4  # of a pin that stands evenly are at most
MAX_UNEVENNESS = 0.35  # of the spacing off it
MIN_EVEN_SHARE = 0.7  # of the share expected: with fewer even pins there is no lattice
MIN_PLAUSIBILITY = (
    0.5  # plausibility of an image of the sensor, and share of such images in its folders
)
NO_MINIMUM = 0.0  # in the place of ENOUGH: whatever the image shows
UNIDENTIFIED_REASON = "its pins cannot be identified for sure"
FOREIGN_REASON = "its pins are not those of the model's sensor"

# How far an image of the right sensor may well be from what is expected; the units of the weights.
ALLOWED_DIFFERENCE = {"pins": 0.12, "spacing": 0.08, "rim": 0.08, "middle": 0.06, "regular": 0.1}
# Plausibility is logistic(BASE - sum of WEIGHT (difference / ALLOWED)^2), fitted to 400 images of two
# simulated and two real sensors and to 2,720 other images of 18 kinds. None of 520 images of other
# days, sensors and contacts was refused (at most 0.7 %, 95 % interval).
LOGISTIC_BIAS = 5.5
LOGISTIC_WEIGHTS = {"pins": 1.33, "spacing": 0.49, "rim": 1.43, "middle": 1.31, "regular": 0.25}


@dataclass(frozen=True)
class SensorAppearance:
    """How pins appear in prepared images; lengths are shares of the image's side."""

    pins: int
    spacing: float = (
        0.0  # from a pin to its three nearest, the median; 0 where there are too few pins
    )
    rim: float = 0.0  # radius within which RIM_PERCENT of the pins stand
    column: float = 0.0  # of the rim's centre
    row: float = 0.0
    regular: float = 0.0  # share of the pins that stand evenly


@dataclass(frozen=True)
class Verdict:
    """The judgement of a sample of a folder's images."""

    ok: bool
    reason: str  # one line that says what differs; empty where `ok`
    inverted: bool  # light images with dark pins, whose inverse is the sensor's


def measure_sensor_appearance(place_px: np.ndarray, size: int) -> SensorAppearance:
    """Measure pins (P, 2) px as (column, row) in images of `size` px, of FEWEST or more."""
    pins = np.asarray(place_px, float)
    if len(pins) < MIN_PINS:
        raise ValueError(
            f"{len(pins)} pins do not describe a sensor: at least {MIN_PINS} are needed"
        )
    distance = cKDTree(pins).query(pins, k=NEIGHBOURS + 1)[0][:, 1:]
    spacing = float(np.median(distance[:, :3]))
    low, high = np.percentile(pins, [1, 99], axis=0)
    middle = (low + high) / 2
    rim = float(np.percentile(np.hypot(*(pins - middle).T), RIM_PERCENT))
    regular = float(np.mean(np.all(np.abs(distance - spacing) <= MAX_UNEVENNESS * spacing, axis=1)))
    column, row = ((middle + 0.5) / size).tolist()
    return SensorAppearance(len(pins), spacing / size, rim / size, column, row, regular)


def measure_image_appearance(image: np.ndarray) -> SensorAppearance:
    """Measure the pins of a binary image (S, S) uint8 of {0, 255}."""
    parts = ndimage.label(np.asarray(image) > 127)[1]
    if parts > (len(image) / MIN_SPACING_PX) ** 2:  # finding pins in dust takes long
        return SensorAppearance(parts)
    pins = detect_pins_fast(image)
    return (
        measure_sensor_appearance(pins, len(image))
        if len(pins) >= MIN_PINS
        else SensorAppearance(len(pins))
    )


def invert_image(image: np.ndarray) -> np.ndarray:
    """Swap black and white within the circular mask; (S, S) uint8 of {0, 255}."""
    dark = make_mask(Preprocess(size=len(image))) & (np.asarray(image) <= 127)
    return np.where(dark, np.uint8(255), np.uint8(0))


def compute_plausibility(image: np.ndarray, expected: SensorAppearance) -> float:
    """Return how likely a binary image (S, S) uint8 is one of this sensor's, in [0, 1]."""
    return _score(measure_image_appearance(image), expected)


def _score(seen: SensorAppearance, expected: SensorAppearance) -> float:
    if not seen.spacing:
        return 0.0
    cost = sum(
        LOGISTIC_WEIGHTS[name] * far**2 for name, far in _differences(seen, expected).items()
    )
    return 1 / (1 + math.exp(min(cost - LOGISTIC_BIAS, 700.0)))


def _differences(seen: SensorAppearance, expected: SensorAppearance) -> dict[str, float]:
    """Give how far an image with pins is from what is expected, in units of ALLOWED."""
    ratios = ("pins", "spacing", "rim")
    off = {name: math.log(getattr(seen, name) / getattr(expected, name)) for name in ratios}
    off["middle"] = math.hypot(seen.column - expected.column, seen.row - expected.row)
    off["regular"] = max(expected.regular - seen.regular, 0.0)
    return {name: value / ALLOWED_DIFFERENCE[name] for name, value in off.items()}


def explain_rejection(
    identified: bool, plausibility: float, min_plausibility: float = MIN_PLAUSIBILITY
) -> str:
    """Say why an image is not understood, so that it has no pose; empty where it is.

    All that answer images ask here. `identified`: its pins were identified, or the networks need none.
    `plausibility`: its plausibility, which must be `min_plausibility` or more.
    """
    return (
        UNIDENTIFIED_REASON
        if not identified
        else FOREIGN_REASON
        if plausibility < min_plausibility
        else ""
    )


def judge_images(images: np.ndarray, expected: SensorAppearance) -> Verdict:
    """Judge images (N, S, S) uint8 of {0, 255} of one folder; twenty are enough."""
    if not len(images):
        raise ValueError("no images to judge")
    seen = [measure_image_appearance(image) for image in images]
    strange = [each for each in seen if _score(each, expected) < MIN_PLAUSIBILITY]
    if len(strange) <= MIN_PLAUSIBILITY * len(images):
        return Verdict(True, "", False)
    if (
        np.mean([_score_inverted(image, expected) >= MIN_PLAUSIBILITY for image in images])
        >= MIN_PLAUSIBILITY
    ):
        reason = "the images are light with dark pins, the model's are dark with light pins"
        return Verdict(False, reason, True)
    return Verdict(False, _reason(strange, expected), False)


def _score_inverted(image: np.ndarray, expected: SensorAppearance) -> float:
    """Return the plausibility of the inverse, as it is or with thinner pins.

    A local threshold leaves less white around dark pins than black around light ones, so that the
    pins of the inverse touch.
    """
    turned = invert_image(image)
    thinner = ndimage.binary_erosion(turned, iterations=max(1, round(len(image) / 128))) * np.uint8(
        255
    )
    return max(compute_plausibility(turned, expected), compute_plausibility(thinner, expected))


def _reason(strange: list[SensorAppearance], expected: SensorAppearance) -> str:
    """Say what differs in refused images, by their medians."""
    usual = SensorAppearance(*np.median([astuple(each) for each in strange], axis=0).tolist())
    if usual.pins < MIN_PINS:
        return "no pins are found"
    if not usual.spacing or usual.regular < MIN_EVEN_SHARE * expected.regular:
        return "dots are scattered, not a lattice"
    if abs(_differences(usual, expected)["pins"]) <= 1:
        return (
            "the pins stand elsewhere or at another scale than the model's: crop the frames alike"
        )
    number = f"about {usual.pins:.0f} pins are found, the model's sensor has {expected.pins}"
    return f"{number}: it is another sensor, or the frames are cropped otherwise"
