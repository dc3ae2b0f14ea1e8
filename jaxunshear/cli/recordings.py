"""Commands about recordings: doctor, calibrate, validate."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import ROWS, Command, integer, json_file, path
from jaxunshear.errors import UserError
from jaxunshear.files import Json


def doctor(arguments: argparse.Namespace, command: str) -> int:
    """Run the command; return 0, or 1 if no command can use the frames."""
    from jaxunshear.doctor import check_recordings, describe
    from jaxunshear.serialization import to_builtins

    diagnosis = check_recordings(arguments.path)
    print("\n".join(describe(diagnosis)))
    _write_json(arguments.json, command, to_builtins(diagnosis))
    return 0 if diagnosis.usable else 1


def calibrate(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.calibration.calibrate import calibrate

    _check_out(arguments)
    result = calibrate(arguments.recordings, arguments.out)
    _write_json(arguments.json, command, result | {"rows": result["rows"] + result["parameters"]})
    return 0


def validate(arguments: argparse.Namespace, command: str) -> int:
    _check_out(arguments)
    if arguments.contacts < 0:
        raise UserError(f"--contacts {arguments.contacts}: use 1 or more, or 0 for all")
    if arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: use 0 or more")
    from jaxunshear.calibration.prediction import DEFAULT_CALIBRATION, read_calibration
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
    _write_json(arguments.json, command, {"seed": arguments.seed, **result})
    return 0


def _check_out(arguments: argparse.Namespace) -> None:
    from jaxunshear.output_checks import check_not_among

    if arguments.out is not None:
        check_not_among(arguments.recordings, arguments.out, "--out")


def _write_json(file: Path | None, command: str, content: Json) -> None:
    if file is not None:
        from jaxunshear.files import write_json
        from jaxunshear.results.provenance import describe_provenance

        write_json(file, describe_provenance(command) | content)


COMMANDS = (
    Command(
        "doctor",
        "check a folder of recordings and suggest the next command",
        doctor,
        (
            path("path", "PATH", "a folder of recordings, one above several, or an image"),
            json_file("what was found, with command, machine and versions"),
        ),
    ),
    Command(
        "calibrate",
        "fit camera, pins, friction and stiffness to recordings",
        calibrate,
        (
            path("recordings", "RECORDINGS", "a folder of recordings"),
            path("--out", "DIR", "folder for figures"),
            json_file(ROWS),
        ),
    ),
    Command(
        "validate",
        "simulate recorded contacts from their labels and compare the motion of every pin",
        validate,
        (
            path("recordings", "RECORDINGS", "a folder of labelled recordings"),
            path(
                "--calibration",
                "FILE",
                "calibration.json of `calibrate` (default: the fitted preset)",
            ),
            integer("--contacts", "of each folder, at random; 0: all (400)", 400),
            integer("--seed", "of the draw (0)", 0),
            path("--out", "DIR", "folder for validate.png and validate.txt"),
            json_file(ROWS),
        ),
    ),
)
