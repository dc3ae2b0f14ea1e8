"""Which frames the networks of a model suit, by what they learnt from."""

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, uses_pins


def suits_recordings(experiment: Experiment) -> bool:
    """Say whether networks suit frames of a real camera.

    They do if they learnt from recordings, or from simulated pins drawn as other sensors and
    cameras would show them.
    """
    drawn = uses_pins(experiment) and experiment.pins.turned > 0
    return isinstance(experiment.paired, Recorded) or drawn


def learnt_note(experiment: Experiment) -> str:
    """What the networks of a model have seen, and what that means for recordings: one line, from its own settings."""
    if isinstance(experiment.paired, Recorded):
        share = (
            f", with {experiment.paired.labelled:.0%} of the slides' labels"
            if experiment.paired.labelled < 1
            else ""
        )
        return (
            f"These networks learnt from recordings of one sensor of {experiment.sensor.pins} pins{share}: another sensor, another "
            "object or another camera is another matter; score them with `jaxunshear evaluate RUN_DIR --recordings DIR`."
        )
    seen = f"These networks have seen simulated touches only (sensor {experiment.sensor.name}, {', '.join(experiment.paired.names)})"
    if suits_recordings(experiment):
        return (
            f"{seen}, drawn as other sensors and cameras would show them. What they read has a zero and a sense of its own, which a few "
            "labelled taps show (`jaxunshear evaluate MODEL --recordings DIR`); more exact are networks that learn from your own "
            "(`jaxunshear fit`)."
        )
    return f"{seen}: for recordings take the weights `skin`, or learn from your own with `jaxunshear fit`."
