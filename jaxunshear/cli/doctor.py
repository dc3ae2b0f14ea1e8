"""The command that examines recordings. Everything heavy is imported when it is needed."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, add_results, new_parser
from jaxunshear.places import check_beside

COMMANDS = ("doctor",)


def add_parsers(commands: Commands) -> None:
    text = "say what a folder of recordings is, what is broken in it, and which commands can use it"
    parser = new_parser(commands, "doctor", text)
    parser.add_argument(
        "path", metavar="PATH", type=Path, help="a folder of recordings, one above several, or an image"
    )
    add_results(parser, "for doctor.png and doctor.json", "what was found, with command, machine and versions")


def run(arguments: argparse.Namespace, command: str) -> int:
    """Runs one of COMMANDS. Returns 0, or 1 where no command can use what is there."""
    if arguments.out and arguments.path.exists():
        check_beside(arguments.path, arguments.out, "--out")
    from jaxunshear.doctor.doctor import examine, rows_of
    from jaxunshear.report.doctor_text import text_of

    diagnosis = examine(arguments.path)
    print("\n".join(text_of(diagnosis)))
    if arguments.out or arguments.json:
        from jaxunshear.metrics.machine import provenance
        from jaxunshear.storage import write_bytes, write_json

        results = provenance(command) | rows_of(diagnosis)
        if arguments.json:
            write_json(arguments.json, results)
        if arguments.out:
            from jaxunshear.report.doctor_figure import doctor_figure

            write_json(arguments.out / "doctor.json", results)
            if (figure := doctor_figure(diagnosis)) is not None:
                write_bytes(arguments.out / "doctor.png", figure)
                print(arguments.out / "doctor.png")
    return 0 if diagnosis.usable else 1
