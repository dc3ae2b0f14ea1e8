"""`jaxunshear logs`: training logs for TensorBoard."""

import argparse
import time
from functools import partial
from pathlib import Path

from jaxunshear.cli.options import Commands, new_parser

COMMANDS = ("logs",)
EVERY_S = 2.0  # between two readings of a log that is followed


def add_parsers(commands: Commands) -> None:
    text = "training logs of runs and sweeps as event files for TensorBoard, also while they train"
    parser = new_parser(commands, "logs", text)
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help="folders of runs or sweeps, finished or not")
    parser.add_argument("--tensorboard", metavar="DIR", type=Path, required=True, help="for `tensorboard --logdir DIR`")
    parser.add_argument("--follow", action="store_true", help="go on until the runs are finished, or Ctrl-C")


def run(arguments: argparse.Namespace, command: str) -> int:
    import jax

    from jaxunshear.owners import check_apart
    from jaxunshear.places import check_new_folder

    check_new_folder(arguments.tensorboard, "--tensorboard")
    check_apart(arguments.tensorboard, "--tensorboard")
    jax.config.update("jax_platforms", "cpu")  # a training may hold the accelerator
    from jaxunshear.report.events import write_events

    write_events(arguments.runs, arguments.tensorboard, partial(time.sleep, EVERY_S) if arguments.follow else None)
    return 0
