"""What the trainings of a run say of themselves, for results that rest on them."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.results.measurement import Machine, TrainingSummary
from jaxunshear.results.record_files import read_record


def read_training_facts(run_dir: Path, networks: Iterable[str]) -> Json:
    """Return on what and with which code `networks` were trained, of those that say so."""
    found = {}
    for name in networks:
        with suppress(UserError):
            found[name] = read_record(
                Path(run_dir) / name / "summary.json", TrainingSummary, "train again"
            )
    return {
        "trained_on": {
            n: one.trained_on for n, one in found.items() if one.trained_on != Machine()
        },
        "trained_by": {n: one.trained_by for n, one in found.items() if one.trained_by},
    }
