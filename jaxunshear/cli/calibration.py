"""Commands that fit the simulator to recordings and compare the two."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, add_results, new_parser
from jaxunshear.errors import UserError
from jaxunshear.files import Json

COMMANDS = ("calibrate", "validate")


def add_parsers(commands: Commands) -> None:
    parser = new_parser(
        commands, "calibrate", "fit camera, pins, friction and stiffness to recordings"
    )
    parser.add_argument(
        "recordings", metavar="RECORDINGS", type=Path, help="a folder of recordings"
    )
    add_results(parser, "folder for figures")

    text = "simulate recorded contacts from their labels and compare the motion of every pin"
    parser = new_parser(commands, "validate", text)
    parser.add_argument(
        "recordings", metavar="RECORDINGS", type=Path, help="a folder of labelled recordings"
    )
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        type=Path,
        help="calibration.json of `calibrate` (default: the fitted preset)",
    )
    parser.add_argument(
        "--contacts",
        metavar="N",
        type=int,
        default=400,
        help="of each folder, at random; 0: all (400)",
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the draw (0)")
    add_results(parser, "folder for validate.png and validate.txt")


def run(arguments: argparse.Namespace, command: str) -> int:
    """Run one of COMMANDS. Return 0."""
    from jaxunshear.files import write_json
    from jaxunshear.metrics.machine import describe_provenance
    from jaxunshear.output_checks import check_not_among

    if arguments.out is not None:
        check_not_among(arguments.recordings, arguments.out, "--out")
    result = _validate(arguments) if arguments.command == "validate" else _calibrate(arguments)
    if arguments.json is not None:
        write_json(arguments.json, describe_provenance(command) | result)
    return 0


def _calibrate(arguments: argparse.Namespace) -> Json:
    from jaxunshear.calibration.calibrate import calibrate

    result = calibrate(arguments.recordings, arguments.out)
    return result | {"rows": result["rows"] + result["parameters"]}


def _validate(arguments: argparse.Namespace) -> Json:
    if arguments.contacts < 0:
        raise UserError(f"--contacts {arguments.contacts}: use 1 or more, or 0 for all")
    if arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: use 0 or more")
    from jaxunshear.calibration.calibration_result import DEFAULT_CALIBRATION, read_calibration
    from jaxunshear.calibration.validate import validate

    calibration = DEFAULT_CALIBRATION
    if arguments.calibration is not None:
        calibration = read_calibration(arguments.calibration)
    result = validate(
        arguments.recordings,
        calibration,
        arguments.contacts or None,
        arguments.seed,
        arguments.out,
    )
    return {"seed": arguments.seed, **result}
