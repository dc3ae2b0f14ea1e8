"""Rules between the settings of an experiment about recordings, before these are read."""

from collections.abc import Iterator

from jaxunshear.config.data import Recorded, RecordedTaps
from jaxunshear.config.experiment import FURTHER_TESTS, Experiment
from jaxunshear.config.network_config import list_trained_networks
from jaxunshear.config.registry import POSENET_SHEARED
from jaxunshear.config.sensor import TACTIP_331_FITTED
from jaxunshear.config.targets import (
    LABELLED_SLIDES,
    RECORDED_FIELDS,
    list_slide_names,
    list_text_problems,
)
from jaxunshear.config.types import Rule


def list_recorded_rules(
    experiment: Experiment, recorded: Recorded, _: RecordedTaps
) -> Iterator[Rule]:
    """Yield the rules of an experiment about recordings."""
    trained = list_trained_networks(experiment)
    yield Rule(
        recorded.pairing != "simulated" or experiment.sensor.pins == TACTIP_331_FITTED.pins,
        "paired.pairing",
        f"simulated follows the one sensor that is fitted, of {TACTIP_331_FITTED.pins} pins; "
        f"yours has {experiment.sensor.pins}",
    )
    yield Rule(
        recorded.direct_taps != "rendered" or experiment.unshear.input == "pins",
        "paired.direct_taps",
        "rendered is for networks over pins: use recorded",
    )
    yield Rule(
        not (experiment.pins.turned and experiment.pins.direct_convolved),
        "pins.direct_convolved",
        "takes recorded pins as they are: leave pins.turned at 0",
    )
    yield Rule(
        experiment.train_pins.paired_share == 1,
        "train_pins.paired_share",
        "is for simulated pairs: use paired.labelled",
    )
    for field in ("unseen", *FURTHER_TESTS):
        yield Rule(
            not getattr(experiment, field),
            field,
            "is a test of simulated touches: leave it empty",
        )
    for problem in list_text_problems(experiment.targets, RECORDED_FIELDS | LABELLED_SLIDES):
        yield Rule(False, "targets", problem)
    if slides := ", ".join(list_slide_names(experiment.targets)):
        yield Rule(
            recorded.direct_taps != "rendered",
            "paired.direct_taps",
            f"rendered knows no {slides}: use recorded or none",
        )
        yield Rule(
            set(trained) == {POSENET_SHEARED},
            "targets",
            f"a tap has no {slides}: name --networks posenet_sheared alone",
        )
        yield Rule(
            not experiment.pins.turned,
            "pins.turned",
            f"does not turn {slides}: leave it at 0",
        )
