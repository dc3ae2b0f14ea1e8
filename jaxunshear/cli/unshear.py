"""Commands `jaxunshear unshear` and `jaxunshear pose`: from recorded images."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import (
    SKIN,
    Commands,
    add_force,
    add_json,
    add_like,
    add_model,
    choose_exit_code,
    new_parser,
)

COMMANDS = ("unshear", "pose")


def add_parsers(commands: Commands) -> None:
    for name, text in (
        ("unshear", "take the slide out of recorded images; also predicts their poses"),
        ("pose", "predict the poses of recorded images, as they are and unsheared"),
    ):
        parser = new_parser(commands, name, text)
        parser.add_argument(
            "path", metavar="PATH", type=Path, help="an image, or a folder of recordings"
        )
        add_model(parser, SKIN)
        add_like(parser)
        add_force(parser)
        if name == "unshear":
            parser.add_argument(
                "--out", metavar="DIR", type=Path, required=True, help="for images and poses.csv"
            )
        add_json(parser)


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.inference import infer

    if arguments.command == "unshear":
        measurement = infer.unshear_recordings(
            arguments.path,
            arguments.model,
            arguments.out,
            force=arguments.force,
            like=arguments.like,
        )
    else:
        measurement = infer.predict_recordings(
            arguments.path, arguments.model, force=arguments.force, like=arguments.like
        )
    if arguments.json:
        from dataclasses import replace

        from jaxunshear.files import write_json

        write_json(arguments.json, replace(measurement, command=command))
    counts = {row.name: row.value or 0 for row in measurement.rows}
    return choose_exit_code(
        counts[f"{arguments.command}.images"], counts[f"{arguments.command}.left_out"]
    )
