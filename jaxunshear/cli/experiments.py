"""Commands that take an experiment: run, data, train, evaluate, fit; and sweep."""

import argparse
import pkgutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxunshear.cli.models import choose_exit_code
from jaxunshear.cli.program import (
    DATA,
    LAYOUT,
    Command,
    Option,
    flag,
    integer,
    json_file,
    mark_rare,
    option,
    path,
)
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields
from jaxunshear.config.load import load_experiment
from jaxunshear.config.network_config import list_trained_networks
from jaxunshear.config.rules import validate
from jaxunshear.config.serialization import (
    apply_preset,
    check_unreleased,
    find_model_folder,
    load_settings,
)
from jaxunshear.config.sweep import (
    Sweep,
    check_sweep,
    get_base,
    load_sweep,
    override_base,
    parse_seeds,
)
from jaxunshear.cost import check_cost
from jaxunshear.errors import UserError
from jaxunshear.output_checks import check_new_folder, check_outside

NETWORKS = "networks"  # stands for those of the experiment
STAGES = {
    "data": ("data",),
    "train": (NETWORKS,),
    "evaluate": ("evaluate",),
    "run": ("data", NETWORKS, "evaluate", "report"),
    "fit": ("data", NETWORKS, "evaluate", "report"),
}
FIT_USAGE = "--taps RECORDINGS --slides RECORDINGS | --recordings RECORDINGS ..."
FIT_ADVICE = "Add --unshear.input pins if `doctor` follows the pins: it is more exact than images."
DEFAULT_RAY_CORES = 2  # for each row or chunk


def handle_stages(arguments: argparse.Namespace, command: str) -> int:
    ray_options = _read_engine_options(arguments)
    check_new_folder(arguments.data, "--data")
    if arguments.command == "fit":
        experiment = _write_fit_experiment(arguments)
    elif arguments.command == "evaluate" and (folder := find_model_folder(arguments.file)).is_dir():
        if not arguments.recordings:
            check_unreleased(arguments.file)
        arguments.file = folder
        experiment = _load_finished_experiment(arguments)
        if arguments.recordings:
            return _score_recordings(experiment, arguments, command)
    else:
        experiment = _apply_recordings(read_base(arguments, arguments.fields), arguments)
        check_cost(experiment, arguments.data)
        validate(experiment)
    networks = list_trained_networks(experiment)
    network = getattr(arguments, "network", None)
    if network is not None:
        if network not in networks:
            raise UserError(
                f"--network {network} is none of this experiment's: use {', '.join(networks)}"
            )
        networks = (network,)
    json = getattr(arguments, "json", None)
    check_outside(json, "--json", home=arguments.out / experiment.name)
    stages: list[str] = []
    for stage in STAGES[arguments.command]:
        stages += networks if stage == NETWORKS else [stage]
    from jaxunshear.cluster import make_ray_runner, run_locally
    from jaxunshear.data.sources import open_source
    from jaxunshear.environment import keep_freed_memory

    keep_freed_memory()
    run_stages = pkgutil.resolve_name(open_source(experiment).runner)
    results = run_stages(
        experiment,
        tuple(stages),
        out=arguments.out,
        data=arguments.data,
        command=command,
        run_calls=make_ray_runner(*ray_options) if ray_options else run_locally,
    )
    if results and json:
        from jaxunshear.evaluation.measurements import build_measurements
        from jaxunshear.results.record_files import write_record

        write_record(json, build_measurements(results))
    return 0


def read_base(arguments: argparse.Namespace, fields: Sequence[str]) -> Experiment:
    """Return the experiment of a file with fields changed, before it is checked.

    It has no recordings yet.
    """
    from jaxunshear.fit import BASE_EXPERIMENT

    if arguments.command == "sweep":
        return get_base(_read_sweep(arguments, fields))
    if arguments.command == "fit":
        return override_fields(BASE_EXPERIMENT, fields)
    if arguments.command == "evaluate" and (folder := find_model_folder(arguments.file)).is_dir():
        return load_settings(folder)
    experiment = _apply_sensor(load_experiment(arguments.file), arguments)
    return override_fields(experiment, fields)


def _apply_sensor(experiment: Experiment, arguments: argparse.Namespace) -> Experiment:
    file = arguments.sensor_from
    return apply_preset(experiment, file) if file else experiment


def _apply_recordings(experiment: Experiment, arguments: argparse.Namespace) -> Experiment:
    from jaxunshear.fit import set_recordings

    folder = str(arguments.recordings or "")
    return set_recordings(experiment, folder, folder) if folder else experiment


def _write_fit_experiment(arguments: argparse.Namespace) -> Experiment:
    """Write the experiment of `fit` beside its results."""
    from jaxunshear.fit import BASE_EXPERIMENT, set_recordings, set_tasks, write_experiment
    from jaxunshear.results.layout import read_layout

    named = [str(folder) for folder in arguments.recordings or ()]
    folders = [str(each or "") for each in (arguments.taps, arguments.slides, arguments.pairs)]
    if bool(named) == any(folders):
        raise UserError(
            "name your recordings: --taps DIR --slides DIR; or folders that hold both, "
            "one for each task, --recordings DIR DIR"
        )
    fields = ["--name", "fit", *(("--unshear.input", "pins") if named else ()), *arguments.fields]
    experiment = override_fields(BASE_EXPERIMENT, fields)
    if arguments.layout:
        experiment = replace(experiment, sensor=read_layout(arguments.layout))
    if len(named) > 1:
        experiment = set_tasks(experiment, named)
    else:
        experiment = set_recordings(experiment, *(named * 2 or folders))
    validate(experiment)
    file = arguments.out / f"{experiment.name}.py"
    write_experiment(experiment, file)
    print(f"experiment: {file}")
    return experiment


def _load_finished_experiment(arguments: argparse.Namespace) -> Experiment:
    if arguments.fields or arguments.sensor_from:
        name = arguments.fields[0] if arguments.fields else "--sensor-from"
        raise UserError(
            f"{name}: the settings of a finished run stay as they are; "
            "name its experiment file to change them"
        )
    experiment = load_settings(arguments.file)
    folder = arguments.file.resolve()
    arguments.out = folder.parent
    return replace(experiment, name=folder.name)


def _score_recordings(experiment: Experiment, arguments: argparse.Namespace, command: str) -> int:
    """Score a run on other recordings; return 1 if half of the contacts or more are left out."""
    from jaxunshear.evaluation.measurements import build_measurements
    from jaxunshear.evaluation.recorded_evaluation import score_recordings
    from jaxunshear.evaluation.recorded_results import format_table
    from jaxunshear.evaluation.sim_to_real import score_transfer
    from jaxunshear.results.record_files import write_record

    if experiment.paired.has_parts:
        from jaxunshear.task_run import find_task

        arguments.file = find_task(arguments.file, arguments.recordings)
        experiment = load_settings(arguments.file)
    if experiment.paired.is_simulated:
        results = score_transfer(experiment, arguments.file, arguments.recordings, command)
    else:
        results = score_recordings(
            experiment, arguments.file, arguments.recordings, arguments.data, command
        )
    print(format_table(results))
    if arguments.json:
        write_record(arguments.json, build_measurements(results))
    counts = results.counts
    used = (counts.known_taps or 0) + (counts.test_taps or 0) + (counts.test_poses or 0)
    return choose_exit_code(used, (counts.unread_taps or 0) + (counts.test_unsure or 0))


def _read_sweep(arguments: argparse.Namespace, fields: Sequence[str]) -> Sweep:
    sweep = load_sweep(arguments.file)
    return override_base(replace(sweep, base=_apply_sensor(sweep.base, arguments)), fields)


def sweep(arguments: argparse.Namespace, command: str) -> int:
    """Run a sweep and print its table. Return 0, or 1 if a row failed."""
    ray_options = _read_engine_options(arguments)
    check_new_folder(arguments.data, "--data")
    sweep = _read_sweep(arguments, arguments.fields)
    sweep = replace(sweep, base=_apply_recordings(sweep.base, arguments))
    if arguments.seeds is not None:
        sweep = replace(sweep, seeds=parse_seeds(arguments.seeds))
    check_cost(get_base(sweep), arguments.data)
    check_sweep(sweep, str(arguments.file))

    from jaxunshear.cluster import make_ray_runner, run_locally
    from jaxunshear.results.record_files import write_record
    from jaxunshear.sweep import run
    from jaxunshear.sweep.summary import format_table

    check_outside(arguments.json, "--json", home=arguments.out / sweep.name)
    run_calls = make_ray_runner(*ray_options) if ray_options else run_locally
    summary = run.run_sweep(
        sweep, arguments.out, arguments.data, command, run_calls, arguments.retry_failed
    )
    print(format_table(summary))
    print(arguments.out / sweep.name / "sweep.json")
    if arguments.json is not None:
        write_record(arguments.json, summary)
    return 1 if any(cell.failures for cell in summary.cells) else 0


def _read_engine_options(arguments: argparse.Namespace) -> tuple[str | None, int] | None:
    """Return address and cores of `--engine ray`; None for the serial one. Raises UserError."""
    if "engine" not in arguments:
        return None
    address, cores = arguments.ray_address, arguments.ray_cores
    if arguments.engine != "ray" and (address is not None or cores is not None):
        raise UserError("--ray-address and --ray-cores go with --engine ray")
    if cores is not None and cores < 1:
        raise UserError(f"--ray-cores {cores}: use at least 1")
    return (address, cores or DEFAULT_RAY_CORES) if arguments.engine == "ray" else None


def _list_engine_options(piece: str) -> tuple[Option, ...]:
    """List the options of who runs the pieces of a command."""
    text = f"run one {piece} after the other, or all over a Ray cluster (default: serial)"
    return mark_rare(
        ("--engine", {"choices": ("serial", "ray"), "default": "serial", "help": text}),
        option(
            "--ray-address", "ADDRESS", "address of a Ray cluster (default: one on this machine)"
        ),
        integer(
            "--ray-cores", f"cores of the cluster for each {piece} (default: {DEFAULT_RAY_CORES})"
        ),
    )


OUT = path(
    "--out",
    "DIR",
    "folder of the results, which go to DIR/<name> (default: runs)",
    default=Path("runs"),
)
SUBJECT = (  # the recordings and the sensor that an experiment in a file is about
    path(
        "--recordings",
        "RECORDINGS",
        "folder of recordings, for an experiment such as experiments/recorded.py",
    ),
    path(
        "--sensor-from",
        "FILE",
        "a calibration.json of `jaxunshear calibrate`: simulate its sensor, camera and friction",
    ),
)
BASE = (
    path("file", "EXPERIMENT", "a Python file, such as experiments/demo.py"),
    *(OUT, DATA, *SUBJECT),
)
SIMULATION = _list_engine_options("chunk of contacts")
OPTIONS: dict[str, tuple[str, tuple[Option, ...]]] = {
    "run": (
        "run an experiment from its data to its report; a stopped run continues",
        (*BASE, json_file(), *SIMULATION),
    ),
    "data": (
        "only make the data sets of an experiment: simulate contacts, or read recordings",
        (*BASE, *SIMULATION),
    ),
    "train": (
        "only train the networks of an experiment",
        (
            *BASE,
            option(
                "--network", "NAME", "train this network of the experiment alone (default: all)"
            ),
        ),
    ),
    "evaluate": (
        "score a finished run on its test set, or a model on other recordings",
        (
            path(
                "file",
                "MODEL",
                "a finished run; released weights, with --recordings; or an experiment's file",
            ),
            *BASE[1:],
            json_file(),
        ),
    ),
    "fit": (
        "train on your own taps and slides: writes an experiment about them, and runs it",
        (
            (
                "--recordings",
                {
                    "metavar": "RECORDINGS",
                    "nargs": "+",
                    "help": "folders of recordings, one for each task or day: one network, "
                    "over pins unless --unshear.input images, unshears all",
                },
            ),
            path("--taps", "RECORDINGS", "recorded taps"),
            path("--slides", "RECORDINGS", "recorded slides"),
            path(
                "--pairs", "FILE", "CSV with columns slide and tap: the files that belong together"
            ),
            *(LAYOUT, OUT, DATA, json_file()),
        ),
    ),
    "sweep": (
        "run an experiment over grids of settings and seeds; a stopped sweep continues",
        (
            path(
                "file",
                "EXPERIMENT",
                "a sweep, such as experiments/ablations/lambda_split.py, or an experiment",
            ),
            path(
                "--out",
                "DIR",
                "folder of the results, which go to DIR/<name> (default: runs/sweeps)",
                default=Path("runs/sweeps"),
            ),
            *(DATA, *SUBJECT),
            option("--seeds", "N,N,...", "seeds of the trainings, instead of those in EXPERIMENT"),
            *_list_engine_options("row"),
            flag("--retry-failed", "try failed rows again"),
            json_file("sweep.json here, too"),
        ),
    ),
}
COMMANDS = tuple(
    Command(
        name,
        text,
        sweep if name == "sweep" else handle_stages,
        options,
        takes_fields=FIT_USAGE if name == "fit" else options[0][1]["metavar"],
        is_resumable=name != "evaluate",
        checks_out=False,
        advice=FIT_ADVICE if name == "fit" else "",
    )
    for name, (text, options) in OPTIONS.items()
)
