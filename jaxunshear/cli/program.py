"""Shared parts of all command lines: commands as data, errors in one line, files of rows.

`jaxunshear` uses it, and so do `python -m verification` and `python -m benchmarks`.
"""

import argparse
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from jaxunshear.code_version import read_source
from jaxunshear.environment import check_environment
from jaxunshear.errors import Note, UserError
from jaxunshear.files import Json, is_disk_full, write_json
from jaxunshear.output_checks import check_new_file, check_new_folder, check_outside

RESTART = "the same command begins anew"
ROWS = "the rows, with command, machine and versions"  # what `--json` writes for benchmarks
Keep = Callable[[list[Json]], None]
Commands: TypeAlias = "argparse._SubParsersAction[Any]"  # of a command line, to add one to
Option = tuple[str, dict[str, Any]]  # a name, and what argparse takes of it
HELP_ALL = "--help-all"
RARE = "is_rare"  # in an option's settings: only `--help-all` shows it
Run = Callable[[argparse.Namespace, str], int]  # arguments, command line -> exit code
_format_python_warning = warnings.formatwarning


@dataclass(frozen=True)
class Command:
    name: str
    help: str
    run: Run
    options: tuple[Option | list[Option], ...] = ()  # of those in a list only one may be given
    takes_fields: str = ""  # what it takes beside fields of an experiment, if it takes these
    is_resumable: bool = False  # continues where it stopped
    checks_out: bool = True  # --out may not lie in a run; else `run` checks it
    computes: bool = True  # results, which depend on the environment and on the code
    advice: str = ""  # below the options of its help

    def list_options(self) -> list[Option]:
        flat: list[Option] = []
        for each in self.options:
            flat += each if isinstance(each, list) else [each]
        return flat

    @property
    def has_more_help(self) -> bool:
        """Whether `--help-all` shows more than `--help`."""
        return bool(self.takes_fields) or any(RARE in each for _, each in self.list_options())

    def add_to(self, commands: Commands, help_all: bool = False) -> None:
        parser = new_parser(commands, self.name, self.help)
        if self.takes_fields:
            start = f"jaxunshear {self.name} {self.takes_fields}"
            parser.usage = f"{start} [options] [--field value ...]"
            parser.set_defaults(takes_fields=help_all)
        is_partial = self.has_more_help and not help_all
        more = f"`jaxunshear {self.name} {HELP_ALL}` shows all options." if is_partial else ""
        parser.epilog = f"{self.advice} {more}".strip()
        for each in self.options:
            parent = parser.add_mutually_exclusive_group() if isinstance(each, list) else parser
            for name, settings in each if isinstance(each, list) else [each]:
                settings = dict(settings)
                if settings.pop(RARE, False) and not help_all:
                    settings["help"] = argparse.SUPPRESS
                parent.add_argument(name, **settings)


def define_command(
    text: str, *options: Option | list[Option], name: str = "", **settings: Any
) -> Callable[[Run], Command]:
    """Make a decorator that turns a function into the command of its name, or of `name`."""
    return lambda run: Command(name or run.__name__, text, run, options, **settings)


def option(name: str, metavar: str, text: str, **settings: Any) -> Option:
    return name, {"metavar": metavar, "help": text, **settings}


def path(name: str, metavar: str, text: str, **settings: Any) -> Option:
    return option(name, metavar, text, type=_parse_path, **settings)


def _parse_path(text: str) -> Path:
    if not text:  # to Python the working folder; to a shell a variable that is not set
        raise argparse.ArgumentTypeError("names nothing")
    return Path(os.path.expanduser(text))  # shells leave `--out=~/a` as it is


def integer(name: str, text: str, default: int | None = None) -> Option:
    return option(name, "N", text, type=int, default=default)


def mark_rare(*options: Option) -> tuple[Option, ...]:
    """Mark options that few people need: `--help` leaves them out."""
    return tuple((name, settings | {RARE: True}) for name, settings in options)


def flag(name: str, text: str) -> Option:
    return name, {"action": "store_true", "help": text}


def json_file(content: str = "what was measured, with machine and versions") -> Option:
    return path("--json", "FILE", f"write {content}")


def _parse_pins(text: str) -> tuple[int, ...]:
    try:
        return tuple(map(int, text.split(",")))
    except ValueError:
        raise UserError(f"--without {text}: give numbers of pins, such as 12,40") from None


WITHOUT = option(
    "--without",
    "PIN,PIN",
    "pins that are lost, by their rows in pins.npz (default: those that no image shows)",
    type=_parse_pins,
    default=(),
)
LAYOUT = path(
    "--layout", "FILE", "a file of `jaxunshear layout`, for a sensor that is not known here"
)
DATA = path(
    "--data", "DIR", "folder of the data sets (default: datasets)", default=Path("datasets")
)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see `{self.prog} --help`")


def add_commands(parser: argparse.ArgumentParser) -> Commands:
    """Add a choice of commands to a parser, and return what each is added to."""
    return parser.add_subparsers(dest="command", metavar="COMMAND", required=True)


def new_parser(commands: Commands, name: str, text: str) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=text, description=text)


def add_json(parser: argparse.ArgumentParser, content: str) -> None:
    name, settings = json_file(content)
    parser.add_argument(name, **settings)


def parse(parser: Parser, words: Sequence[str]) -> argparse.Namespace | None:
    """Return the arguments; None after --help or --version. Raises UserError."""
    try:
        return parser.parse_args(words)
    except SystemExit:
        return None


def report_errors(work: Callable[[], int], continued: bool = False) -> int:
    """Run a program and report its errors.

    Returns what `work` returns: 0, or 1 where a check does not hold. Returns 2 after an error that
    the user can fix (one line), 128 and the signal's number when stopped by one. `continued`: the
    command goes on where it was stopped.
    """
    warnings.formatwarning = _format_warning
    warnings.simplefilter("default", Note)  # variables of Python would hide or raise it
    try:
        code = work()
        sys.stdout.flush()
        return code
    except UserError as error:
        return _print_error(str(error))
    except KeyboardInterrupt as stop:
        next_step = "run the same command to continue" if continued else RESTART
        print(f"stopped; {next_step}", file=sys.stderr)
        return 128 + (stop.args[0] if stop.args else signal.SIGINT)
    except BrokenPipeError:  # whoever read us has gone: nothing more can be said there
        return 128 + signal.SIGPIPE
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


def check_arguments(
    arguments: argparse.Namespace, computes: bool = True, checks_out: bool = True
) -> None:
    """Check the places for results, and the environment of what `computes`, before any work.

    With `checks_out` --out may not lie in a run.
    """
    _check_json(arguments)
    out = getattr(arguments, "out", None)
    if computes:
        check_new_folder(out)
        check_environment()
        read_source()  # as the code is now; it may be changed while this works
    if checks_out:
        check_outside(out, "--out")


def _check_json(arguments: argparse.Namespace) -> None:
    """Refuse a file for results that would replace what others live on."""
    file = getattr(arguments, "json", None)
    if file is None:
        return
    check_outside(file, "--json")
    check_new_file(file)
    for name, value in vars(arguments).items():
        is_other = name != "json" and isinstance(value, Path)
        if is_other and os.path.realpath(value) == os.path.realpath(file):
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
    check_arguments(arguments)
    command = shlex.join([*parser.prog.split(), *words])

    def keep(rows: list[Json]) -> None:
        write_measurement(arguments.json, command, {"rows": rows}, packages)

    return run(arguments, keep)


def write_measurement(
    file: Path | None, command: str, content: Json, packages: Sequence[str] = ()
) -> None:
    """Write `content` with command, machine and versions into `file`, if there is one."""
    if file is None:
        return
    from jaxunshear.results.provenance import describe_provenance

    write_json(file, describe_provenance(command, *packages) | content)
