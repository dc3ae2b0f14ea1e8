"""`jaxunshear compare`: finished runs side by side."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, add_json, new_parser

COMMANDS = ("compare",)
OUT = Path("runs/compare")


def add_parsers(commands: Commands) -> None:
    text = "finished runs side by side on one page: settings, figures with paired intervals, images, training"
    parser = new_parser(commands, "compare", text)
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help="folders of runs; the first is the reference")
    parser.add_argument("--out", metavar="DIR", type=Path, default=OUT, help=f"where the page goes ({OUT})")
    add_json(parser)


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.compare.making import compare
    from jaxunshear.storage import write_json

    lines, path, measured = compare(arguments.runs, arguments.out, command)
    if arguments.json is not None:
        write_json(arguments.json, measured)
    print(lines)
    print(f"page: {path}")
    return 0
