"""Check what a network learnt from: its data set, and the initial weights of `train.start`.

Weights that have learnt the tests are refused. Loads JAX late.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.configs import list_differences
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import NetworkConfig, resolve_network
from jaxunshear.config.serialization import OLD_FILES, find_model_folder
from jaxunshear.data.sources import DataSource, open_source
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object


class InitialWeights(NamedTuple):
    variables: Json
    digest: str  # of these weights, kept in model.json


def start_folder(experiment: Experiment, network: str) -> Path | None:
    """Find the weights of `network` to begin from, if any.

    Raises UserError if they are missing or learnt the tests.
    """
    model = resolve_network(experiment, network).training.start
    if not model:
        return None
    folder = find_model_folder(Path(model)) / network
    if not (folder / "model.json").is_file():
        raise UserError(
            f"start: {folder.parent} holds no {network}: "
            "name a run or released weights that have it"
        )
    check_unseen(folder, open_source(experiment).list_test_digests())
    return folder


def list_training_digests(experiment: Experiment, network: str, start: Path | None) -> list[str]:
    """List the digests of the data that `network` learns from.

    These include the data of the networks that it needs, and of the weights in `start`.
    """
    digests = _collect_digests(open_source(experiment), resolve_network(experiment, network))
    return sorted(digests.union(read_object(start / "model.json")["data"] if start else ()))


def _collect_digests(source: DataSource, config: NetworkConfig) -> set[str]:
    digests = source.list_digests(config.source)
    if config.taps:
        digests |= source.list_digests(config.taps)
    return digests.union(*(_collect_digests(source, need) for need in config.needs))


def check_unseen(folder: Path, digests: Iterable[str]) -> None:
    """Raise UserError if the network in `folder` learnt, or may have learnt, one of `digests`."""
    learnt = read_object(folder / "model.json").get("data")
    if learnt is None:
        raise UserError(
            f"{folder} learnt from unknown data ({OLD_FILES}): use other weights or data"
        )
    common = ", ".join(sorted(set(digests).intersection(learnt)))
    if common:
        raise UserError(
            f"{folder} learnt from data that are tested (digest {common}): "
            "use other weights or data"
        )


def replace_weights(fresh: Json, start: Json) -> Json:
    """Replace `fresh` variables by those of `start`, where these have the same parts.

    Raises UserError if a shape or layer differs.
    """
    from jax import tree

    from jaxunshear.models.weights import list_leaves

    fresh_leaves = list_leaves(fresh)
    modules = {name.split(".")[1] for name in fresh_leaves}  # E of params.E.First_0.kernel
    start_leaves = {
        name: leaf for name, leaf in list_leaves(start).items() if name.split(".")[1] in modules
    }
    wrong = None if start_leaves else "no part"
    for name, leaf in start_leaves.items():
        if name not in fresh_leaves or fresh_leaves[name].shape != leaf.shape:
            wrong = name
            break
    if wrong:
        raise UserError(
            f"start: {wrong} of these weights fits the network: use that network's settings"
        )
    return tree.unflatten(tree.structure(fresh), (fresh_leaves | start_leaves).values())


def check_origin(experiment: Experiment, network: str, run_dir: Path) -> None:
    """Raise UserError if the trained `network` in `run_dir` learnt from another data set.

    That may be one of an earlier version of the data. Also raises UserError if its model.json
    cannot be read.
    """
    folder = Path(run_dir) / network
    stored = read_object(folder / "model.json").get("origin") or {}
    expected = open_source(experiment).describe_origin(resolve_network(experiment, network))
    changed = list_differences(stored, expected)
    if changed:
        raise UserError(
            f"{folder} learnt from a data set with another {', '.join(changed[:3])}: "
            "give another --out, or delete that folder"
        )
