"""The notebooks run from top to bottom, and are stored as they ran."""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, light, monkeypatch, tmp_path):
    for name, value in light.items():
        monkeypatch.setitem(os.environ, name, value)
    notebook = nbformat.read(path, as_version=4)
    stored = [cell.get("outputs", []) for cell in notebook.cells]
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    ran = [cell.get("outputs", []) for cell in notebook.cells]
    assert [len(each) > 0 for each in stored] == [len(each) > 0 for each in ran], "store it as it ran"


def test_there_are_three():
    assert {path.stem for path in NOTEBOOKS} == {"contact", "sweep", "unshear"}
