"""Runs in, one page out."""

import re
from collections.abc import Sequence
from pathlib import Path

from jaxunshear.compare.contacts import contacts
from jaxunshear.compare.figures import figures, rows_of
from jaxunshear.compare.page import document, lines
from jaxunshear.compare.runs import notes, read_runs, settings_apart
from jaxunshear.evaluation import spread
from jaxunshear.metrics.machine import provenance
from jaxunshear.owners import check_apart
from jaxunshear.places import check_new_folder
from jaxunshear.storage import Json, write_text

LONGEST = 100  # letters of a page's name


def compare(folders: Sequence[Path], out: Path, command: str) -> tuple[str, Path, Json]:
    """Writes out/<first>-<second>....html. Returns lines for a terminal, the page's path, and what was measured.

    Raises `UserError` where a run is not finished, damaged or named twice.
    """
    check_new_folder(out)
    check_apart(out, "--out")
    runs = read_runs(folders)
    apart, every, said = settings_apart(runs), figures(runs), notes(runs)
    name = re.sub(r"[^A-Za-z0-9._]+", "-", "-".join(run.name for run in runs))[:LONGEST]
    path = out / f"{name}.html"
    write_text(path, document(runs, apart, every, contacts(runs), said))
    measured = {
        "reference": str(runs[0].folder),
        "notes": said,
        "settings": {field: dict(zip(map(str, folders), values, strict=True)) for field, values in apart.items()},
        "rows": rows_of(runs, every),
        "spread": {"over": spread.OVER, "level": spread.LEVEL, "resamples": spread.RESAMPLES},
        **provenance(command),
    }
    return lines(runs, apart, every, said), path, measured
