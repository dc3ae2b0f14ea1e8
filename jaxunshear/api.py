"""A trained model in a few lines of Python, and what commands do with it.

>>> model = load_model("standard")
>>> for result in servo(model, [ServoTask("disk", starts=1)], ("sheared",)):
...     print(result.scores[0].mean_mm)
"""

from jaxunshear.data.recorded_pins import Pins, find_pins
from jaxunshear.downstream.geometry_scores import GeometryResult, score_geometry
from jaxunshear.downstream.object_reconstruction import ReconstructionResult, reconstruct
from jaxunshear.downstream.servo import ServoTask
from jaxunshear.downstream.servo_scores import ServoResult, servo
from jaxunshear.inference.readers import Codes, Predictions
from jaxunshear.inference.trained_model import TrainedModel, load_model

__all__ = [
    "Codes",
    "GeometryResult",
    "Pins",
    "Predictions",
    "ReconstructionResult",
    "ServoResult",
    "ServoTask",
    "TrainedModel",
    "find_pins",
    "load_model",
    "reconstruct",
    "score_geometry",
    "servo",
]
