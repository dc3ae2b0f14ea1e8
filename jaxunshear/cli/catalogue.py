"""Commands `jaxunshear sensors` and `jaxunshear stimuli`: lists and drawings."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Command, path
from jaxunshear.errors import UserError


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


OPTIONS = (
    ("action", {"choices": ("list", "draw"), "nargs": "?", "default": "list"}),
    ("name", {"metavar": "NAME", "nargs": "?", "help": "what to draw"}),
    path("--out", "FILE", "PNG, SVG or PDF to draw to (default: NAME.png)"),
)
COMMANDS = tuple(
    Command(name, f"list or draw the {name}", run, OPTIONS, computes=False)
    for name in ("sensors", "stimuli")
)
