"""The same sensor on contact rings of another spacing, and elements of that size."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import patch

from jaxunshear.settings import reach
from jaxunshear.settings.sensor import Sensor


@contextmanager
def spaced(sensor: Sensor, spacing_mm: float) -> Iterator[Sensor]:
    """The sensor to use while it lasts: under a name of its own, so that no cache mistakes it for the other."""
    if spacing_mm == reach.ring_spacing(sensor):
        yield sensor
        return
    with patch.object(reach, "RING_MM", spacing_mm), patch.object(reach, "MOST", 1000):
        yield replace(sensor, name=f"{sensor.name}-{spacing_mm:g}mm")
