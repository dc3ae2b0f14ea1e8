"""Command `jaxunshear servo`: follow the outlines of objects by touch, in the simulator."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import (
    Commands,
    Model,
    add_model,
    add_results,
    add_stimulus,
    new_parser,
    parse_stimuli,
)
from jaxunshear.results.applications import TrajectoryScore, TrajectoryScores


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "servo", "follow the outlines of objects by touch, in the simulator"
    )
    add_results(parser, "for the results (servo)")
    add_model(parser)
    add_stimulus(parser)
    parser.add_argument(
        "--starts", metavar="N", type=int, default=5, help="for each way of perceiving (5)"
    )
    parser.add_argument(
        "--ways",
        metavar="NAME,NAME",
        help="of perceiving (default: all that the model's networks allow)",
    )
    parser.add_argument("--depth", metavar="MM", type=float, default=3.0, help="of the contact (3)")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the starts (0)")


def run(arguments: argparse.Namespace, out: Path, model: Model) -> TrajectoryScores:
    from jaxunshear.downstream.servo import ServoTask
    from jaxunshear.downstream.servo_scores import servo
    from jaxunshear.files import write_bytes
    from jaxunshear.report.trajectory_figure import plot_trajectories
    from jaxunshear.text_table import format_text_table

    tasks = [
        ServoTask(stimulus, arguments.starts, arguments.depth, seed=arguments.seed)
        for stimulus in parse_stimuli(arguments.stimulus)
    ]
    ways = tuple(arguments.ways.split(",")) if arguments.ways else None
    rows: list[TrajectoryScore] = []
    for result in servo(*model, tasks, ways, out):
        name = str(result.task.stimulus)
        rows += result.scores
        write_bytes(
            out / f"{name}.png", plot_trajectories(result.trajectories, result.contour, name)
        )
        columns = ("name", "completed", "closed", "mean_mm", "p95_mm", "largest_mm")
        print(format_text_table([vars(row) for row in result.scores], columns))
    print(out)
    return TrajectoryScores(rows)
