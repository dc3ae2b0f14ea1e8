"""Which frames the networks of a model suit, by what they were trained on."""

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment, uses_pins


def suits_recordings(experiment: Experiment) -> bool:
    """Say whether networks suit frames of a real camera.

    They do if they were trained on recordings, or on simulated pins that were drawn as other
    sensors and cameras would show them.
    """
    randomised = uses_pins(experiment) and experiment.pins.turned > 0
    return not experiment.paired.is_simulated or randomised


def describe_training(experiment: Experiment) -> str:
    """Describe in one line what a model was trained on, and what that means for recordings."""
    paired, sensor = experiment.paired, experiment.sensor
    if not isinstance(paired, PairedData):
        labelled = getattr(paired, "labelled", 1.0)
        share = f", with {labelled:.0%} of the slides' labels" if labelled < 1 else ""
        return (
            f"These networks learnt from recordings of one sensor of {sensor.pins} pins{share}: "
            "another sensor, another object or another camera is another matter; "
            "score them with `jaxunshear evaluate RUN_DIR --recordings DIR`."
        )
    simulated = (
        "These networks have seen simulated touches only "
        f"(sensor {sensor.name}, {', '.join(paired.names)})"
    )
    if suits_recordings(experiment):
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
