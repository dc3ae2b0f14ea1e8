"""What the same run or sweep repeats bit for bit on one machine: all but times and places."""

from dataclasses import replace

from jaxunshear.files import to_builtins
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import SweepResult

PLACES = ("time_s", "ms_per_image", "machine", "trained_on", "source", "trained_by", "command")


def select_results(results: Results) -> dict:
    return {name: value for name, value in to_builtins(results).items() if name not in PLACES}


def select_sweep(summary: SweepResult) -> SweepResult:
    """Without memory, too."""
    cells = [replace(cell, costs={}) for cell in summary.cells]
    places = dict.fromkeys(("machines", "trained_on", "sources"), ())
    return replace(summary, cells=cells, command="", efficient={}, **places)
