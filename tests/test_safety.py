"""The source does not run what people's files hold, nor put their names into pages unescaped."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxunshear"
FILES = sorted(PACKAGE.rglob("*.py"))
BETWEEN_PROCESSES = {"cluster.py"}  # of our own, over a cluster
RUNS = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}


def calls(file: Path) -> Iterator[ast.Call]:
    return (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(PACKAGE).as_posix())
def test_no_file_of_a_user_is_unpickled(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import | ast.ImportFrom) and file.name not in BETWEEN_PROCESSES:
            names = (
                [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else [alias.name for alias in node.names]
            )
            assert not {name.partition(".")[0] for name in names} & RUNS
    for call in calls(file):
        assert not any(each.arg == "allow_pickle" for each in call.keywords)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(PACKAGE).as_posix())
def test_markup_is_written_here_and_what_comes_from_elsewhere_is_escaped(file):
    """Only a constant becomes HTML as it is; `format` and `join` of HTML escape their input."""
    for call in calls(file):
        if getattr(call.func, "id", getattr(call.func, "attr", "")) == "Markup" and call.args:
            assert isinstance(call.args[0], ast.Constant), f"{file}: line {call.lineno}"
