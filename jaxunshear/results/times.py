"""Wall-clock seconds of each stage of a run, summed over its commands, in times.json."""

import warnings
from pathlib import Path

from jaxunshear.errors import Note, UserError
from jaxunshear.files import read_object

TIMES = "times.json"


def read_times(run_dir: Path) -> dict[str, float]:
    """Read the seconds of each stage; a damaged file gives none, with a note."""
    path = Path(run_dir) / TIMES
    try:
        return read_object(path) if path.exists() else {}
    except UserError as error:
        warnings.warn(f"{error}; its times are left out", Note, stacklevel=2)
        return {}
