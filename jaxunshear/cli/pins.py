"""`jaxunshear pins`: find, identify and draw the pins of recorded images."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, Model, add_results, new_parser
from jaxunshear.config.experiment import require_simulated
from jaxunshear.errors import UserError
from jaxunshear.output_checks import check_not_among
from jaxunshear.results.applications import PinScores


def add_parser(commands: Commands) -> None:
    parser = new_parser(commands, "pins", "find, identify and draw the pins of recorded images")
    add_results(parser, "for the results (pins)")
    parser.add_argument(
        "path", metavar="IMAGES", type=Path, help="an image, or a folder of recordings"
    )
    known = parser.add_mutually_exclusive_group()
    known.add_argument(
        "--sensor", metavar="NAME", default="tactip331", help="whose pins they are (tactip331)"
    )
    known.add_argument(
        "--layout",
        metavar="FILE",
        type=Path,
        help="instead: x and y of each pin, a line each, any unit",
    )
    known.add_argument(
        "--model",
        metavar="DIR",
        type=Path,
        help="instead: images of the sensor and camera of this run",
    )
    parser.add_argument(
        "--rest",
        metavar="IMAGES",
        type=Path,
        help="of the untouched sensor (default: the images' mean)",
    )
    parser.add_argument(
        "--size", metavar="PX", type=int, help="of the prepared images (theirs, at most 256)"
    )


def run(arguments: argparse.Namespace, out: Path, model: Model | None) -> PinScores:
    import numpy as np

    from jaxunshear.config.image import Preprocess
    from jaxunshear.config.sensor import get_sensor
    from jaxunshear.data.recorded_pins import find_pins, summary
    from jaxunshear.data.recordings import read_recordings
    from jaxunshear.files import write_bytes, write_npz, write_text
    from jaxunshear.perception.lattice import Lattice
    from jaxunshear.perception.lattice_fitting import MarkerLayout, make_layout, read_layout
    from jaxunshear.serialization import format_csv, to_builtins

    if not arguments.path.exists():
        raise UserError(f"{arguments.path} does not exist: name an image or a folder of recordings")
    for recordings in (arguments.path, *([arguments.rest] if arguments.rest else [])):
        check_not_among(recordings, out, "--out")
        read_recordings(
            recordings, Preprocess()
        )  # refuses a place without images before there is work to lose
    if arguments.size is not None and not 32 <= arguments.size <= 2048:
        raise UserError(f"--size {arguments.size}: use 32 to 2048 px")
    preprocess = Preprocess(size=arguments.size) if arguments.size else None
    lattice: Lattice | MarkerLayout
    if model:
        from jaxunshear.perception.rest_positions import compute_rest_lattice

        experiment = model[1]
        paired, _ = require_simulated(experiment, "pins --model")
        if arguments.size or arguments.rest:
            raise UserError(
                "--model knows the images' size and the untouched pins: leave --size and --rest out"
            )
        preprocess = paired.preprocess
        lattice = compute_rest_lattice(experiment.sensor, paired.camera, preprocess)
    else:
        lattice = (
            read_layout(arguments.layout)
            if arguments.layout
            else make_layout(get_sensor(arguments.sensor))
        )
    found = find_pins(arguments.path, lattice, preprocess, arguments.rest)
    from jaxunshear.report.pin_figure import TrackedImage, plot_pins

    arrays = {
        "name": found.name,
        "sure": found.sure,
        "place_px": found.place_px.astype(np.float32),
        "motion_px": found.motion_px.astype(np.float32),
        "undeformed_px": found.lattice.rest.astype(np.float32),
    }
    write_npz(out / "pins.npz", arrays, compressed=True)
    write_text(out / "pins.csv", format_csv(to_builtins(found.table.rows)))
    images = [TrackedImage(*image) for image in found.shown]
    write_bytes(out / "pins.png", plot_pins(found.lattice, images))
    print(summary(found.table))
    print(out / "pins.png")
    return found.table
