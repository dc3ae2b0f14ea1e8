"""`jaxunshear pins`: find, identify and draw the pins of recorded images."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, Model, new_parser
from jaxunshear.errors import UserError
from jaxunshear.settings.experiment import simulated_of
from jaxunshear.storage import Json, check_beside


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "pins", "find, identify and draw the pins of recorded images", "for the results (pins)"
    )
    parser.add_argument("path", metavar="IMAGES", type=Path, help="an image, or a folder of recordings")
    known = parser.add_mutually_exclusive_group()
    known.add_argument("--sensor", metavar="NAME", default="tactip331", help="whose pins they are (tactip331)")
    known.add_argument(
        "--layout", metavar="FILE", type=Path, help="instead: x and y of each pin, a line each, any unit"
    )
    known.add_argument("--model", metavar="DIR", type=Path, help="instead: images of the sensor and camera of this run")
    parser.add_argument(
        "--rest", metavar="IMAGES", type=Path, help="of the untouched sensor (default: the images' mean)"
    )
    parser.add_argument("--size", metavar="PX", type=int, help="of the prepared images (theirs, at most 256)")


def run(arguments: argparse.Namespace, out: Path, model: Model | None) -> Json:
    from dataclasses import replace

    from jaxunshear.applications import pins
    from jaxunshear.dataset.recordings import read_recordings
    from jaxunshear.image.fitting import Layout, layout_of, read_layout
    from jaxunshear.image.lattice import Lattice
    from jaxunshear.settings.image import Preprocess
    from jaxunshear.settings.sensor import sensor_named
    from jaxunshear.storage import write_bytes

    if not arguments.path.exists():
        raise UserError(f"{arguments.path} does not exist: name an image or a folder of recordings")
    for recordings in (arguments.path, *([arguments.rest] if arguments.rest else [])):
        check_beside(recordings, out, "--out")
        read_recordings(recordings, Preprocess())  # refuses a place without images before there is work to lose
    if arguments.size is not None and not 32 <= arguments.size <= 2048:
        raise UserError(f"--size {arguments.size}: use 32 to 2048 px")
    preprocess = Preprocess()
    lattice: Lattice | Layout
    if model:
        from jaxunshear.image.framing import undeformed

        experiment = model[1]
        paired, _ = simulated_of(experiment, "pins --model")
        if arguments.size or arguments.rest:
            raise UserError("--model knows the images' size and the untouched pins: leave --size and --rest out")
        preprocess = paired.preprocess
        lattice = undeformed(experiment.sensor, paired.camera, preprocess)
    else:
        lattice = read_layout(arguments.layout) if arguments.layout else layout_of(sensor_named(arguments.sensor))
        preprocess = replace(preprocess, size=arguments.size or pins.prepared_size(arguments.path))
    measured, fitted, shown = pins.pins_of_recordings(arguments.path, lattice, preprocess, out, arguments.rest)
    from jaxunshear.report.pin_figure import pin_figure

    write_bytes(out / "pins.png", pin_figure(fitted, shown))
    print(pins.summary(measured))
    print(out / "pins.png")
    return measured
