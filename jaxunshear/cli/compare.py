"""Command `jaxunshear compare`: finished runs side by side."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, new_parser

COMMANDS = ("compare",)
OUT = Path("runs/compare")


def add_parsers(commands: Commands) -> None:
    text = "finished runs side by side: settings that differ, scores with intervals, times"
    parser = new_parser(commands, "compare", text)
    text = "folders of runs; the first is the reference"
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help=text)
    text = f"where the page goes ({OUT})"
    parser.add_argument("--out", metavar="DIR", type=Path, default=OUT, help=text)


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.compare import write_comparison

    text, path = write_comparison(arguments.runs, arguments.out)
    print(text)
    print(f"page: {path}")
    return 0
