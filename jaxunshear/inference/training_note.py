"""What a model was trained on and what its poses are relative to, in words."""

from collections.abc import Iterable

from jaxunshear.config.data import Recorded
from jaxunshear.config.sensor import Sensor

SIMULATED_POSE_FRAME = (
    "x_mm and yaw_deg are relative to the simulated stimulus' target point, "
    "edge_mm (negative inside) and edge_deg give the nearest edge in the sensor frame; "
    "recorded_* are the labels that came with the images, in their own work frame."
)
RECORDED_POSE_FRAME = (
    "Poses have the names, the frame and the units of the recorded labels "
    "that the networks learnt from."
)


def describe_recorded_training(sensor: Sensor, recorded: Recorded) -> str:
    labelled = recorded.labelled
    share = f", with {labelled:.0%} of the slides' labels" if labelled < 1 else ""
    return (
        f"These networks learnt from recordings of one sensor of {sensor.pins} pins{share}: "
        "another sensor, another object or another camera is another matter; "
        "score them with `jaxunshear evaluate RUN_DIR --recordings DIR`."
    )


def describe_simulated_training(sensor: Sensor, stimuli: Iterable[str], suits_cameras: bool) -> str:
    simulated = (
        "These networks have seen simulated touches only "
        f"(sensor {sensor.name}, {', '.join(stimuli)})"
    )
    if suits_cameras:
        return (
            f"{simulated}, drawn as other sensors and cameras would show them. "
            "What they read has a zero and a sense of its own, which a few labelled taps show "
            "(`jaxunshear evaluate MODEL --recordings DIR`); "
            "more exact are networks that learn from your own (`jaxunshear fit`)."
        )
    return (
        f"{simulated}: for recordings take the weights `skin`, "
        "or learn from your own with `jaxunshear fit`."
    )
