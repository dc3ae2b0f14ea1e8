"""Command `jaxunshear doctor`: checks recordings."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, add_json, new_parser

COMMANDS = ("doctor",)


def add_parsers(commands: Commands) -> None:
    parser = new_parser(
        commands, "doctor", "check a folder of recordings and suggest the next command"
    )
    text = "a folder of recordings, one above several, or an image"
    parser.add_argument("path", metavar="PATH", type=Path, help=text)
    add_json(parser, "what was found, with command, machine and versions")


def run(arguments: argparse.Namespace, command: str) -> int:
    """Run the command; return 0, or 1 if no command can use the frames."""
    from jaxunshear.doctor import check_recordings, describe

    diagnosis = check_recordings(arguments.path)
    print("\n".join(describe(diagnosis)))
    if arguments.json:
        from jaxunshear.files import write_json
        from jaxunshear.metrics.machine import describe_provenance
        from jaxunshear.serialization import to_builtins

        write_json(arguments.json, describe_provenance(command) | to_builtins(diagnosis))
    return 0 if diagnosis.usable else 1
