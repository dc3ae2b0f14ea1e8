"""Judge whether an image is of the sensor that a model was made for: networks answer noise, too.

A sensor's appearance has five properties: number, spacing, radius, centre and regularity of the
pins. They are measured in the same way on its pins at rest and on an image. None of them changes
when the sensor is turned.

    expected = measure_sensor_appearance(lattice.rest, 128)
    judge_image(image, expected).plausibility  # near 1 for its images, near 0 for others
    judge_images(images, expected).reason  # "about 127 pins are found, the model's sensor has 331"
"""

import math
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxunshear.config.sensor import Preprocess
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.perception.preprocess import make_mask

MIN_PINS = 10  # below which pins have no spacing and no rim
MIN_SPACING_PX = 4.0  # below which dots and gaps are a pixel or two wide: dust, not pins
RIM_PERCENT = 95  # of the pins stand within the rim: a glint outside does not move it
EVEN_NEIGHBOURS = 4  # of a pin, whose distances show whether it stands evenly
MAX_UNEVENNESS = 0.35  # of the spacing by which such a distance may differ from it
MIN_EVEN_SHARE = 0.7  # of the expected share: with fewer even pins there is no lattice
MIN_PLAUSIBILITY = 0.5  # of an image of the sensor; also the share of such images in its folders
UNIDENTIFIED_REASON = "its pins cannot be identified for sure"
FOREIGN_REASON = "its pins do not match the model's sensor"

# Usual differences of an image of the right sensor from the expected; the units of the weights.
ALLOWED_DIFFERENCE = {"pins": 0.12, "spacing": 0.08, "rim": 0.08, "middle": 0.06, "regular": 0.1}
# Plausibility is the logistic function of LOGISTIC_BIAS less the sum over
# LOGISTIC_WEIGHTS (difference / ALLOWED_DIFFERENCE)^2, fitted to 400 images of two simulated and
# two real sensors and to 2,720 other images of 18 kinds. None of 520 images of other days, sensors
# and contacts was refused (at most 0.7 %, 95 % interval).
LOGISTIC_BIAS = 5.5
LOGISTIC_WEIGHTS = {"pins": 1.33, "spacing": 0.49, "rim": 1.43, "middle": 1.31, "regular": 0.25}

# Contacts hardly change the spacing of 331 pins: its standard deviation is 0.4 % in simulated
# images, and 0.3 to 2.1 % in recorded ones, whose means are up to 1.6 % from the resting
# pins. Of 127 pins it is 2.6 %. At 5 % the errors of `standard` are 3 to 5 times as large.
USUAL_SPACING_DIFFERENCE = 0.55  # over the root of the number of pins
HALVING_SPACING_DIFFERENCE = 0.02  # beyond the usual one: halves the confidence


@dataclass(frozen=True)
class SensorAppearance:
    """How pins appear in prepared images; lengths are shares of the image's side."""

    pins: int
    spacing: float = 0.0  # median from a pin to its three nearest; 0 if the pins are too few
    rim: float = 0.0  # radius within which RIM_PERCENT of the pins stand
    column: float = 0.0  # of the rim's centre
    row: float = 0.0
    regular: float = 0.0  # share of the pins that stand evenly


class ImageJudgement(NamedTuple):
    """What an image is judged by."""

    plausibility: float  # in [0, 1], how likely it is one of the expected sensor
    familiarity: float  # in [0, 1], less if pins are spaced otherwise: by it errors grow
    pins: np.ndarray  # (N, 2) px


@dataclass(frozen=True)
class Verdict:
    """The judgement of a sample of a folder's images."""

    ok: bool
    reason: str  # one line that says what differs; empty where `ok`
    inverted: bool  # light images with dark pins, whose inverse is the sensor's


def measure_sensor_appearance(pins_px: np.ndarray, size: int) -> SensorAppearance:
    """Measure MIN_PINS or more pins (P, 2) px as (column, row) in images of `size` px."""
    pins = np.asarray(pins_px, float)
    distance = cKDTree(pins).query(pins, k=EVEN_NEIGHBOURS + 1)[0][:, 1:]
    spacing = float(np.median(distance[:, :3]))
    low, high = np.percentile(pins, [1, 99], axis=0)
    middle = (low + high) / 2
    rim = float(np.percentile(np.hypot(*(pins - middle).T), RIM_PERCENT))
    regular = float(np.mean(np.all(np.abs(distance - spacing) <= MAX_UNEVENNESS * spacing, axis=1)))
    column, row = ((middle + 0.5) / size).tolist()
    return SensorAppearance(len(pins), spacing / size, rim / size, column, row, regular)


def measure_image(image: np.ndarray) -> tuple[SensorAppearance, np.ndarray]:
    """Measure the pins of a binary image (S, S) uint8 of {0, 255}, and return them (N, 2) px.

    Of dust none are found.
    """
    dots = ndimage.label(np.asarray(image) > 127)[1]
    if dots > (len(image) / MIN_SPACING_PX) ** 2:  # finding pins in dust takes long
        return SensorAppearance(dots), np.zeros((0, 2))
    pins = detect_pin_centres(image)
    if len(pins) < MIN_PINS:
        return SensorAppearance(len(pins)), pins
    return measure_sensor_appearance(pins, len(image)), pins


def invert_image(image: np.ndarray) -> np.ndarray:
    """Swap black and white within the circular mask; (S, S) uint8 of {0, 255}."""
    dark = make_mask(Preprocess(size=len(image))) & (np.asarray(image) <= 127)
    return np.where(dark, np.uint8(255), np.uint8(0))


def judge_image(image: np.ndarray, expected: SensorAppearance) -> ImageJudgement:
    """Judge a binary image (S, S) uint8 by its pins."""
    appearance, pins = measure_image(image)
    familiarity = _compute_familiarity(appearance, expected)
    return ImageJudgement(_score(appearance, expected), familiarity, pins)


def _compute_familiarity(appearance: SensorAppearance, expected: SensorAppearance) -> float:
    if not appearance.spacing:
        return 0.0
    difference = abs(math.log(appearance.spacing / expected.spacing))
    excess = max(difference - USUAL_SPACING_DIFFERENCE / math.sqrt(expected.pins), 0.0)
    return 1 / (1 + (excess / HALVING_SPACING_DIFFERENCE) ** 2)


def _score(appearance: SensorAppearance, expected: SensorAppearance) -> float:
    if not appearance.spacing:
        return 0.0
    differences = _compute_differences(appearance, expected)
    cost = sum(LOGISTIC_WEIGHTS[name] * value**2 for name, value in differences.items())
    return 1 / (1 + math.exp(min(cost - LOGISTIC_BIAS, 700.0)))


def _compute_differences(
    appearance: SensorAppearance, expected: SensorAppearance
) -> dict[str, float]:
    """Compute how far an image with pins is from the expected, in units of ALLOWED_DIFFERENCE."""
    differences = {
        name: math.log(getattr(appearance, name) / getattr(expected, name))
        for name in ("pins", "spacing", "rim")
    }
    differences["middle"] = math.hypot(
        appearance.column - expected.column, appearance.row - expected.row
    )
    differences["regular"] = max(expected.regular - appearance.regular, 0.0)
    return {name: value / ALLOWED_DIFFERENCE[name] for name, value in differences.items()}


def judge_images(images: np.ndarray, expected: SensorAppearance) -> Verdict:
    """Judge one or more images (N, S, S) uint8 of {0, 255} of a folder; twenty are enough."""
    appearances = [measure_image(image)[0] for image in images]
    foreign = [each for each in appearances if _score(each, expected) < MIN_PLAUSIBILITY]
    if len(foreign) <= MIN_PLAUSIBILITY * len(images):
        return Verdict(True, "", False)
    inverted = [_score_inverse(image, expected) >= MIN_PLAUSIBILITY for image in images]
    if np.mean(inverted) >= MIN_PLAUSIBILITY:
        reason = "the images are light with dark pins, the model's are dark with light pins"
        return Verdict(False, reason, True)
    return Verdict(False, _explain_difference(foreign, expected), False)


def _score_inverse(image: np.ndarray, expected: SensorAppearance) -> float:
    """Return the plausibility of the inverse, as it is or with thinner pins.

    A local threshold leaves less white around dark pins than black around light ones, so that the
    pins of the inverse touch.
    """
    inverse = invert_image(image)
    thickness = max(1, round(len(image) / 128))
    thinner = ndimage.binary_erosion(inverse, iterations=thickness) * np.uint8(255)
    return max(judge_image(each, expected).plausibility for each in (inverse, thinner))


def _explain_difference(foreign: list[SensorAppearance], expected: SensorAppearance) -> str:
    """Say what differs in refused images, by their medians."""
    usual = SensorAppearance(*np.median([astuple(each) for each in foreign], axis=0).tolist())
    if usual.pins < MIN_PINS:
        return "no pins are found"
    if not usual.spacing or usual.regular < MIN_EVEN_SHARE * expected.regular:
        return "dots are scattered, not a lattice"
    if abs(_compute_differences(usual, expected)["pins"]) <= 1:
        return (
            "the pins stand elsewhere or at another scale than the model's: crop the frames alike"
        )
    number = f"about {usual.pins:.0f} pins are found, the model's sensor has {expected.pins}"
    return f"{number}: it is another sensor, or the frames are cropped otherwise"
