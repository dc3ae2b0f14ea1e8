"""The soft optical tactile sensor: a dome or pad of gel under a skin, and the camera inside.

Sensor frame: origin at the apex of the undeformed dome, or the middle of a pad's face; z from there
towards the camera, x and y lateral; mm.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from jaxunshear.config.layouts import LAYOUTS, PACKAGE_LAYOUTS, explain_layouts
from jaxunshear.config.types import (
    Bound,
    Fraction,
    NotNegative,
    Positive,
    Problem,
    Share,
    between,
    raise_first_problem,
)
from jaxunshear.errors import UserError

Poisson = Annotated[
    float,
    Bound(lambda ratio: 0 <= ratio < 0.5, "use 0 up to, but not, 0.5 (exactly incompressible)"),
]


@dataclass(frozen=True)
class Sensor:
    """A TacTip (Ward-Cherrier et al. 2018, Soft Robotics 5(2)).

    The paper's "40 mm radius" is the diameter that other papers state for the same dome, hence
    `dome_radius_mm = 20`. The moduli are those of Tango Black+ (Shore A 27, about 1 MPa) and a soft
    silicone gel; the motions of pins depend on their ratio alone.
    """

    registered: ClassVar[dict[str, type["Sensor"]]] = {}
    is_flat: ClassVar[bool] = False  # whether the face is a plane

    name: str = "tactip331"  # the sensor, as `jaxunshear sensors` lists it
    # how pins are placed: "rings", of 1, 6, 12, ... pins; "hexagonal", a triangular lattice cut to
    # a hexagon; "rectangular", a grid of three rows to four columns; or one that an experiment file
    # registers
    layout: str = "rings"
    rings: Annotated[int, between(1, 50)] = 10  # rings of pins, around the one at the apex
    pin_spacing_mm: Positive = 1.5  # from ring to ring, along the face
    pin_radius_mm: Positive = 0.45  # radius of a white tip
    pin_length_mm: NotNegative = 1.0  # length from the skin's inner face to the white tip
    dome_radius_mm: Positive = 20.0  # outer radius of the dome
    skin_mm: Positive = 1.0  # thickness of the skin
    skin_modulus_mpa: Positive = 1.0  # Young's modulus of the skin
    gel_modulus_mpa: Positive = 0.1  # Young's modulus of the gel
    skin_poisson: Poisson = 0.49  # Poisson's ratio of the skin; 0.5 would be incompressible
    gel_poisson: Poisson = 0.49  # Poisson's ratio of the gel

    @property
    def pins(self) -> int:
        return len(self.place_pins())

    @property
    def is_dark(self) -> bool:
        """Whether markers are dark on a light ground."""
        return False

    @property
    def radius_mm(self) -> float:
        """Distance of the rim from the axis."""
        return self.dome_radius_mm

    @property
    def height_mm(self) -> float:
        """Height of the rigid base above the apex."""
        return self.dome_radius_mm

    @property
    def pivot_mm(self) -> float:
        """Height above the apex of the point about which the sensor tilts: 0 for a pad."""
        return self.dome_radius_mm

    @property
    def rim_mm(self) -> float:
        """Arc from the apex to the rim."""
        return self.radius_mm * (1 if self.is_flat else math.pi / 2)

    def place_pins(self) -> np.ndarray:
        """Place the pins on the flattened face: (P, 2) mm of arc from the apex.

        Pins in rings are ordered ring by ring, each counter-clockwise from +x. Raises UserError for
        an unknown layout.
        """
        if self.layout not in LAYOUTS:
            raise UserError(f"sensor '{self.name}': layout '{self.layout}' {explain_layouts()}")
        return np.asarray(LAYOUTS[self.layout](self), float)

    def find_problems(self) -> Iterator[Problem]:
        if self.layout not in LAYOUTS:
            yield "layout", explain_layouts()
        for name, value in vars(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                yield name, "must be finite"
        spacing = self.pin_spacing_mm
        if 2 * self.pin_radius_mm >= spacing:
            remedy = f"pins {spacing:g} mm apart would overlap: use less than half of that"
            yield "pin_radius_mm", remedy
        yield from self._find_size_problems()
        places = self.place_pins()
        is_sound = places.ndim == 2 and places.shape[1:] == (2,) and np.isfinite(places).all()
        if not (is_sound and len(places)):
            yield "layout", f"must place pins at finite (P, 2) mm, not {places.shape}"
        reach = np.linalg.norm(places, axis=-1).max()
        if reach >= self.rim_mm:
            problem = f"pins {reach:.1f} mm from the apex go past the rim at {self.rim_mm:.1f} mm"
            named = "rings" if self.layout in PACKAGE_LAYOUTS else "layout"
            yield named, f"{problem}: use fewer or closer ones"

    def _find_size_problems(self) -> Iterator[Problem]:
        if self.skin_mm + self.pin_length_mm >= self.dome_radius_mm:
            yield "dome_radius_mm", "must exceed skin_mm + pin_length_mm"


@dataclass(frozen=True)
class Pad(Sensor):
    """A flat round pad of gel on a rigid plate, its markers beneath the skin.

    GelSight and DIGIT sensors have such pads, mostly rectangular ones. Sizes and moduli are our
    choice, within what is usual for them.
    """

    layout: str = "rectangular"
    rings: Annotated[int, between(1, 50)] = 7  # markers on either side of the middle one
    pin_radius_mm: Positive = 0.4  # radius of a white marker
    pin_length_mm: NotNegative = 0.0  # length from the skin's inner face to the marker
    pad_radius_mm: Positive = 16.0  # radius of the round pad
    pad_mm: Positive = 4.0  # thickness of the pad with its skin, from the face to the plate
    skin_mm: Positive = 0.5  # thickness of the skin
    skin_modulus_mpa: Positive = 0.3  # Young's modulus of the skin
    dome_radius_mm: ClassVar[float] = 0.0  # type: ignore[misc] # no setting of a pad
    is_flat: ClassVar[bool] = True

    @property
    def radius_mm(self) -> float:
        return self.pad_radius_mm

    @property
    def height_mm(self) -> float:
        return self.pad_mm

    def _find_size_problems(self) -> Iterator[Problem]:
        if self.skin_mm + self.pin_length_mm >= self.pad_mm:
            yield "pad_mm", "must exceed skin_mm + pin_length_mm"
        if self.pad_mm > self.pad_radius_mm:
            yield "pad_mm", f"use at most the pad's radius, {self.pad_radius_mm:g} mm"


@dataclass(frozen=True)
class MarkerSensor(Sensor):
    """A sensor of which a layout file alone is known: where markers rest in its images.

    It has no millimetres, so it cannot be simulated.
    """

    layout: str = "file"
    # column and row of each marker at rest, from the middle of the image, over its shorter side
    markers: tuple[tuple[float, float], ...] = ()
    dark: bool = False  # whether markers are dark on a light ground

    @property
    def is_dark(self) -> bool:
        return self.dark

    def place_pins(self) -> np.ndarray:
        """Return the markers (P, 2), in the unit of the image's shorter side."""
        return np.array(self.markers, float).reshape(-1, 2)

    def find_problems(self) -> Iterator[Problem]:
        if len(self.markers) < MIN_MARKERS:
            yield "markers", f"name at least {MIN_MARKERS}, or they cannot be distinguished"
        if len(set(self.markers)) < len(self.markers):
            yield "markers", "place each elsewhere"


MIN_MARKERS = 20
Sensor.registered |= {kind.__name__: kind for kind in (MarkerSensor, Pad, Sensor)}


def describe_sensor(sensor: Sensor) -> dict[str, object]:
    """Describe in plain JSON types everything that decides a sensor's bits."""
    fields = asdict(sensor)
    if sensor.layout in PACKAGE_LAYOUTS or isinstance(sensor, MarkerSensor):
        return fields
    # the name of another layout does not say where its function places pins
    return fields | {"places": sensor.place_pins().tolist()}


TACTIP_331 = Sensor()
TACTIP_127 = Sensor(
    name="tactip127", layout="hexagonal", rings=6, pin_spacing_mm=2.4, pin_radius_mm=0.6
)
# Pins without length: they show how the skin moves, but not how it turns.
TACTIP_331_FLUSH = replace(TACTIP_331, name="tactip331-flush", pin_length_mm=0.0)
# fitted by `jaxunshear calibrate` to 200 contacts of a real TacTip with an edge
# (docs/results/calibrate_edge_2d.json)
TACTIP_331_FITTED = replace(
    TACTIP_331,
    name="tactip331-fitted",
    pin_spacing_mm=2.18,
    pin_radius_mm=0.511,
    gel_modulus_mpa=0.00702,
)
FITTED_FRICTION = 0.386  # between that skin and that edge
GEL_PAD = Pad(name="gelpad165")
SENSORS = {
    sensor.name: sensor
    for sensor in (TACTIP_331, TACTIP_127, TACTIP_331_FLUSH, TACTIP_331_FITTED, GEL_PAD)
}


def get_sensor(name: str) -> Sensor:
    """Return the sensor of this name. Raises UserError for an unknown one."""
    if name not in SENSORS:
        raise UserError(f"sensor '{name}' is unknown: use one of {', '.join(SENSORS)}")
    return SENSORS[name]


def check_sensor(sensor: Sensor) -> None:
    """Raise UserError, naming the field, for the first value that no sensor can have."""
    if not isinstance(sensor, Sensor):
        raise UserError(f"{sensor!r} is no Sensor: `get_sensor` gives the one of a name")
    raise_first_problem(sensor, f"sensor '{sensor.name}'")


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
    mm_across: Positive = 33.5  # width of the frame, mm at the height of the undeformed apex pin
    distance_mm: float = 200.0  # from the undeformed apex up to the pinhole
    # radius of the dark disc within the lit housing over that of the outermost pins, in raw frames
    housing: Housing = 1.22


# shows the wider outer ring of TACTIP_331_FLUSH at the same place in the frame
FLUSH_CAMERA = Camera(mm_across=35.3)
# fitted to the same contacts as TACTIP_331_FITTED
FITTED_CAMERA = Camera(mm_across=50.72, distance_mm=66.43, housing=1.262)
PAD_CAMERA = Camera(mm_across=34.4)  # shows the outermost markers of GEL_PAD at the same place


@dataclass(frozen=True)
class Nuisance:
    """What a real frame shows beside its pins; zero switches a term off.

    Grey levels are fractions of full scale.
    """

    housing_ring: bool = True  # whether the lit housing around the dome shows
    specks: Annotated[int, between(0, 1000)] = 6  # mean number of bright specks in a frame
    blur_px: float = 0.6  # standard deviation of the blur, frame pixels
    noise: Fraction = 0.02  # standard deviation of the noise of each pixel
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
    # a pixel is white if it exceeds the local mean by this fraction of full scale, which shrinks
    # with the contrast of dim frames
    offset: Offset = 0.08
    mask_radius: Share = 0.48  # radius of the circular mask, as a fraction of `size`
    # automatic crop: distance of the outermost pins from the centre over `size`, as in `Camera`
    outer_pins: OuterPins = 0.375
