"""The camera, what disturbs its frames, and how a frame becomes a binary image."""

from dataclasses import dataclass
from typing import Annotated

from jaxunshear.config.types import Bound, Fraction, Positive, Share, between

Pixels = Annotated[int, between(16, 4096)]
Housing = Annotated[
    float,
    Bound(lambda ratio: ratio >= 1, "use 1 or more: the housing lies outside the outermost pins"),
]
Offset = Annotated[
    float,
    Bound(lambda offset: -1 < offset < 1, "use a fraction of full scale between -1 and 1"),
]
OuterPins = Annotated[
    float,
    Bound(lambda share: 0 < share <= 0.5, "use a fraction of the image above 0, at most 0.5"),
]


@dataclass(frozen=True)
class Camera:
    """A pinhole on the dome's axis that sees the pins from inside, and its square grey frame.

    Both lengths are fitted to real 331-pin images: the outermost pins are at 0.375 of the width
    from the centre, and rings get closer together towards the rim (outermost gap 0.083 of that
    radius; in real images 0.08 to 0.09). A real camera is near and has a wide lens, which does
    this; a far pinhole does the same without a model of the lens.
    """

    frame_px: Pixels = 256  # side of the frame
    mm_across: Positive = 33.5  # that the frame shows, at the height of the undeformed apex pin
    distance_mm: float = 200.0  # from the undeformed apex up to the pinhole
    # radius of the dark disc within the lit housing over that of the outermost pins, in raw frames
    housing: Housing = 1.22


# shows the wider outer ring of `sensor.TACTIP_331_FLUSH` at the same place in the frame
FLUSH_CAMERA = Camera(mm_across=35.3)
# fitted to the same contacts as `sensor.TACTIP_331_FITTED`
FITTED_CAMERA = Camera(mm_across=50.72, distance_mm=66.43, housing=1.262)


@dataclass(frozen=True)
class Nuisance:
    """What a real frame shows beside its pins; zero switches a term off.

    Grey levels are fractions of full scale.
    """

    housing_ring: bool = True  # the lit housing around the dome
    specks: Annotated[int, between(0, 1000)] = 6  # mean number in a frame
    blur_px: float = 0.6  # standard deviation, frame pixels
    noise: Fraction = 0.02  # standard deviation of each pixel
    brightness: Fraction = 0.15  # largest relative change of the pins' brightness
    drift_px: float = 0.0  # largest slow shift of the entire view over a set, frame pixels
    drift_brightness: Fraction = 0.0  # relative loss of brightness over a set: wear


@dataclass(frozen=True)
class Preprocess:
    """How a simulated or a real frame becomes a binary image.

    The steps are: grey, crop, resize by area, threshold against a local mean, circular mask.
    """

    size: Pixels = 128  # output pixels, square
    block: Share = 0.15  # side of the local mean's window, as a fraction of `size` (made odd)
    # a pixel is white if it exceeds the local mean by this fraction of full scale
    offset: Offset = 0.08
    mask_radius: Share = 0.48  # of the circular mask, as a fraction of `size`
    # automatic crop: distance of the outermost pins from the centre over `size`, as in `Camera`
    outer_pins: OuterPins = 0.375
