"""Commands that take an experiment: run, data, train, evaluate, fit."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from jaxunshear.cli.options import (
    Commands,
    add_base,
    add_data,
    add_engine,
    add_json,
    new_parser,
    read_engine_options,
)
from jaxunshear.config.experiment import Experiment, get_recorded, list_trained_networks
from jaxunshear.errors import UserError
from jaxunshear.protected_folders import check_outside

NETWORKS = "networks"  # stands for those of the experiment
STAGES = {
    "data": ("data",),
    "train": (NETWORKS,),
    "evaluate": ("evaluate",),
    "run": ("data", NETWORKS, "evaluate", "report"),
    "fit": ("data", NETWORKS, "evaluate", "report"),
}
COMMANDS = tuple(STAGES)
SIMULATING = ("run", "data")


def add_parsers(commands: Commands) -> None:
    for name, text in (
        ("run", "all of the next three and the report; continues where a stopped run left off"),
        ("data", "simulate the two data sets"),
        ("train", "train the networks"),
        ("evaluate", "measure the networks on held-out poses"),
    ):
        command = new_parser(
            commands, name, text, f"jaxunshear {name} FILE [options] [--field value ...]"
        )
        command.set_defaults(takes_fields=True)
        command.add_argument(
            "file", metavar="FILE", type=Path, help="a Python file, such as experiments/demo.py"
        )
        command.add_argument(
            "--out",
            metavar="DIR",
            type=Path,
            default=Path("runs"),
            help="results: DIR/<name> (runs)",
        )
        add_data(command)
        add_base(command)
        if name in ("run", "evaluate"):
            add_json(command)
        if name in SIMULATING:
            add_engine(command, "chunk of contacts")
        if name == "train":
            command.add_argument(
                "--network", metavar="NAME", help="only this one of the experiment's (default: all)"
            )

    _add_fit_parser(commands)


def _add_fit_parser(commands: Commands) -> None:
    text = "fit networks to your own recordings: writes an experiment about them, and runs it"
    usage = "jaxunshear fit --taps DIR --slides DIR [options] [--field value ...]"
    command = new_parser(commands, "fit", text, usage)
    command.set_defaults(takes_fields=True)
    command.add_argument("--taps", metavar="DIR", type=Path, help="recorded taps")
    command.add_argument("--slides", metavar="DIR", type=Path, help="recorded slides")
    command.add_argument(
        "--pairs",
        metavar="FILE",
        type=Path,
        help="CSV with columns slide and tap: which belong together",
    )
    command.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("runs"), help="results: DIR/<name> (runs)"
    )
    add_data(command)
    add_json(command)


def run(arguments: argparse.Namespace, command: str) -> int:
    """Run one of COMMANDS. Return the exit code."""
    from jaxunshear.model_folders import find_model_folder

    ray_options = read_engine_options(arguments) if arguments.command in SIMULATING else None
    if arguments.command == "fit":
        experiment = _write_fit_experiment(arguments)
    elif arguments.command == "evaluate" and (folder := find_model_folder(arguments.file)).is_dir():
        arguments.file = folder
        experiment = _load_finished_experiment(arguments)
        if arguments.recordings:
            _score_recordings(experiment, arguments, command)
            return 0
    else:
        experiment = _read_experiment(arguments)
    networks = _select_networks(arguments, experiment)
    check_outside(getattr(arguments, "json", None), "--json", home=arguments.out / experiment.name)
    stages: list[str] = []
    for stage in STAGES[arguments.command]:
        stages += networks if stage == NETWORKS else [stage]
    from jaxunshear.allocator import keep_freed_memory
    from jaxunshear.cluster import make_ray_runner, run_locally
    from jaxunshear.run import run_stages

    keep_freed_memory()
    results = run_stages(
        experiment,
        tuple(stages),
        out=arguments.out,
        data=arguments.data,
        command=command,
        run_calls=make_ray_runner(*ray_options) if ray_options else run_locally,
    )
    if results and getattr(arguments, "json", None):
        from jaxunshear.evaluation.measurements import build_measurements
        from jaxunshear.results.record_files import write_record

        write_record(arguments.json, build_measurements(results))
    return 0


def _select_networks(arguments: argparse.Namespace, experiment: Experiment) -> tuple[str, ...]:
    """Return the networks to train: all of the experiment, or that of --network."""
    networks = list_trained_networks(experiment)
    network = getattr(arguments, "network", None)
    if not network:
        return networks
    if network not in networks:
        raise UserError(
            f"--network {network} is none of this experiment's: use {', '.join(networks)}"
        )
    return (network,)


def read_base(arguments: argparse.Namespace, fields: Sequence[str]) -> Experiment:
    """Return the experiment of FILE with fields changed, before it is checked.

    It has no recordings yet.
    """
    from jaxunshear.config.fields import override_fields
    from jaxunshear.config.load import load_experiment
    from jaxunshear.fit import BASE_EXPERIMENT
    from jaxunshear.model_folders import find_model_folder, load_settings

    if arguments.command == "fit":
        return override_fields(BASE_EXPERIMENT, fields)
    if arguments.command == "evaluate" and (folder := find_model_folder(arguments.file)).is_dir():
        return load_settings(folder)
    experiment = load_experiment(arguments.file)
    if arguments.sensor_from:
        from jaxunshear.config.preset import apply_preset

        experiment = apply_preset(experiment, arguments.sensor_from)
    return override_fields(experiment, fields)


def _read_experiment(arguments: argparse.Namespace) -> Experiment:
    """Read the experiment of a file, with the recordings that the command line names."""
    from jaxunshear.config.rules import validate

    experiment = read_base(arguments, arguments.fields)
    if arguments.recordings:
        from jaxunshear.fit import set_recordings

        folder = str(arguments.recordings)
        experiment = set_recordings(experiment, folder, folder)
    validate(experiment)
    return experiment


def _write_fit_experiment(arguments: argparse.Namespace) -> Experiment:
    """Write the experiment of `fit` beside its results."""
    from jaxunshear.config.fields import override_fields
    from jaxunshear.config.rules import validate
    from jaxunshear.fit import BASE_EXPERIMENT, set_recordings, write_experiment

    if not (arguments.taps or arguments.slides):
        raise UserError("name the folders of your recordings: --taps DIR --slides DIR")
    experiment = override_fields(BASE_EXPERIMENT, ["--name", "fit", *arguments.fields])
    experiment = set_recordings(
        experiment,
        str(arguments.taps or ""),
        str(arguments.slides or ""),
        str(arguments.pairs or ""),
    )
    validate(experiment)
    file = arguments.out / f"{experiment.name}.py"
    write_experiment(experiment, file)
    print(f"experiment: {file}")
    return experiment


def _load_finished_experiment(arguments: argparse.Namespace) -> Experiment:
    """Load the experiment of a finished run, which is named by its folder."""
    from dataclasses import replace

    from jaxunshear.model_folders import load_settings

    if arguments.fields or arguments.sensor_from:
        option = arguments.fields[0] if arguments.fields else "--sensor-from"
        raise UserError(
            f"{option}: the settings of a finished run stay as they are; "
            "name its experiment file to change them"
        )
    experiment = load_settings(arguments.file)
    folder = arguments.file.resolve()
    arguments.out = folder.parent
    return replace(experiment, name=folder.name)


def _score_recordings(experiment: Experiment, arguments: argparse.Namespace, command: str) -> None:
    from jaxunshear.evaluation.measurements import build_measurements
    from jaxunshear.evaluation.recorded_evaluation import score_recordings
    from jaxunshear.evaluation.recorded_results import format_table
    from jaxunshear.evaluation.sim_to_real import score_transfer
    from jaxunshear.results.record_files import write_record

    if get_recorded(experiment):
        results = score_recordings(
            experiment, arguments.file, arguments.recordings, arguments.data, command
        )
    else:
        results = score_transfer(experiment, arguments.file, arguments.recordings, command)
    print(format_table(results))
    if arguments.json:
        write_record(arguments.json, build_measurements(results))
