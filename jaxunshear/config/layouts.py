"""How the pins of a sensor are placed, by the name of the layout.

A marker layout is one function. In an experiment file it is registered by one line:

    @register_layout("line")
    def place_pins(sensor):  # returns (P, 2) mm of arc from the apex, on the flattened face
        return sensor.pin_spacing_mm * np.stack([np.arange(-5, 6), np.zeros(11)], axis=-1)
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from jaxunshear.config.types import claim_name


class PinSpacing(Protocol):
    """The fields of a sensor that the package's layouts use."""

    @property
    def rings(self) -> int: ...

    @property
    def pin_spacing_mm(self) -> float: ...


LayoutFunction = Callable[..., object]  # of a `Sensor`


def place_in_rings(sensor: PinSpacing) -> np.ndarray:
    """Place pins on circles of 1, 6, 12, ... around the apex."""
    points = [np.zeros((1, 2))]
    for ring in range(1, sensor.rings + 1):
        angle = 2 * np.pi * (np.arange(6 * ring) / (6 * ring))
        points.append(ring * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return sensor.pin_spacing_mm * np.concatenate(points)


def place_in_hexagon(sensor: PinSpacing) -> np.ndarray:
    """Place pins on a triangular lattice, cut to a hexagon."""
    angle = np.arange(7) * np.pi / 3
    corners = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = [np.zeros((1, 2))]
    for ring in range(1, sensor.rings + 1):
        side, along = np.divmod(6 * (np.arange(6 * ring) / (6 * ring)), 1.0)
        side, along = side.astype(int), along[:, None]
        points.append(ring * (corners[side] * (1 - along) + corners[side + 1] * along))
    return sensor.pin_spacing_mm * np.concatenate(points)


def place_in_rectangle(sensor: PinSpacing) -> np.ndarray:
    """Place pins on a square lattice, cut to a rectangle as wide as `rings` on either side."""
    across, up = sensor.rings, round(0.75 * sensor.rings)
    grid = np.meshgrid(np.arange(-across, across + 1), np.arange(-up, up + 1))
    return sensor.pin_spacing_mm * np.stack(grid, axis=-1).reshape(-1, 2)


LAYOUTS: dict[str, LayoutFunction] = {
    "rings": place_in_rings,
    "hexagonal": place_in_hexagon,
    "rectangular": place_in_rectangle,
}
PACKAGE_LAYOUTS = tuple(LAYOUTS)


def explain_layouts() -> str:
    """Explain which layouts there are, after the name of an unknown one."""
    names = ", ".join(LAYOUTS)
    return f"is unknown: use one of {names}, or name the experiment file that registers it"


def register_layout(name: str) -> Callable[[LayoutFunction], LayoutFunction]:
    """Register a function as a marker layout that a sensor can name.

    The function takes the `Sensor` and returns places (P, 2) on the flattened face, in mm of arc
    from the apex. Raises UserError if another layout has this name.
    """

    def register(place_pins: LayoutFunction) -> LayoutFunction:
        claim_name("layout", name, LAYOUTS, place_pins.__code__.co_filename)
        LAYOUTS[name] = place_pins
        return place_pins

    return register
