"""`jaxunshear servo`: follow the outlines of objects by touch, in the simulator."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, Model, add_model, add_stimulus, new_parser, stimuli_of
from jaxunshear.errors import UserError
from jaxunshear.settings.experiment import simulated_of
from jaxunshear.storage import Json


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "servo", "follow the outlines of objects by touch, in the simulator", "for the results (servo)"
    )
    add_model(parser)
    add_stimulus(parser)
    parser.add_argument("--starts", metavar="N", type=int, default=5, help="for each way of perceiving (5)")
    parser.add_argument(
        "--ways", metavar="NAME,NAME", help="of perceiving (default: all that the model's networks allow)"
    )
    parser.add_argument("--depth", metavar="MM", type=float, default=3.0, help="of the contact (3)")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the starts (0)")


def run(arguments: argparse.Namespace, out: Path, model: Model) -> Json:
    from jaxunshear.applications import perception, servo
    from jaxunshear.applications.walk_scores import walk_rows
    from jaxunshear.report.walk_figure import walk_figure
    from jaxunshear.settings.reach import deepest_mm
    from jaxunshear.storage import write_bytes
    from jaxunshear.table import plain_table

    stimuli = stimuli_of(arguments.stimulus)
    if arguments.starts < 1:
        raise UserError(f"--starts {arguments.starts}: use at least 1")
    if arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: use 0 or more")
    folder, experiment = model
    paired, _ = simulated_of(experiment, "servo")
    deepest = deepest_mm(experiment.sensor)
    if not 0 < arguments.depth <= deepest:
        raise UserError(f"--depth {arguments.depth:g}: use more than 0, up to {deepest:.1f} mm")
    if not arguments.ways and not perception.ways_of(folder):
        raise UserError(
            f"{folder} holds no trained networks to perceive by: train them first, or ask for --ways {perception.TRUE}"
        )
    chosen = arguments.ways.split(",") if arguments.ways else (perception.TRUE, *perception.ways_of(folder))
    known = perception.perceptions(folder, experiment, tuple(way for way in chosen if way != perception.TRUE))
    ways, digests = {way: known.get(way) for way in chosen}, perception.digests(folder, chosen)
    rows: list[Json] = []
    for touched in stimuli:
        name, course = str(touched), servo.Course(touched, arguments.starts, arguments.depth, seed=arguments.seed)
        walks, line = servo.follow_contour(course, experiment.sensor, paired, ways, out / f"{name}.npz", digests)
        rows += walk_rows(walks, line, name)
        write_bytes(out / f"{name}.png", walk_figure(walks, line, name))
        print(plain_table(rows[-len(ways) :], ("name", "completed", "closed", "mean_mm", "p95_mm", "largest_mm")))
    print(out)
    return {"rows": rows}
