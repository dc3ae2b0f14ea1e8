"""Command `jaxunshear release`: weights with a model card."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, new_parser

COMMANDS = ("release",)


def add_parsers(commands: Commands) -> None:
    text = "make weights with a model card of a finished run, for `unshear` and `pose`"
    parser = new_parser(commands, "release", text)
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="for example runs/standard")
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="a new folder; its name is the weights'",
    )


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.release import release

    print(release(arguments.run, arguments.out))
    return 0
