"""Command `jaxunshear export`: a trained model as a file for a computer without JAX."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, new_parser
from jaxunshear.errors import UserError

COMMANDS = ("export",)


def add_parsers(commands: Commands) -> None:
    parser = new_parser(
        commands, "export", "a trained model as one file for a robot's computer: ONNX, or StableHLO"
    )
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        help="a finished run (runs/demo), or released weights by name (standard)",
    )
    parser.add_argument(
        "--out",
        dest="file",
        metavar="FILE",
        type=Path,
        required=True,
        help="its name ends in .onnx or .stablehlo",
    )
    parser.add_argument(
        "--batch", metavar="N", default="any", help="how many images it takes at once (any)"
    )
    parser.add_argument(
        "--preprocess",
        metavar="FRAMES",
        type=Path,
        help="the file takes frames of a camera as they come; "
        "these show their size and where the dome stands",
    )


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.apps.export.export import export_model

    batch = None
    if arguments.batch != "any":
        try:
            batch = int(arguments.batch)
        except ValueError:
            raise UserError(f"--batch {arguments.batch}: use a number, or any") from None
    export_model(arguments.model, arguments.file, batch, arguments.preprocess)
    return 0
