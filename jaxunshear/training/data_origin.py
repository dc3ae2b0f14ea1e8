"""Check the data set that a network learnt from: `origin` in its model.json. Imports no JAX."""

from pathlib import Path

from jaxunshear.config.configs import list_differences
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import read_object


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
