"""The command line: parses, calls, prints.

Every command imports what it needs when it needs it, so help is quick.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from textwrap import wrap
from types import ModuleType

from jaxunshear import __version__
from jaxunshear.cli import (
    ablate,
    applications,
    calibration,
    catalogue,
    compare,
    doctor,
    explore,
    export,
    release,
    report,
    stages,
    sweep,
    unshear,
)
from jaxunshear.cli.fields import format_field_help, split_help_request
from jaxunshear.cli.program import Parser, check_json, parse, report_errors
from jaxunshear.code_version import read_source
from jaxunshear.config.experiment import Experiment
from jaxunshear.environment import check_environment
from jaxunshear.output_checks import check_new_folder
from jaxunshear.protected_folders import check_outside

MODULES: tuple[ModuleType, ...] = (
    stages,
    report,
    compare,
    ablate,
    release,
    export,
    unshear,
    applications,
    explore,
    doctor,
    sweep,
    calibration,
    catalogue,
)
GROUPS = {  # of `jaxunshear --help`
    "use": (
        *("doctor", "fit", "run", "data", "train", "evaluate", "report", "release", "export"),
        *("unshear", "pose"),
        *("pins", "stream", "geometry", "servo", "reconstruct", "explore", "sensors", "stimuli"),
    ),
    "study": ("sweep", "compare", "ablate", "validate", "calibrate"),
}
RESUMABLE = ("run", "data", "train", "fit", "sweep", "servo")  # continue where they stopped
FIELDS_HELP = """
fields of the experiment, such as --train.epochs 5, --paired.stimuli disk,clover, \
--train.drops 40:0.2,80:0.1;
--help-fields train (or another group) says what each takes and means, with its value in FILE:
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see `report_errors`."""
    argv = sys.argv[1:] if argv is None else list(argv)
    return report_errors(lambda: _run(argv), continued=bool(argv) and argv[0] in RESUMABLE)


class _ExperimentParser(Parser):
    """Lists the fields of an experiment in the help of commands that take one."""

    def format_help(self) -> str:
        if not self.get_default("takes_fields"):
            return super().format_help()
        from jaxunshear.config.fields import list_field_types  # only for this: help must be quick

        groups: dict[str, list[str]] = {}
        for name, _ in list_field_types():
            groups.setdefault(name.rpartition(".")[0], []).append(name.rpartition(".")[2])
        lines = []
        for group, names in groups.items():
            start = f"  --{group + '.' if group else ''}"
            lines += wrap(f"{start}{{{', '.join(names)}}}", 120, subsequent_indent=" " * 8)
        return super().format_help() + FIELDS_HELP + "\n".join(lines) + "\n"


def _get_commands(parser: argparse.ArgumentParser) -> argparse._SubParsersAction:
    return next(
        action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
    )


class _GroupedParser(_ExperimentParser):
    """Lists commands in groups, a line for each."""

    def format_help(self) -> str:
        texts = {choice.dest: choice.help or "" for choice in _get_commands(self)._choices_actions}
        lines = [
            f"usage: {self.prog} COMMAND ...",
            "",
            self.description or "",
            "`COMMAND --help` says more.",
        ]
        for group, names in GROUPS.items():
            lines += ["", group]
            for name in names:
                lines += wrap(
                    texts[name], 100, initial_indent=f"  {name:<16}", subsequent_indent=" " * 18
                )
        return "\n".join(lines) + "\n"


def _make_parser() -> _ExperimentParser:
    parser = _GroupedParser(prog="jaxunshear", description="Takes the shear out of touch.")
    parser.add_argument("--version", action="version", version=f"jaxunshear {__version__}")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=_ExperimentParser
    )
    for module in MODULES:
        module.add_parsers(commands)
    return parser


def _split_fields(parser: _ExperimentParser, argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into words of the command and fields of its experiment.

    Raises UserError for a field that is unknown.
    """
    from jaxunshear.config.fields import parse_overrides, split_overrides

    options: set[str] = set()
    flags: set[str] = set()  # options that no value follows
    for name in stages.COMMANDS if argv[0] in stages.COMMANDS else sweep.COMMANDS:
        for action in _get_commands(parser).choices[name]._actions:
            options.update(action.option_strings)
            if action.nargs == 0:
                flags.update(action.option_strings)
    words, fields = split_overrides(argv, options, flags)
    parse_overrides(fields)
    return words, fields


def read_base(argv: Sequence[str]) -> Experiment:
    """Return the experiment of a command, before it is checked or finds recordings."""
    parser = _make_parser()
    words, fields = _split_fields(parser, argv)
    module = stages if argv[0] in stages.COMMANDS else sweep
    return module.read_base(parser.parse_args(words), fields)


def _run(argv: list[str]) -> int:
    fields: list[str] = []
    words = argv
    parser = _make_parser()
    if argv and argv[0] in (*stages.COMMANDS, *sweep.COMMANDS):
        request = split_help_request(argv)
        words, fields = _split_fields(parser, request[1] if request else argv)
        if request:
            group, other_words = request
            experiment = read_base(other_words) if len(words) > 1 else None
            print(format_field_help(group, experiment))
            return 0
    arguments = parse(parser, words)
    if arguments is None:
        return 0
    _check_places(arguments)
    if arguments.command not in (*catalogue.COMMANDS, *report.COMMANDS):
        check_environment()
        read_source()  # as the code is now; it may be changed while this works
    arguments.fields = fields
    module = next(module for module in MODULES if arguments.command in module.COMMANDS)
    return module.run(arguments, shlex.join(["jaxunshear", *argv]))


def _check_places(arguments: argparse.Namespace) -> None:
    """Refuse places for results that cannot be written, or that belong to a run or the like."""
    check_json(arguments)
    out = getattr(arguments, "out", None)
    if arguments.command not in catalogue.COMMANDS:
        check_new_folder(out)
    with_own_folders = (*stages.COMMANDS, *sweep.COMMANDS, *applications.COMMANDS)
    if arguments.command not in with_own_folders:
        check_outside(out, "--out")
