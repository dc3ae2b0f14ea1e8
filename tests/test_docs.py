"""Figures in the documents are those of docs/results, by the command that makes their tables."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TABLES = runpy.run_path(str(ROOT / "docs" / "make_tables.py"))["TABLES"]


@pytest.mark.parametrize(("page", "table"), [(page, table) for page, tables in TABLES.items() for table in tables])
def test_tables_are_what_the_results_say(page, table):
    made = table()
    assert len(made.splitlines()) > 3
    assert made in (ROOT / page).read_text()
