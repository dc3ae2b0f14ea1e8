"""Command `jaxunshear pins`: find, identify and draw the pins of recorded images."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from jaxunshear.cli.options import Commands, Model, add_results, new_parser
from jaxunshear.errors import UserError
from jaxunshear.output_checks import check_not_among
from jaxunshear.results.applications import PinScores

if TYPE_CHECKING:
    from jaxunshear.config.image import Preprocess
    from jaxunshear.perception.lattice import Lattice
    from jaxunshear.perception.lattice_fitting import MarkerLayout


def add_parser(commands: Commands) -> None:
    parser = new_parser(commands, "pins", "find, identify and draw the pins of recorded images")
    add_results(parser, "for the results (pins)")
    parser.add_argument(
        "path", metavar="IMAGES", type=Path, help="an image, or a folder of recordings"
    )
    layout = parser.add_mutually_exclusive_group()
    layout.add_argument(
        "--sensor", metavar="NAME", default="tactip331", help="whose pins they are (tactip331)"
    )
    layout.add_argument(
        "--layout",
        metavar="FILE",
        type=Path,
        help="instead: x and y of each pin, a line each, any unit",
    )
    layout.add_argument(
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

    from jaxunshear.data.recorded_pins import find_pins, summary
    from jaxunshear.files import write_bytes, write_npz, write_text
    from jaxunshear.serialization import format_csv, to_builtins

    _check_arguments(arguments, out)
    lattice, preprocess = _choose_lattice(arguments, model)
    pins = find_pins(arguments.path, lattice, preprocess, arguments.rest)
    from jaxunshear.report.pin_figure import plot_pins

    arrays = {
        "name": pins.name,
        "sure": pins.sure,
        "place_px": pins.place_px.astype(np.float32),
        "motion_px": pins.motion_px.astype(np.float32),
        "undeformed_px": pins.lattice.rest.astype(np.float32),
    }
    write_npz(out / "pins.npz", arrays, compressed=True)
    write_text(out / "pins.csv", format_csv(to_builtins(pins.table.rows)))
    write_bytes(out / "pins.png", plot_pins(pins.lattice, pins.shown))
    print(summary(pins.table))
    print(out / "pins.png")
    return pins.table


def _check_arguments(arguments: argparse.Namespace, out: Path) -> None:
    """Check the arguments before there is work to lose."""
    from jaxunshear.config.image import Preprocess
    from jaxunshear.data.recordings import read_recordings

    if not arguments.path.exists():
        raise UserError(f"{arguments.path} does not exist: name an image or a folder of recordings")
    for recordings in filter(None, (arguments.path, arguments.rest)):
        check_not_among(recordings, out, "--out")
        read_recordings(recordings, Preprocess())  # refuses a place without images
    if arguments.size is not None and not 32 <= arguments.size <= 2048:
        raise UserError(f"--size {arguments.size}: use 32 to 2048 px")


def _choose_lattice(
    arguments: argparse.Namespace, model: Model | None
) -> "tuple[Lattice | MarkerLayout, Preprocess | None]":
    """Return where the pins of the untouched sensor are, and how images are prepared."""
    from jaxunshear.config.image import Preprocess
    from jaxunshear.config.sensor import get_sensor
    from jaxunshear.perception.lattice_fitting import make_layout, read_layout
    from jaxunshear.perception.rest_positions import compute_rest_lattice

    if model:
        experiment = model[1]
        paired = experiment.paired.get_simulated("pins --model")
        if arguments.size or arguments.rest:
            raise UserError(
                "--model knows the images' size and the untouched pins: leave --size and --rest out"
            )
        lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
        return lattice, paired.preprocess
    preprocess = Preprocess(size=arguments.size) if arguments.size else None
    if arguments.layout:
        return read_layout(arguments.layout), preprocess
    return make_layout(get_sensor(arguments.sensor)), preprocess
