"""Shared parts of all command lines: errors in one line, exit codes, files of rows.

`jaxunshear` uses it, and so do `python -m verification` and `python -m benchmarks`.
"""

import argparse
import os
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from jaxunshear.cli.options import Commands
from jaxunshear.code_version import read_source
from jaxunshear.environment import check_environment
from jaxunshear.errors import Note, UserError
from jaxunshear.files import Json, is_disk_full
from jaxunshear.output_checks import check_new_file, check_new_folder
from jaxunshear.protected_folders import check_outside

RESTART = "the same command begins anew"
Keep = Callable[[list[Json]], None]
_format_python_warning = warnings.formatwarning


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see `{self.prog} --help`")


def add_commands(parser: argparse.ArgumentParser) -> Commands:
    """Add a choice of commands to a parser, and return what each is added to."""
    return parser.add_subparsers(dest="command", metavar="COMMAND", required=True)


def report_errors(work: Callable[[], int], continued: bool = False) -> int:
    """Run a program and report its errors.

    Returns what `work` returns: 0, or 1 where a check does not hold. Returns 2 after an error that
    the user can fix (one line), 130 when interrupted. `continued`: the command goes on where it
    was stopped.
    """
    warnings.formatwarning = _format_warning
    try:
        return work()
    except UserError as error:
        return _print_error(str(error))
    except KeyboardInterrupt:
        print(
            f"stopped; {'run the same command to continue' if continued else RESTART}",
            file=sys.stderr,
        )
        return 130
    except BrokenPipeError:
        sys.stdout = None  # whoever read us has gone: nothing more can be said there
        return 141
    except Exception as error:
        if is_disk_full(error):
            return _print_error("the disk is full; free some space, then run the same command")
        if isinstance(error, OSError) and error.filename is not None:
            return _print_error(f"{error.filename}: {error.strerror}")
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            return _print_error("out of memory; use a smaller --train.batch or smaller images")
        if "Unable to initialize backend" in str(error):  # JAX names the variable and a remedy
            return _print_error(str(error))
        raise


def _format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    if issubclass(category, Note):
        return f"jaxunshear: note: {' '.join(str(message).split())}\n"
    return _format_python_warning(message, category, filename, lineno, line)


def _print_error(text: str) -> int:
    print(f"jaxunshear: error: {' '.join(text.split())}", file=sys.stderr)
    return 2


def parse(parser: Parser, words: Sequence[str]) -> argparse.Namespace | None:
    """Return the arguments; None after --help or --version. Raises UserError."""
    try:
        return parser.parse_args(words)
    except SystemExit:
        return None


def check_json(arguments: argparse.Namespace) -> None:
    """Refuse, before any work, a file for results that would replace what others live on."""
    file = getattr(arguments, "json", None)
    if file is None:
        return
    check_outside(file, "--json")
    check_new_file(file)
    for option, value in vars(arguments).items():
        if (
            option != "json"
            and isinstance(value, Path)
            and os.path.realpath(value) == os.path.realpath(file)
        ):
            raise UserError(
                f"--json {file} is also what this command reads or writes: name another file"
            )


def run_tool(
    parser: Parser,
    words: Sequence[str],
    run: Callable[[argparse.Namespace, Keep], int],
    packages: Sequence[str] = (),
) -> int:
    """Parse the words after `python -m NAME`, check what they name, and run.

    `run` is given a function that keeps rows in the file of --json, with the versions of
    `packages` beside ours. Raises UserError.
    """
    arguments = parse(parser, words)
    if arguments is None:
        return 0
    check_json(arguments)
    if "out" in arguments:
        check_new_folder(arguments.out)
        check_outside(arguments.out, "--out")
    check_environment()
    read_source()  # as the code is now; it may be changed while this works
    command = shlex.join([*parser.prog.split(), *words])
    return run(arguments, lambda rows: _write_rows(arguments.json, rows, command, packages))


def _write_rows(file: Path | None, rows: list[Json], command: str, packages: Sequence[str]) -> None:
    """Write rows into `file`, if there is one, in the place of those written before."""
    if file is None:
        return
    from jaxunshear.files import write_json
    from jaxunshear.results.provenance import describe_provenance

    write_json(file, describe_provenance(command, *packages) | {"rows": rows})
