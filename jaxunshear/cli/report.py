"""Command `jaxunshear report`: the page of a finished run."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, new_parser
from jaxunshear.errors import UserError

COMMANDS = ("report",)


def add_parsers(commands: Commands) -> None:
    parser = new_parser(commands, "report", "write the HTML page of a finished run")
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="for example runs/demo")


def run(arguments: argparse.Namespace, command: str) -> int:
    if not (arguments.run / "results.json").is_file():
        raise UserError(
            f"{arguments.run} holds no results.json: name the folder of a finished run, "
            "such as runs/demo"
        )
    from jaxunshear.report.report import write_report

    print(write_report(arguments.run))
    return 0
