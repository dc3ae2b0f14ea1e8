"""Figures in the documents are those of docs/results, by the command that makes their tables."""

import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_table_on_real_skin_is_what_the_results_say():
    made = runpy.run_path(str(ROOT / "docs" / "make_tables.py"))["real_skin"]()
    assert len(made.splitlines()) == 7
    assert made in (ROOT / "README.md").read_text()
