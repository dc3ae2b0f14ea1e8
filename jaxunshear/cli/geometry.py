"""Command `jaxunshear geometry`: contact geometry of taps, sheared and unsheared images."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, Model, add_model, add_results, new_parser
from jaxunshear.output_checks import check_not_among
from jaxunshear.results.applications import GeometryScores
from jaxunshear.serialization import to_builtins


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "geometry", "contact geometry of taps, sheared and unsheared images"
    )
    add_results(parser, "for the results (geometry)")
    parser.add_argument(
        "path", metavar="IMAGES", type=Path, nargs="?", help="also of these recordings"
    )
    add_model(parser)
    parser.add_argument(
        "--contacts",
        metavar="N",
        type=int,
        default=300,
        help="fresh ones to be scored on, at least 5 of each shape (300)",
    )


def run(arguments: argparse.Namespace, out: Path, model: Model) -> GeometryScores:
    from jaxunshear.config.image import Preprocess
    from jaxunshear.data.recordings import read_recordings
    from jaxunshear.downstream.geometry import INVERSE
    from jaxunshear.downstream.geometry_scores import score_geometry
    from jaxunshear.files import write_bytes
    from jaxunshear.report import geometry_figure
    from jaxunshear.text_table import format_text_table

    if arguments.path is not None:
        # refuses a place without images before there is work to lose
        read_recordings(arguments.path, Preprocess())
        check_not_among(arguments.path, out, "--out")
    folder, experiment = model
    paired = experiment.paired.get_simulated("geometry")
    scores = score_geometry(folder, experiment, arguments.contacts)
    figure = geometry_figure.plot_contacts(
        scores.lattice, paired.names, scores.contacts, scores.geometry
    )
    write_bytes(out / "geometry.png", figure)
    columns = (
        "name",
        "contacts",
        "unmatched",
        "correlation",
        "rmse_mm",
        "largest_mm",
        "ms_per_image",
    )
    print(format_text_table([to_builtins(row) for row in scores.table.rows], columns))
    print(out / "geometry.png")
    if arguments.path is not None:
        from jaxunshear.downstream.recorded_geometry import estimate_recorded_heights

        heights = estimate_recorded_heights(
            arguments.path, experiment, scores.lattice, scores.methods[INVERSE], scores.networks
        )
        figure = geometry_figure.plot_recordings(scores.lattice, heights)
        write_bytes(out / "recordings.png", figure)
        print(out / "recordings.png")
    return scores.table
