"""The data set that a network learnt from: `origin` in its model.json. Imports no JAX."""

from pathlib import Path

from jaxunshear.config.configs import describe_set, list_differences
from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, get_training_data
from jaxunshear.config.registry import POSENETS, TAP_NETWORKS
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object


def describe_origin(experiment: Experiment, network: str) -> Json:
    """Describe the data set that `network` is to learn from, and how it uses that set."""
    settings = get_training_data(experiment, network)
    origin = describe_set(settings, experiment.sensor)
    if not isinstance(settings, Recorded) or network in TAP_NETWORKS:
        return origin
    origin["labelled"] = settings.labelled
    if network not in POSENETS or settings.pairing == "simulated":
        origin["pairing"] = settings.pairing
    if network not in POSENETS and settings.unlabelled != "left_out":
        origin["unlabelled"] = settings.unlabelled
    if network in POSENETS and settings.direct_taps != "none":
        origin["direct_taps"] = settings.direct_taps
    return origin


def check_origin(experiment: Experiment, network: str, run_dir: Path) -> None:
    """Raise UserError if the trained `network` in `run_dir` learnt from another data set.

    That may be one of an earlier version of the data. Also raises UserError if its model.json
    cannot be read.
    """
    folder = Path(run_dir) / network
    stored = read_object(folder / "model.json").get("origin") or {}
    changed = list_differences(stored, describe_origin(experiment, network))
    if changed:
        raise UserError(
            f"{folder} learnt from a data set with another {', '.join(changed[:3])}: "
            "give another --out, or delete that folder"
        )
