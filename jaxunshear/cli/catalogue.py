"""Commands `jaxunshear sensors` and `jaxunshear stimuli`: lists and drawings."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, new_parser
from jaxunshear.errors import UserError

COMMANDS = ("sensors", "stimuli")


def add_parsers(commands: Commands) -> None:
    for name in COMMANDS:
        parser = new_parser(commands, name, f"list or draw the {name}")
        parser.add_argument("action", choices=("list", "draw"), nargs="?", default="list")
        parser.add_argument("name", metavar="NAME", nargs="?", help="what to draw")
        parser.add_argument(
            "--out",
            metavar="FILE",
            type=Path,
            help="PNG, SVG or PDF to draw to (default: NAME.png)",
        )


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear import catalogue

    if arguments.action == "list":
        if arguments.name or arguments.out:
            raise UserError(
                "`list` takes nothing more; to draw: "
                f"jaxunshear {arguments.command} draw NAME --out FILE"
            )
        print(catalogue.format_listing(arguments.command))
        return 0
    if not arguments.name:
        raise UserError(f"name what to draw: {', '.join(catalogue.list_names(arguments.command))}")
    out = arguments.out or Path(f"{arguments.name}.png")
    catalogue.draw(arguments.command, arguments.name, out)
    print(out)
    return 0
