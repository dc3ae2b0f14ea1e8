"""Experiments and sweeps as Python files."""

import contextlib
import runpy
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.types import check_types
from jaxunshear.errors import UserError


def load_experiment(path: str | Path) -> Experiment:
    """The variable `experiment` of the Python file `path`, of the right types but not yet validated."""
    found = load_variable(path, experiment=Experiment)
    check_types(found)
    return found


def load_variable(path: str | Path, **kinds: type) -> Any:
    """The first variable named in `kinds` that the Python file `path` defines, of that type. The file may import those beside it, and in
    the folder above. Raises `UserError`.
    """
    path = Path(path)
    variables = run_file(path)
    for name, kind in kinds.items():
        found = variables.get(name)
        if found is not None and not isinstance(found, kind):
            raise UserError(
                f"experiment file {path}: `{name}` is of type {type(found).__name__}, not {kind.__name__}"
            )
        if found is not None:
            return found
    if "sweep" in variables:
        raise UserError(
            f"experiment file {path} defines a sweep: run it with `jaxunshear sweep {path}`"
        )
    name, kind = next(iter(kinds.items()))
    raise UserError(
        f"experiment file {path} defines no variable `{name}`: add {name} = {kind.__name__}(...)"
    )


def run_file(path: Path) -> dict[str, Any]:
    """Run an experiment file and return its variables. Raises UserError.

    What it registers stays registered.
    """
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise UserError(f"experiment file {path} {problem}: name a Python file")
    try:
        with _neighbours(path):
            return runpy.run_path(str(path), run_name="jaxunshear_experiment")
    except (Exception, SystemExit) as error:
        raise UserError(f"experiment file {path} {_failure(path, error)}") from error


@contextlib.contextmanager
def _neighbours(path: Path) -> Iterator[None]:
    """Files beside `path`, and in the folder above, are modules; afterwards, files of the same names in other folders can be."""
    folder, before, places = path.resolve().parent, set(sys.modules), list(sys.path)
    sys.path[:] = [str(folder), *places, str(folder.parent)]
    try:
        yield
    finally:
        sys.path[:] = places
        for name in set(sys.modules) - before:
            if Path(getattr(sys.modules[name], "__file__", None) or "/").parent in (
                folder,
                folder.parent,
            ):
                del sys.modules[name]


def _failure(path: Path, error: BaseException) -> str:
    if "null bytes" in str(error) or "codec can't decode" in str(error):
        return "is not text: name a Python file"
    if isinstance(error, SyntaxError):
        return f"has a syntax error in line {error.lineno}: {error.msg}"
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path)
    ]
    where = f" in line {lines[-1]}" if lines else ""
    return f"fails{where}: {type(error).__name__}: {' '.join(str(error).split())}"
