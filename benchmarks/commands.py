"""Commands of `python -m benchmarks`.

Everything heavy is imported when it is needed.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from jaxunshear.cli.program import (
    ROWS,
    Keep,
    Parser,
    add_commands,
    add_json,
    new_parser,
    report_errors,
    run_tool,
)
from jaxunshear.errors import UserError
from jaxunshear.simulator.level import LEVELS


class Benchmark(NamedTuple):
    """A function `bench_<command>` of a module, which has the COLUMNS of its table."""

    help: str
    module: str
    options: tuple[str, ...] = ()


COMMANDS = {
    "sim": Benchmark(
        "the simulator's error against its run time", "bench_sim", ("level", "batch", "out")
    ),
    "train": Benchmark(
        "a training step, beside PyTorch where it is installed",
        "bench_networks",
        ("size", "batch"),
    ),
    "infer": Benchmark(
        "unshearing a batch of images, beside PyTorch where it is installed",
        "bench_networks",
        ("size", "batch"),
    ),
    "needs": Benchmark(
        "operations and time that leaving out an unneeded part saves",
        "bench_omissions",
        ("size",),
    ),
    "pins": Benchmark(
        "error and time of finding the pins of images", "bench_pins", ("size", "seed")
    ),
    "read": Benchmark(
        "the time of reading the pins of a frame, beside a plain pass of labels and centroids",
        "bench_read",
    ),
    "lost_pins": Benchmark(
        "images that are sure, and the error of pins, while pins are lost and dust comes",
        "bench_lost_pins",
        ("recordings", "seed"),
    ),
    "frame": Benchmark(
        "a robot's perception, a frame at a time, beside the exported file and PyTorch",
        "bench_networks",
        ("size",),
    ),
    "filter": Benchmark("what `stream --filter` gains, and how far it lags", "bench_filter"),
    "data": Benchmark(
        "processor time and storage of a simulated data set, step by step", "bench_data"
    ),
    "input": Benchmark("whether training waits for its examples", "bench_input_pipeline"),
    "pinnets": Benchmark(
        "networks over pins, with plain layers and fast ones", "bench_pin_networks"
    ),
    "touch": Benchmark(
        "contact, slip and shear by the pins' motion, against the simulator's truth",
        "bench_touch",
        ("seed", "weights", "recordings"),
    ),
    "contacts": Benchmark(
        "errors over the number of taps and slides that a training has",
        "bench_contacts",
        ("recordings", "seed"),
    ),
    "layouts": Benchmark(
        "how exact networks are on a dome with another layout of pins",
        "bench_layouts",
        ("seed",),
    ),
    "adapt": Benchmark(
        "what `jaxunshear adapt` is worth if the camera has moved",
        "bench_adapt",
        ("recordings", "seed"),
    ),
    "taps_alone": Benchmark(
        "how much of a slide is undone on a task of which there are taps alone",
        "bench_taps_alone",
        ("run",),
    ),
    "demo": Benchmark("how long each stage of `make demo` takes, installs apart", "bench_demo"),
    "explore": Benchmark("how long a picture of `jaxunshear explore` takes", "bench_explore"),
}
_ARGUMENTS: dict[str, dict[str, Any]] = {
    "level": {"choices": tuple(LEVELS), "help": "only rows of this level"},
    "batch": {"metavar": "N", "type": int, "help": "only rows with N scenes or images in a batch"},
    "size": {"metavar": "PX", "type": int, "help": "only images of this size"},
    "seed": {"metavar": "N", "type": int, "default": 0, "help": "of the contacts (0)"},
    "recordings": {"metavar": "DIR", "type": Path, "help": "also of these"},
    "out": {"metavar": "DIR", "type": Path, "help": "folder for the figure"},
    "run": {"metavar": "RUN", "type": Path, "required": True, "help": "of several tasks"},
    "weights": {
        "metavar": "FILE",
        "type": Path,
        "help": "learn from new contacts first, and write what was learnt to FILE",
    },
}
_LEAST = {"batch": 1, "size": 1, "seed": 0}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of COMMANDS and return its exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    return report_errors(lambda: run_tool(make_parser(), words, _run, packages=("torch",)))


def make_parser() -> Parser:
    """Make the parser of COMMANDS."""
    parser = Parser(prog="python -m benchmarks", description="Measures error against run time.")
    commands = add_commands(parser)
    for name, benchmark in COMMANDS.items():
        command = new_parser(commands, name, benchmark.help)
        for option in benchmark.options:
            command.add_argument(f"--{option}", **_ARGUMENTS[option])
        add_json(command, ROWS)
    return parser


def _run(arguments: argparse.Namespace, keep: Keep) -> int:
    benchmark = COMMANDS[arguments.command]
    options = {option: getattr(arguments, option) for option in benchmark.options}
    for option, least in _LEAST.items():
        value = options.get(option)
        if value is not None and value < least:
            raise UserError(f"--{option} {value}: use at least {least}")
    folder = options.pop("out", None)
    if arguments.command == "sim":  # hours: rows are kept as they come
        options["keep"] = keep
    module = import_module(f"benchmarks.{benchmark.module}")
    from jaxunshear.results.provenance import describe_machine

    rows = getattr(module, f"bench_{arguments.command}")(**options)
    print(module.format_table(rows))
    print(f"device: {describe_machine().device}")
    keep(rows)
    if folder is not None:
        from benchmarks.bench_figure import plot_work_precision
        from jaxunshear.files import write_bytes

        figure = folder / "work_precision.png"
        write_bytes(figure, plot_work_precision(rows))
        print(figure)
    return 0
