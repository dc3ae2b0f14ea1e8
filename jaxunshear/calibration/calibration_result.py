"""A sensor, a camera and a friction that are validated together, shipped or read from a file.

known = read_calibration(Path("runs/calibration/calibration.json"))
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from jaxunshear.calibration.prediction import SensorValues, compute_modulus_ratio
from jaxunshear.config.image import FITTED_CAMERA, Camera
from jaxunshear.config.sensor import FITTED_FRICTION, TACTIP_331_FITTED, Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object


@dataclass(frozen=True)
class Calibration:
    """What is validated; `used` names the images that it was fitted to, as `Recorded.names` has them; None: those of the preset."""

    name: str
    sensor: Sensor
    camera: Camera
    friction: float
    image_names: tuple[str, ...] | None = None

    @property
    def values(self) -> SensorValues:
        camera = self.camera
        ratio = compute_modulus_ratio(self.sensor)
        return SensorValues(
            camera.mm_across,
            camera.distance_mm,
            self.sensor.pin_spacing_mm,
            self.friction,
            ratio,
            (),
            camera.housing,
        )

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
    """A `calibration.json` of `jaxunshear calibrate`. Raises `UserError` where it is none."""
    found = read_object(file)
    try:
        preset = found["preset"]
        sensor, camera = Sensor(**preset["sensor"]), Camera(**preset["camera"])
        friction, used = (
            float(preset["friction"]),
            tuple(str(name) for name in found.get("image_names", ())),
        )
        check_sensor(sensor)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"--calibration {file}: {type(error).__name__} {error}: give a calibration.json of `jaxunshear calibrate --out`"
        ) from None
    return Calibration(f"calibration {file.name}", sensor, camera, friction, used)
