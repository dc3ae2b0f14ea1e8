"""`jaxunshear geometry`: contact geometry of taps, sheared and unsheared images."""

import argparse
from pathlib import Path

from jaxunshear.cli import options
from jaxunshear.cli.options import Commands, Model, add_model, new_parser
from jaxunshear.errors import UserError
from jaxunshear.settings.experiment import simulated_of
from jaxunshear.storage import Json, check_beside


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "geometry", "contact geometry of taps, sheared and unsheared images", "for the results (geometry)"
    )
    parser.add_argument("path", metavar="IMAGES", type=Path, nargs="?", help="also of these recordings")
    add_model(parser)
    parser.add_argument(
        "--contacts",
        metavar="N",
        type=int,
        default=300,
        help="fresh ones to be scored on, at least 5 of each shape (300)",
    )


def run(arguments: argparse.Namespace, out: Path, model: Model) -> Json:
    from jaxunshear.applications.fresh import fresh_contacts, untouched_images
    from jaxunshear.applications.geometry_scores import geometry_of, geometry_rows
    from jaxunshear.applications.geometry_ways import INVERSE, ways_of
    from jaxunshear.applications.perception import unshearers, unshearing_of
    from jaxunshear.dataset.recordings import read_recordings
    from jaxunshear.image.framing import undeformed
    from jaxunshear.report import geometry_figure
    from jaxunshear.settings.image import Preprocess
    from jaxunshear.storage import write_bytes
    from jaxunshear.table import plain_table

    if arguments.contacts < 3:
        raise UserError(f"--contacts {arguments.contacts}: use at least 3")
    if arguments.path is not None:
        read_recordings(arguments.path, Preprocess())  # refuses a place without images before there is work to lose
        check_beside(arguments.path, out, "--out")
    folder, experiment = model
    paired, _ = simulated_of(experiment, "geometry")
    networks = unshearers(folder, experiment, unshearing_of(folder))
    if not networks:
        raise UserError(f"{folder} holds no trained network that unshears: train one first, or name another --model")
    lattice = undeformed(experiment.sensor, paired.camera, paired.preprocess)
    ways = ways_of(experiment, lattice, fresh_contacts(experiment, options.KNOWN, seed=1))
    contacts = fresh_contacts(experiment, arguments.contacts)
    untouched = untouched_images(experiment, len(contacts.stimulus))
    geometry = geometry_of(lattice, contacts, untouched, ways, networks)
    rows = geometry_rows(paired.names, contacts, geometry)
    figure = geometry_figure.of_contacts(lattice, paired.names, contacts, geometry)
    write_bytes(out / "geometry.png", figure)
    print(plain_table(rows, ("name", "contacts", "unmatched", "correlation", "rmse_mm", "largest_mm", "ms_per_image")))
    print(out / "geometry.png")
    if arguments.path is not None:
        from jaxunshear.applications.recorded_geometry import heights_of_recordings

        shown = heights_of_recordings(arguments.path, experiment, lattice, ways[INVERSE], networks)
        write_bytes(out / "recordings.png", geometry_figure.of_recordings(lattice, shown))
        print(out / "recordings.png")
    return {"rows": rows, "mm_per_height": {name: way.mm for name, way in ways.items()}, "dropped": contacts.dropped}
