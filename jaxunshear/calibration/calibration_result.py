"""Calibrated sensor, camera and friction: the shipped preset, or one from a file.

calibration = read_calibration(Path("runs/calibration/calibration.json"))
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from jaxunshear.calibration.prediction import SensorValues, make_values
from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    FITTED_FRICTION,
    TACTIP_331_FITTED,
    Camera,
    Sensor,
    check_sensor,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object


@dataclass(frozen=True)
class Calibration:
    """A calibrated simulator.

    `image_names` are the images that it was fitted to, below the folder of all recordings; None
    for those of the preset.
    """

    name: str
    sensor: Sensor
    camera: Camera
    friction: float
    image_names: tuple[str, ...] | None = None

    @property
    def values(self) -> SensorValues:
        return make_values(self.sensor, self.camera, self.friction)

    @property
    def preset(self) -> Json:
        """Fields of `Sensor` and `Camera` and the friction, as `read_calibration` reads them."""
        return {
            "sensor": asdict(self.sensor),
            "camera": asdict(self.camera),
            "friction": self.friction,
        }


DEFAULT_CALIBRATION = Calibration(
    f"preset {TACTIP_331_FITTED.name}", TACTIP_331_FITTED, FITTED_CAMERA, FITTED_FRICTION
)


def read_calibration(file: Path) -> Calibration:
    """Read a `calibration.json` of `jaxunshear calibrate`. Raises `UserError` if it is none."""
    content = read_object(file)
    try:
        preset = content["preset"]
        sensor, camera = Sensor(**preset["sensor"]), Camera(**preset["camera"])
        friction = float(preset["friction"])
        image_names = tuple(str(name) for name in content.get("image_names", ()))
        check_sensor(sensor)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"--calibration {file}: {type(error).__name__} {error}: "
            "give a calibration.json of `jaxunshear calibrate --out`"
        ) from None
    return Calibration(f"calibration {file.name}", sensor, camera, friction, image_names)
