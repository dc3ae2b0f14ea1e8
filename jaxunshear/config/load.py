"""Read experiments and sweeps, which are Python files."""

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
    """Return the variable `experiment` of a Python file, with its types checked, not its values."""
    experiment = load_variable(path, experiment=Experiment)
    check_types(experiment)
    return experiment


def load_variable(path: str | Path, **kinds: type) -> Any:
    """Return the first variable of a Python file that `kinds` names, of the type given there."""
    path = Path(path)
    variables = run_file(path)
    for name, kind in kinds.items():
        value = variables.get(name)
        if isinstance(value, kind):
            return value
        if value is not None:
            raise UserError(
                f"experiment file {path}: `{name}` is of type {type(value).__name__}, "
                f"not {kind.__name__}"
            )
    if "sweep" in variables:
        raise UserError(
            f"experiment file {path} defines a sweep: run it with `jaxunshear sweep {path}`"
        )
    name, kind = next(iter(kinds.items()))
    raise UserError(
        f"experiment file {path} defines no variable `{name}`: add {name} = {kind.__name__}(...)"
    )


def run_file(path: Path) -> dict[str, Any]:
    """Run an experiment file, return its variables; what it registers stays. Raises UserError."""
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "does not exist"
        near = (Path(f"{path}.py"), Path("experiments", f"{path.stem}.py"))
        hints = [f"did you mean {file}?" for file in near if file.is_file()]
        raise UserError(f"experiment file {path} {problem}: {[*hints, 'name a Python file'][0]}")
    try:
        with _import_neighbours(path):
            return runpy.run_path(str(path), run_name="jaxunshear_experiment")
    except (Exception, SystemExit) as error:
        raise UserError(f"experiment file {path} {_describe_failure(path, error)}") from error


@contextlib.contextmanager
def _import_neighbours(path: Path) -> Iterator[None]:
    """Let files beside `path`, and in the folder above, be imported, and forget them afterwards.

    Else a file of the same name in another folder could not be imported later.
    """
    folder = path.resolve().parent
    modules_before, path_before = set(sys.modules), list(sys.path)
    sys.path[:] = [str(folder), *path_before, str(folder.parent)]
    try:
        yield
    finally:
        sys.path[:] = path_before
        for name in set(sys.modules) - modules_before:
            file = Path(getattr(sys.modules[name], "__file__", None) or "/")
            if file.parent in (folder, folder.parent):
                del sys.modules[name]


def _describe_failure(path: Path, error: BaseException) -> str:
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
