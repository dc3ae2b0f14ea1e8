"""The soft optical tactile sensor: a gel dome under a skin, and a camera that sees its pins.

Sensor frame: origin at the apex of the undeformed dome, z from the apex towards the camera, x and y
lateral; mm.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from jaxunshear.config.types import Bound, NotNegative, Positive, Rule, between, check_rules
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

    name: str = "tactip331"  # as `jaxunshear sensors` lists it
    # "rings": of 1, 6, 12, ... pins; "hexagonal": a triangular lattice cut to a hexagon
    layout: Literal["rings", "hexagonal"] = "rings"
    rings: Annotated[int, between(1, 50)] = 10  # of pins, around the one at the apex
    pin_spacing_mm: Positive = 1.5  # between neighbouring rings, along the dome
    pin_radius_mm: Positive = 0.45  # of a white tip
    pin_length_mm: NotNegative = 1.0  # from the skin's inner face to the white tip
    dome_radius_mm: Positive = 20.0  # outside
    skin_mm: Positive = 1.0  # thickness
    skin_modulus_mpa: Positive = 1.0  # Young's
    gel_modulus_mpa: Positive = 0.1  # Young's
    skin_poisson: Poisson = 0.49  # ratio; 0.5 would be incompressible
    gel_poisson: Poisson = 0.49  # likewise

    @property
    def pins(self) -> int:
        return 1 + 3 * self.rings * (self.rings + 1)

    def rules(self) -> Iterator[Rule]:
        for name, value in vars(self).items():
            yield Rule(not isinstance(value, float) or math.isfinite(value), name, "must be finite")
        yield Rule(
            2 * self.pin_radius_mm < self.pin_spacing_mm,
            "pin_radius_mm",
            f"pins {self.pin_spacing_mm:g} mm apart would overlap: use less than half of that",
        )
        yield Rule(
            self.skin_mm + self.pin_length_mm < self.dome_radius_mm,
            "dome_radius_mm",
            "must exceed skin_mm + pin_length_mm",
        )
        rim = self.dome_radius_mm * math.pi / 2
        yield Rule(
            self.rings * self.pin_spacing_mm < rim,
            "rings",
            f"{self.pin_spacing_mm:g} mm apart, they go past the dome's rim at {rim:.1f} mm: "
            "use fewer or closer rings",
        )


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
SENSORS = {
    sensor.name: sensor for sensor in (TACTIP_331, TACTIP_127, TACTIP_331_FLUSH, TACTIP_331_FITTED)
}


def get_sensor(name: str) -> Sensor:
    """Return the sensor of this name. Raises UserError for an unknown one."""
    if name not in SENSORS:
        raise UserError(f"sensor '{name}' is unknown: use one of {', '.join(SENSORS)}")
    return SENSORS[name]


def check_sensor(sensor: Sensor) -> None:
    """Raise UserError, naming the field, for the first value that no sensor can have."""
    check_rules(sensor, f"sensor '{sensor.name}'")
