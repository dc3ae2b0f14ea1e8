"""Which data set a network learnt from: `origin` in its model.json. Imports no JAX."""

from pathlib import Path

from jaxunshear.config.configs import describe_set, list_differences
from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, get_training_data
from jaxunshear.config.registry import POSENETS, TAP_NETWORKS
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object


def describe_origin(experiment: Experiment, network: str) -> Json:
    """The description of the data set that `network` is to learn from, and of what is made of it."""
    settings = get_training_data(experiment, network)
    described = describe_set(settings, experiment.sensor)
    if isinstance(settings, Recorded) and network not in TAP_NETWORKS:
        described |= {"labelled": settings.labelled}
        if network not in POSENETS or settings.pairing == "simulated":
            described |= {"pairing": settings.pairing}
        if network not in POSENETS:
            described |= (
                {"unlabelled": settings.unlabelled} if settings.unlabelled != "left_out" else {}
            )
        elif settings.direct_taps != "none":
            described |= {"direct_taps": settings.direct_taps}
    return described


def check_origin(experiment: Experiment, network: str, run_dir: Path) -> None:
    """Raises UserError where the trained `network` in `run_dir` learnt from another data set, such as one of an earlier version of the
    data, or where its model.json cannot be read."""
    folder = Path(run_dir) / network
    stored = read_object(folder / "model.json").get("origin") or {}
    changed = list_differences(stored, describe_origin(experiment, network))
    if changed:
        raise UserError(
            f"{folder} learnt from a data set with another {', '.join(changed[:3])}: give another --out, or delete that folder"
        )
