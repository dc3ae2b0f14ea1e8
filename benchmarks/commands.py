"""Commands of `python -m benchmarks`.

Everything heavy is imported when it is needed.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxunshear.cli.options import ROWS, add_json, new_parser
from jaxunshear.cli.program import Keep, Parser, add_commands, report_errors, run_tool
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.simulator.level import LEVELS

Measurement = tuple[list[Json], str]  # rows, and a table of them
COMMANDS = {
    "sim": "the simulator's error against its run time",
    "train": "a training step, beside PyTorch where it is installed",
    "infer": "unshearing a batch of images, beside PyTorch where it is installed",
    "needs": "operations and time that leaving out an unneeded part saves",
    "pins": "error and time of finding the pins of images",
    "stream": "a robot's perception, a frame at a time, beside the exported file and PyTorch",
    "data": "processor time and storage of a simulated data set, step by step",
    "input": "whether training waits for its examples",
    "pinnets": "networks over pins, with plain layers and fast ones",
    "explore": "how long a picture of `jaxunshear explore` takes",
}
OPTIONS: dict[str, tuple[str, ...]] = {
    "sim": ("level", "batch", "out"),
    "train": ("size", "batch"),
    "infer": ("size", "batch"),
    "needs": ("size",),
    "pins": ("size", "seed"),
    "stream": ("size",),
}
_ARGUMENTS: dict[str, dict[str, Any]] = {
    "level": {"choices": tuple(LEVELS), "help": "only rows of this level"},
    "batch": {"metavar": "N", "type": int, "help": "only rows with N scenes or images in a batch"},
    "size": {"metavar": "PX", "type": int, "help": "only images of this size"},
    "seed": {"metavar": "N", "type": int, "default": 0, "help": "of the contacts (0)"},
    "out": {"metavar": "DIR", "type": Path, "help": "folder for the figure"},
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of COMMANDS and return its exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    return report_errors(lambda: run_tool(make_parser(), words, _run, packages=("torch",)))


def make_parser() -> Parser:
    """Make the parser of COMMANDS."""
    parser = Parser(prog="python -m benchmarks", description="Measures error against run time.")
    commands = add_commands(parser)
    for name, text in COMMANDS.items():
        command = new_parser(commands, name, text)
        for option in OPTIONS.get(name, ()):
            command.add_argument(f"--{option}", **_ARGUMENTS[option])
        add_json(command, ROWS)
    return parser


def _run(arguments: argparse.Namespace, keep: Keep) -> int:
    for option in ("batch", "size"):
        value = getattr(arguments, option, None)
        if value is not None and value < 1:
            raise UserError(f"--{option} {value}: use at least 1")
    seed = getattr(arguments, "seed", 0)
    if seed < 0:
        raise UserError(f"--seed {seed}: use 0 or more")
    rows, text = _MEASURES.get(arguments.command, _measure_without_options)(arguments, keep)
    print(text)
    keep(rows)
    return 0


def _sim(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    from benchmarks import bench_figure, bench_sim
    from jaxunshear.files import write_bytes

    rows = bench_sim.bench_sim(arguments.level, arguments.batch, keep=keep)
    text = bench_sim.format_table(rows)
    if arguments.out is not None:
        figure = arguments.out / "work_precision.png"
        write_bytes(figure, bench_figure.plot_work_precision(rows))
        text += f"\n{figure}"
    return rows, text


def _train(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    from benchmarks import bench_networks

    rows = bench_networks.bench_train(arguments.size, arguments.batch)
    return rows, bench_networks.format_table(rows)


def _infer(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    from benchmarks import bench_networks

    rows = bench_networks.bench_infer(arguments.size, arguments.batch)
    return rows, bench_networks.format_table(rows)


def _stream(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    from benchmarks import bench_networks

    rows = bench_networks.bench_stream(arguments.size)
    return rows, bench_networks.format_table(rows)


def _needs(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    from benchmarks import bench_omissions

    rows = bench_omissions.bench_needs(arguments.size or 128)
    return rows, bench_omissions.format_table(rows)


def _pins(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    from benchmarks import bench_pins
    from jaxunshear.text_table import format_text_table

    if arguments.size is not None and not 64 <= arguments.size <= 1024:
        raise UserError(f"--size {arguments.size}: use 64 to 1024 px")
    rows = bench_pins.bench_pins(arguments.size, arguments.seed)
    return rows, format_text_table(rows, bench_pins.COLUMNS)


def _measure_without_options(arguments: argparse.Namespace, keep: Keep) -> Measurement:
    """Run a benchmark that has no option."""
    from benchmarks import bench_data, bench_explore, bench_input_pipeline, bench_pin_networks
    from jaxunshear.text_table import format_text_table

    kinds: dict[str, tuple[Callable[[], list[Json]], tuple[str, ...]]] = {
        "data": (bench_data.bench_data, bench_data.COLUMNS),
        "input": (bench_input_pipeline.bench_input, bench_input_pipeline.COLUMNS),
        "pinnets": (bench_pin_networks.bench_pin_networks, bench_pin_networks.COLUMNS),
        "explore": (bench_explore.bench_explore, bench_explore.COLUMNS),
    }
    measure, columns = kinds[arguments.command]
    rows = measure()
    return rows, format_text_table(rows, columns)


_MEASURES: dict[str, Callable[[argparse.Namespace, Keep], Measurement]] = {
    "sim": _sim,
    "train": _train,
    "infer": _infer,
    "needs": _needs,
    "pins": _pins,
    "stream": _stream,
}
