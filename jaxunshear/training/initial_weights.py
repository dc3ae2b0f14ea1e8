"""Fine-tuning, `train.start`: a training begins from weights that have not learnt its tests. Loads JAX late."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.configs import compute_fingerprint
from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import (
    Experiment,
    get_training,
    get_training_data,
    list_further_tests,
    list_required_networks,
    require_simulated,
)
from jaxunshear.config.serialization import OTHERS
from jaxunshear.data.digests import parse_folder_digests
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object
from jaxunshear.model_folders import find_model_folder


class InitialWeights(NamedTuple):
    variables: Json
    digest: str  # of these weights, kept in model.json


def start_folder(experiment: Experiment, network: str) -> Path | None:
    """Find the weights of `network` to begin from, if any. Raises UserError if they are missing or learnt the tests."""
    if not (model := get_training(experiment, network).start):
        return None
    folder = find_model_folder(Path(model)) / network
    if not (folder / "model.json").is_file():
        raise UserError(
            f"start: {folder.parent} holds no {network}: name a run or released weights that have it"
        )
    tests = {
        compute_fingerprint(test, experiment.sensor)
        for test in list_further_tests(experiment).values()
    }
    check_unseen(
        folder,
        parse_folder_digests(paired.digest)
        if isinstance(paired := experiment.paired, Recorded)
        else tests,
    )
    return folder


def list_training_digests(experiment: Experiment, network: str, start: Path | None) -> list[str]:
    """Return the digests of the data that `network` learns from, also through others and the weights in `start`."""
    if isinstance(experiment.paired, Recorded):
        own = parse_folder_digests(experiment.paired.digest)
    else:
        sets = [
            get_training_data(experiment, each)
            for each in list_required_networks(experiment, network)
        ]
        if "tap" in get_training(experiment, network).losses:
            sets.append(require_simulated(experiment, "the loss tap")[1])
        own = {compute_fingerprint(each, experiment.sensor) for each in sets}
    return sorted(own.union(read_object(start / "model.json")["data"] if start else ()))


def check_unseen(folder: Path, digests: Iterable[str]) -> None:
    """Raise UserError if the network in `folder` learnt from data of one of `digests`, or may have."""
    learnt = read_object(folder / "model.json").get("data")
    seen = ", ".join(sorted(set(digests).intersection(learnt or ())))
    if seen or learnt is None:
        of = f"data that are tested (digest {seen})" if seen else f"unknown data ({OTHERS})"
        raise UserError(f"{folder} learnt from {of}: use other weights or data")


def begin_from(fresh: Json, start: Json) -> Json:
    """Return `fresh` variables with those of `start` in their places. Raises UserError if a shape or layer differs."""
    from jax import tree

    from jaxunshear.models.weights import list_leaves

    own = list_leaves(fresh)
    modules = {name.split(".")[1] for name in own}  # E of params.E.First_0.kernel
    kept = {
        name: leaf for name, leaf in list_leaves(start).items() if name.split(".")[1] in modules
    }
    wrong = next(
        (name for name, leaf in kept.items() if name not in own or own[name].shape != leaf.shape),
        None,
    )
    if wrong or not kept:
        raise UserError(
            f"start: {wrong or 'no part'} of these weights fits the network: use that network's settings"
        )
    return tree.unflatten(tree.structure(fresh), (own | kept).values())
