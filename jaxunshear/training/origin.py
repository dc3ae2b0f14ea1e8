"""Which data set a network learnt from: it stands in its model.json. Imports no JAX."""

from pathlib import Path
from typing import Any

from jaxunshear.dataset.configs import describe, differences
from jaxunshear.dataset.settings import Recorded
from jaxunshear.errors import UserError
from jaxunshear.experiment import POSENETS, RENDERER, TEACHER, Experiment, learnt_from
from jaxunshear.storage import read_json


def origin_of(experiment: Experiment, network: str) -> dict[str, Any]:
    """The description of the data set that `network` is to learn from, and of what is made of it."""
    settings = learnt_from(experiment, network)
    described = describe(settings, experiment.sensor)
    if isinstance(settings, Recorded) and network not in ("posenet", TEACHER, RENDERER):
        described |= {"labelled": settings.labelled}
        if network not in POSENETS or settings.pairing == "simulated":
            described |= {"pairing": settings.pairing}
        if network not in POSENETS:
            described |= {"unlabelled": settings.unlabelled} if settings.unlabelled != "left_out" else {}
    return described


def check_origin(experiment: Experiment, network: str, run_dir: Path) -> None:
    """Raises UserError where the trained `network` in `run_dir` learnt from another data set, such as one of an earlier version of the
    data, or where its model.json cannot be read."""
    folder = Path(run_dir) / network
    model = read_json(folder / "model.json")
    stored = model.get("origin") if isinstance(model, dict) else None
    changed = differences(stored or {}, origin_of(experiment, network))
    if changed:
        raise UserError(
            f"{folder} learnt from a data set with another {', '.join(changed[:3])}: give another --out, or delete that folder"
        )
