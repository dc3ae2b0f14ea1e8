"""The notebooks run from top to bottom, and are stored as they ran."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "docs" / "notebooks").glob("*.ipynb"))


def results(notebook: nbformat.NotebookNode) -> list[bool]:
    """Whether each cell has given something beside progress."""
    outputs = [cell.get("outputs", []) for cell in notebook.cells]
    return [any(each.get("name") != "stderr" for each in some) for some in outputs]


LONG = {"identify": pytest.mark.long}  # no command takes its gradients, which compile for long
PARAMETERS = [pytest.param(path, marks=LONG.get(path.stem, ()), id=path.stem) for path in NOTEBOOKS]


@pytest.mark.parametrize("path", PARAMETERS)
def test_a_notebook_runs(path, monkeypatch, tmp_path):
    monkeypatch.delenv("MPLBACKEND")  # figures are shown, here
    notebook = nbformat.read(path, as_version=4)
    stored = results(notebook)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert stored == results(notebook), "store it as it ran"


def test_there_are_four():
    assert {path.stem for path in NOTEBOOKS} == {"contact", "identify", "sweep", "unshear"}
