"""The machines and the code of a run's trainings, for results that depend on them."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.results.measurement import Machine, TrainingSummary
from jaxunshear.results.record_files import read_record


def read_training_facts(run_dir: Path, networks: Iterable[str]) -> Json:
    """Read the machine and the code that trained each of `networks`, if its summary has them."""
    trained_on, trained_by = {}, {}
    for name in networks:
        path = Path(run_dir) / name / "summary.json"
        with suppress(UserError):
            summary = read_record(path, TrainingSummary, "train again")
            if summary.trained_on != Machine():
                trained_on[name] = summary.trained_on
            if summary.trained_by:
                trained_by[name] = summary.trained_by
    return {"trained_on": trained_on, "trained_by": trained_by}
