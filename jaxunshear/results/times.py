"""times.json: wall-clock seconds of each stage of a run, summed over the commands that it was stopped and continued in."""

import warnings
from pathlib import Path

from jaxunshear.errors import Note, UserError
from jaxunshear.files import read_object

TIMES = "times.json"


def read_times(run_dir: Path) -> dict[str, float]:
    """By stage. A damaged file is left aside, and a note says so: times are no reason to lose the work that they measure."""
    path = Path(run_dir) / TIMES
    try:
        return read_object(path) if path.exists() else {}
    except UserError as error:
        warnings.warn(f"{error}; its times are left out", Note, stacklevel=2)
        return {}
