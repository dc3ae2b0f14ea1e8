"""The command line: parses, calls, prints.

Every command imports what it needs when it needs it, so help is quick.
"""

import difflib
import shlex
import sys
from collections.abc import Iterable, Sequence
from textwrap import wrap

from jaxunshear import __version__
from jaxunshear.cli import apps, experiments, first_steps, models, papers, studies
from jaxunshear.cli.fields import format_field_help, split_help_request
from jaxunshear.cli.program import (
    HELP_ALL,
    Command,
    Parser,
    check_arguments,
    parse,
    report_errors,
)
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import list_field_types, parse_overrides, split_overrides
from jaxunshear.errors import UserError

COMMANDS: dict[str, Command] = {
    command.name: command
    for module in (first_steps, experiments, models, apps, studies, papers)
    for command in module.COMMANDS
}
GROUPS = {  # of `jaxunshear --help`
    "try": ("demo-data", "show"),
    "use": ("unshear", "pose", "pins", "stream", "export"),
    "train": (
        *("doctor", "layout", "fit", "run", "data"),
        *("train", "evaluate", "report", "adapt", "release"),
    ),
    "simulate": (
        *("explore", "servo", "reconstruct", "geometry", "validate", "calibrate"),
        *("sensors", "stimuli"),
    ),
    "study": ("sweep", "compare", "score", "split", "ablate", "cite"),
}
USUAL_COMMANDS = {  # what other tools, or earlier versions, call a command: what to type instead
    **dict.fromkeys(("eval", "test"), ("evaluate",)),
    **dict.fromkeys(("predict", "infer", "inference"), ("pose", "unshear")),
    **dict.fromkeys(("simulate", "generate", "dataset"), ("data",)),
    **dict.fromkeys(("check", "verify"), ("python -m verification verify",)),
    "stability": ("python -m verification stability",),
    **dict.fromkeys(("bench", "benchmark"), ("python -m benchmarks",)),
    **dict.fromkeys(("logs", "tensorboard"), ("tensorboard --logdir runs",)),
    **dict.fromkeys(("help", "version"), ("jaxunshear --help", "jaxunshear --version")),
}
FIELDS_HELP = """
fields of the experiment, such as --train.epochs 5, --paired.stimuli disk,clover, \
--train.drops 40:0.2,80:0.1;
--help-fields train (or another group) says what each takes and means, with its value in EXPERIMENT:
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see `report_errors`."""
    argv = sys.argv[1:] if argv is None else list(argv)
    command = _find_command(argv)
    return report_errors(lambda: _run(argv), continued=command is not None and command.is_resumable)


def _find_command(argv: Sequence[str]) -> Command | None:
    return COMMANDS.get(argv[0]) if argv else None


class _CommandParser(Parser):
    """Lists the fields of an experiment in the help of commands that take one."""

    def format_help(self) -> str:
        if not self.get_default("takes_fields"):
            return super().format_help()
        groups: dict[str, list[str]] = {}
        for name in list_field_types():
            group, _, field = name.rpartition(".")
            groups.setdefault(group, []).append(field)
        lines = []
        for group, names in groups.items():
            start = f"  --{group + '.' if group else ''}"
            lines += wrap(f"{start}{{{', '.join(names)}}}", 120, subsequent_indent=" " * 8)
        return super().format_help() + FIELDS_HELP + "\n".join(lines) + "\n"


class _GroupedParser(_CommandParser):
    """Lists commands in groups, a line for each."""

    def format_help(self) -> str:
        lines = [
            f"usage: {self.prog} COMMAND ...",
            "",
            self.description or "",
            "`jaxunshear COMMAND --help` shows its options.",
        ]
        for group, names in GROUPS.items():
            lines += ["", group]
            for name in names:
                text = COMMANDS[name].help
                lines += wrap(text, 100, initial_indent=f"  {name:<16}", subsequent_indent=" " * 18)
        return "\n".join(lines) + "\n"


def make_parser(help_all: bool = False) -> Parser:
    """Make the parser of all commands; `help_all`: its help shows the rare options, too."""
    parser = _GroupedParser(
        prog="jaxunshear", description="Remove shear from images of optical tactile sensors."
    )
    parser.add_argument("--version", action="version", version=f"jaxunshear {__version__}")
    parsers = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=_CommandParser
    )
    for command in COMMANDS.values():
        command.add_to(parsers, help_all)
    return parser


def _split_fields(command: Command, argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into words of the command and fields of its experiment.

    Raises UserError for a field that is unknown.
    """
    flags = {"-h", "--help", HELP_ALL}  # options that no value follows
    options = set(flags)
    for other in COMMANDS.values():
        if other.run is command.run:  # an option of these is none of the experiment's fields
            options.update(name for name, _ in other.list_options())
            flags.update(name for name, settings in other.list_options() if "action" in settings)
    words, fields = split_overrides(argv, options, flags)
    parse_overrides(fields)
    return words, fields


def read_base(argv: Sequence[str]) -> Experiment:
    """Return the experiment of a command, before it is checked or finds recordings."""
    words, fields = _split_fields(COMMANDS[argv[0]], argv)
    return experiments.read_base(make_parser().parse_args(words), fields)


def _suggest(name: str, names: Iterable[str]) -> str:
    near = USUAL_COMMANDS.get(name) or difflib.get_close_matches(name, list(names), n=1)
    return f": did you mean {' or '.join(f'`{each}`' for each in near)}?" if near else ""


def _check_names(words: Sequence[str]) -> None:
    """Refuse a command, or an option of it, that there is not; name one that is near."""
    command = _find_command(words)
    if command is None:
        if words and not words[0].startswith("-"):
            hint = _suggest(words[0], COMMANDS) or "; see `jaxunshear --help`"
            raise UserError(f"there is no command '{words[0]}'{hint}")
        return
    options = [name for name, _ in command.list_options() if name[0] == "-"]
    for word in words:
        name = word.partition("=")[0]
        if name.startswith("--") and name not in ("--", "--help", HELP_ALL, *options):
            hint = _suggest(name, options) or f"; see `jaxunshear {command.name} --help`"
            raise UserError(f"`{command.name}` takes no {name}{hint}")


def _run(argv: list[str]) -> int:
    fields: list[str] = []
    words, command = argv, _find_command(argv)
    if not argv:
        print(make_parser().format_help(), end="")
        return 0
    if command and command.takes_fields:
        request = split_help_request(argv)
        words, fields = _split_fields(command, request[1] if request else argv)
        if request:
            group, other_words = request
            experiment = read_base(other_words) if len(words) > 1 else None
            print(format_field_help(group, experiment))
            return 0
    _check_names(words)
    help_all = HELP_ALL in words
    words = ["--help" if word == HELP_ALL else word for word in words]
    arguments = parse(make_parser(help_all), words)
    if arguments is None:
        return 0
    command = COMMANDS[arguments.command]
    check_arguments(arguments, command.computes, command.checks_out)
    arguments.fields = fields
    return command.run(arguments, shlex.join(["jaxunshear", *argv]))
