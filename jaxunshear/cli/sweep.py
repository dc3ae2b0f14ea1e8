"""Command `jaxunshear sweep`: runs an experiment over grids of settings and seeds."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxunshear.cli.options import (
    Commands,
    add_base,
    add_data,
    add_engine,
    add_json,
    new_parser,
    read_engine_options,
)

if TYPE_CHECKING:
    from jaxunshear.config.experiment import Experiment
    from jaxunshear.config.sweep import Sweep

COMMANDS = ("sweep",)


def add_parsers(commands: Commands) -> None:
    text = (
        "run an experiment over grids of settings and seeds; "
        "continues where a stopped sweep left off"
    )
    parser = new_parser(
        commands, "sweep", text, "jaxunshear sweep FILE [options] [--field value ...]"
    )
    parser.set_defaults(takes_fields=True)
    parser.add_argument(
        "file",
        metavar="FILE",
        type=Path,
        help="such as experiments/ablations/lambda_split.py, or an experiment",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("runs/sweeps"),
        help="DIR/<name> (runs/sweeps)",
    )
    add_data(parser)
    add_base(parser)
    parser.add_argument("--seeds", metavar="N,N,...", help="instead of those in FILE")
    add_engine(parser, "row")
    parser.add_argument(
        "--retry-failed", action="store_true", help="also try rows again that failed"
    )
    add_json(parser, "sweep.json here, too")


def _read_sweep(arguments: argparse.Namespace, fields: Sequence[str]) -> "Sweep":
    from jaxunshear.config.sweep import load_sweep, override_base

    sweep = load_sweep(arguments.file)
    if arguments.sensor_from is not None:
        from jaxunshear.config.preset import apply_preset

        sweep = dataclasses.replace(sweep, base=apply_preset(sweep.base, arguments.sensor_from))
    return override_base(sweep, fields)


def read_base(arguments: argparse.Namespace, fields: Sequence[str]) -> "Experiment":
    """Return the base of the sweep in FILE with fields changed, before it is checked."""
    from jaxunshear.config.sweep import get_base

    return get_base(_read_sweep(arguments, fields))


def run(arguments: argparse.Namespace, command: str) -> int:
    """Run a sweep and print its table. Return 0, or 1 if a row failed."""
    ray_options = read_engine_options(arguments)
    from jaxunshear.config.sweep import check_sweep, parse_seeds

    sweep = _read_sweep(arguments, arguments.fields)
    if arguments.seeds is not None:
        sweep = dataclasses.replace(sweep, seeds=parse_seeds(arguments.seeds))
    if arguments.recordings is not None:
        from jaxunshear.fit import set_recordings

        folder = str(arguments.recordings)
        sweep = dataclasses.replace(sweep, base=set_recordings(sweep.base, folder, folder))
    check_sweep(sweep, str(arguments.file))

    from jaxunshear.protected_folders import check_outside
    from jaxunshear.results.record_files import write_record
    from jaxunshear.sweep import engines
    from jaxunshear.sweep.run import run_sweep
    from jaxunshear.sweep.summary_table import format_table

    check_outside(arguments.json, "--json", home=arguments.out / sweep.name)
    engine: engines.Engine = engines.run_serially
    if ray_options:
        engine = engines.make_ray_engine(*ray_options)
    summary = run_sweep(
        sweep, arguments.out, arguments.data, command, engine, arguments.retry_failed
    )
    print(format_table(summary))
    print(arguments.out / sweep.name / "sweep.json")
    if arguments.json is not None:
        write_record(arguments.json, summary)
    return 1 if any(cell.failures for cell in summary.cells) else 0
