"""Rules between the settings of an experiment about recordings."""

from collections.abc import Iterator

from jaxunshear.config.data import Recorded, RecordedTaps
from jaxunshear.config.experiment import Experiment, list_trained_networks, uses_pins
from jaxunshear.config.registry import POSENET_SHEARED
from jaxunshear.config.rules_networks import (
    list_network_rules,
    list_target_rules,
    list_training_rules,
)
from jaxunshear.config.rules_simulated import FURTHER_TEST_PREFIXES
from jaxunshear.config.sensor import TACTIP_331_FITTED
from jaxunshear.config.targets import LABELLED_SLIDES, RECORDED_FIELDS, list_slide_names
from jaxunshear.config.types import Rule

# no limit: the recordings are not read yet, so the numbers of their examples are unknown
ANY_COUNT = 2**62


def list_recorded_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield the rules of an experiment about recordings, before these are read."""
    recorded = experiment.paired
    if not isinstance(recorded, Recorded) or not isinstance(experiment.pose, RecordedTaps):
        yield Rule(
            False,
            "name",
            "paired and pose are both simulated (PairedData, PoseData) "
            "or both recorded (Recorded, RecordedTaps)",
        )
        return
    yield Rule(
        recorded.pairing != "simulated" or experiment.sensor.pins == TACTIP_331_FITTED.pins,
        "paired.pairing",
        f"simulated follows the one sensor that is fitted, of {TACTIP_331_FITTED.pins} pins; "
        f"yours has {experiment.sensor.pins}",
    )
    yield Rule(
        recorded.direct_taps == "none" or POSENET_SHEARED in list_trained_networks(experiment),
        "paired.direct_taps",
        "is for posenet_sheared, which this experiment does not train: leave it at none",
    )
    yield Rule(
        recorded.direct_taps != "rendered" or uses_pins(experiment),
        "paired.direct_taps",
        "rendered is for networks over pins: use recorded",
    )
    yield from _list_recorded_target_rules(experiment, recorded)
    yield from list_network_rules(experiment, recorded.preprocess, recorded.preprocess)
    for field in ("unseen", *FURTHER_TEST_PREFIXES):
        yield Rule(
            not getattr(experiment, field),
            field,
            "is a test of simulated touches: leave it empty",
        )
    yield from list_training_rules(experiment, ANY_COUNT, ANY_COUNT)


def _list_recorded_target_rules(experiment: Experiment, recorded: Recorded) -> Iterator[Rule]:
    """Yield the rules of targets, which slides of the recordings may be among."""
    yield from list_target_rules(experiment.targets, RECORDED_FIELDS | LABELLED_SLIDES)
    slides = list_slide_names(experiment.targets)
    yield Rule(
        not slides or recorded.direct_taps != "rendered",
        "paired.direct_taps",
        f"rendered knows no {', '.join(slides)}: use recorded or none",
    )
    yield Rule(
        not slides or set(list_trained_networks(experiment)) == {POSENET_SHEARED},
        "targets",
        f"a tap has no {', '.join(slides)}: name --networks posenet_sheared alone",
    )
    yield Rule(
        not slides or not experiment.pins.turned,
        "pins.turned",
        f"does not turn {', '.join(slides)}: leave it at 0",
    )
