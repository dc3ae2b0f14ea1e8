"""The command line: parses, calls, prints. Every command imports what it needs when it needs it, so help is quick."""

import argparse
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from jaxunshear import __version__, cli_applications, cli_checks, cli_recordings, cli_sweep, cli_validate
from jaxunshear.environment import check_environment, check_links, settle
from jaxunshear.errors import Note, UserError
from jaxunshear.owners import check_apart
from jaxunshear.storage import check_new_file, check_new_folder, disk_is_full

if TYPE_CHECKING:
    from jaxunshear.experiment import Experiment

_usual = warnings.formatwarning
NETWORKS = "networks"  # stands for those of the experiment
STAGES = {
    "data": ("data",),
    "train": (NETWORKS,),
    "evaluate": ("evaluate",),
    "run": ("data", NETWORKS, "evaluate", "report"),
    "fit": ("data", NETWORKS, "evaluate", "report"),
}
CONTINUED = ("run", "data", "train", "fit", "sweep", "servo")  # what keeps work that is half done
AGAIN = "the same command begins anew"
DRAWN = ("sensors", "stimuli")
OWN_OPTIONS = (
    *("--help", "--out", "--data", "--json", "--network", "--recordings", "--taps", "--slides", "--pairs"),
    "--sensor-from",
)
FIELDS_HELP = """
fields of the experiment, such as --train.epochs 5, --paired.stimuli disk,clover, --train.drops 40:0.2,80:0.1:
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command. Returns 0; 1 if a check does not hold; 2 after an error that the user can fix (one line); 130 when interrupted."""
    argv = sys.argv[1:] if argv is None else list(argv)
    warnings.formatwarning = _noted
    settle()
    try:
        return _run(argv)
    except UserError as error:
        return _complain(str(error))
    except KeyboardInterrupt:
        goes_on = bool(argv) and argv[0] in CONTINUED
        print(f"stopped; {'run the same command to continue' if goes_on else AGAIN}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stdout = None  # whoever read us has gone: nothing more can be said there
        return 141
    except Exception as error:
        if disk_is_full(error):
            return _complain("the disk is full; free some space, then run the same command")
        if isinstance(error, OSError) and error.filename is not None:
            return _complain(f"{error.filename}: {error.strerror}")
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            return _complain("out of memory; use a smaller --train.batch or smaller images")
        raise


def _noted(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    if issubclass(category, Note):
        return f"jaxunshear: note: {' '.join(str(message).split())}\n"
    return _usual(message, category, filename, lineno, line)


def _complain(text: str) -> int:
    print(f"jaxunshear: error: {' '.join(text.split())}", file=sys.stderr)
    return 2


class _Parser(argparse.ArgumentParser):
    """Refuses in one line, like everything else."""

    takes_fields = False

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see `{self.prog} --help`")

    def format_help(self) -> str:
        if not self.takes_fields:
            return super().format_help()
        from jaxunshear.config import field_types  # only for this: help must be quick

        groups: dict[str, list[str]] = {}
        for name, _ in field_types():
            groups.setdefault(name.rpartition(".")[0], []).append(name.rpartition(".")[2])
        lines = [f"  --{group + '.' if group else ''}{{{','.join(names)}}}" for group, names in groups.items()]
        return super().format_help() + FIELDS_HELP + "\n".join(lines) + "\n"


def _parser() -> _Parser:
    parser = _Parser(prog="jaxunshear", description="From a touch to an unsheared tactile image, in simulation.")
    parser.add_argument("--version", action="version", version=f"jaxunshear {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for name, text in (
        ("run", "all of the next three and the report; continues where a stopped run left off"),
        ("data", "simulate the two data sets"),
        ("train", "train the networks"),
        ("evaluate", "measure the networks on held-out poses"),
    ):
        usage = f"jaxunshear {name} FILE [options] [--field value ...]"
        command = commands.add_parser(name, help=text, description=text, usage=usage)
        command.takes_fields = True
        command.add_argument("file", metavar="FILE", type=Path, help="a Python file, such as experiments/demo.py")
        command.add_argument("--out", metavar="DIR", type=Path, default=Path("runs"), help="results: DIR/<name> (runs)")
        command.add_argument("--data", metavar="DIR", type=Path, default=Path("datasets"), help="data sets (datasets)")
        command.add_argument(
            "--recordings",
            metavar="DIR",
            type=Path,
            help="taps and slides that an experiment such as experiments/recorded.py is about",
        )
        _add_sensor(command)
        if name in ("run", "evaluate"):
            _add_json(command)
        if name == "train":
            command.add_argument("--network", metavar="NAME", help="only this one of the experiment's (default: all)")

    text = "fit networks to your own recordings: writes an experiment about them, and runs it"
    command = commands.add_parser(
        "fit", help=text, description=text, usage="jaxunshear fit --taps DIR --slides DIR [options] [--field value ...]"
    )
    command.takes_fields = True
    command.add_argument("--taps", metavar="DIR", type=Path, help="recorded taps")
    command.add_argument("--slides", metavar="DIR", type=Path, help="recorded slides")
    command.add_argument(
        "--pairs", metavar="FILE", type=Path, help="CSV with columns slide and tap: which belong together"
    )
    command.add_argument("--out", metavar="DIR", type=Path, default=Path("runs"), help="results: DIR/<name> (runs)")
    command.add_argument("--data", metavar="DIR", type=Path, default=Path("datasets"), help="data sets (datasets)")
    _add_json(command)

    text = "write the HTML page of a finished run"
    command = commands.add_parser("report", help=text, description=text)
    command.add_argument("run", metavar="RUN_DIR", type=Path, help="for example runs/demo")

    text = "show what the decoders make of swapped, blanked, shuffled and foreign codes (the paper's appendix D)"
    command = commands.add_parser("ablate", help=text, description=text)
    command.add_argument("run", metavar="RUN_DIR", type=Path, help="for example runs/demo")
    command.add_argument("--data", metavar="DIR", type=Path, default=Path("datasets"), help="data sets (datasets)")
    command.add_argument("--leakage", action="store_true", help="what each code holds that it should not, by probes")
    _add_json(command)

    text = "make weights with a model card of a finished run, for `unshear` and `pose`"
    command = commands.add_parser("release", help=text, description=text)
    command.add_argument("run", metavar="RUN_DIR", type=Path, help="for example runs/standard")
    command.add_argument(
        "--out", metavar="DIR", type=Path, required=True, help="a new folder; its name is the weights'"
    )

    for name, text in (
        ("unshear", "take the slide out of recorded images; also predicts their poses"),
        ("pose", "predict the poses of recorded images, as they are and unsheared"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("path", metavar="PATH", type=Path, help="an image, or a folder of recordings")
        cli_applications.add_model(command, cli_applications.SKIN)
        cli_applications.add_like(command)
        command.add_argument(
            "--force", action="store_true", help="answer images that are not of the model's sensor, too"
        )
        if name == "unshear":
            command.add_argument("--out", metavar="DIR", type=Path, required=True, help="for images and poses.csv")
        _add_json(command)

    cli_applications.add_parsers(commands)
    cli_recordings.add_parsers(commands)
    cli_sweep.add_parser(commands)
    cli_checks.add_parsers(commands)
    cli_validate.add_parser(commands)
    for name in DRAWN:
        text = f"list or draw the {name}"
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("action", choices=("list", "draw"), nargs="?", default="list")
        command.add_argument("name", metavar="NAME", nargs="?", help="what to draw")
        command.add_argument("--out", metavar="FILE", type=Path, help="PNG, SVG or PDF to draw to (default: NAME.png)")
    return parser


def _add_sensor(command: argparse.ArgumentParser) -> None:
    text = "a calibration.json of `jaxunshear calibrate`: its sensor, camera and friction in the simulated experiment"
    command.add_argument("--sensor-from", metavar="FILE", type=Path, help=text)


def _add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", metavar="FILE", type=Path, help="write what was measured, with machine and versions")


def _run(argv: list[str]) -> int:
    fields: list[str] = []
    words = argv
    if argv and argv[0] in (*STAGES, "sweep"):
        from jaxunshear.config import parse_overrides, split_overrides

        words, fields = split_overrides(
            argv, OWN_OPTIONS if argv[0] in STAGES else cli_sweep.OWN_OPTIONS, cli_sweep.FLAGS
        )
        parse_overrides(fields)  # before anything is read: a typo is refused at once
    try:
        arguments = _parser().parse_args(cli_checks.joined(list(words)))
    except SystemExit as leaving:  # --help and --version have printed
        return int(leaving.code or 0)
    check_links(vars(arguments).values())
    _check_places(arguments)
    if arguments.command not in (*DRAWN, "report"):
        check_environment()
    command = shlex.join(["jaxunshear", *argv])
    if arguments.command in STAGES:
        _stages(arguments, fields, command)
    elif arguments.command == "report":
        _report(arguments.run)
    elif arguments.command == "ablate":
        _ablate(arguments, command)
    elif arguments.command == "release":
        from jaxunshear.release import release

        print(release(arguments.run, arguments.out))
    elif arguments.command in ("unshear", "pose"):
        _infer(arguments)
    elif arguments.command == "sweep":
        return cli_sweep.run(arguments, fields, command)
    elif arguments.command in cli_applications.COMMANDS:
        return cli_applications.run(arguments, command)
    elif arguments.command in cli_recordings.COMMANDS:
        return cli_recordings.run(arguments, command)
    elif arguments.command in cli_checks.COMMANDS:
        return cli_checks.run(arguments, command)
    elif arguments.command in cli_validate.COMMANDS:
        return cli_validate.run(arguments, command)
    else:
        _catalogue(arguments)
    return 0


def _check_places(arguments: argparse.Namespace) -> None:
    """Refuses, before any work, places for results where these cannot be written or would replace what others live on."""
    json, out = getattr(arguments, "json", None), getattr(arguments, "out", None)
    check_apart(json, "--json")
    check_new_file(json)
    for option, value in vars(arguments).items():
        if json is not None and option != "json" and isinstance(value, Path) and value.resolve() == json.resolve():
            raise UserError(f"--json {json} is also what this command reads or writes: name another file")
    if arguments.command not in DRAWN:
        check_new_folder(out)
    if arguments.command not in (*STAGES, "sweep", *cli_applications.COMMANDS):  # these have folders of their own
        check_apart(out, "--out")


def _stages(arguments: argparse.Namespace, fields: list[str], command: str) -> None:
    from jaxunshear.experiment import trained
    from jaxunshear.infer import model_folder

    if arguments.command == "fit":
        experiment = _fitted(arguments, fields)
    elif arguments.command == "evaluate" and (folder := model_folder(arguments.file)).is_dir():
        arguments.file = folder
        experiment = _finished(arguments, fields)
        if arguments.recordings:
            _score(experiment, arguments, command)
            return
    else:
        experiment = _experiment(arguments.file, fields, str(arguments.recordings or ""), arguments.sensor_from)
    networks = trained(experiment)
    if getattr(arguments, "network", None):
        if arguments.network not in networks:
            raise UserError(f"--network {arguments.network} is none of this experiment's: use {', '.join(networks)}")
        networks = (arguments.network,)
    check_apart(getattr(arguments, "json", None), "--json", home=arguments.out / experiment.name)
    stages = [name for stage in STAGES[arguments.command] for name in (networks if stage == NETWORKS else (stage,))]
    from jaxunshear.memory import keep_freed_memory
    from jaxunshear.run import run_stages

    keep_freed_memory()
    results = run_stages(experiment, tuple(stages), out=arguments.out, data=arguments.data, command=command)
    if getattr(arguments, "json", None):
        from jaxunshear.evaluation.measurements import measurements
        from jaxunshear.storage import write_json

        write_json(arguments.json, measurements(results))


def _experiment(file: Path, fields: list[str], recordings: str = "", preset: Path | None = None) -> "Experiment":
    from jaxunshear.config import load_experiment, override, validate

    experiment = load_experiment(file)
    if preset:
        from jaxunshear.preset import with_preset

        experiment = with_preset(experiment, preset)
    experiment = override(experiment, fields)
    if recordings:
        from jaxunshear.fit import with_recordings

        experiment = with_recordings(experiment, recordings, recordings)
    validate(experiment)
    return experiment


def _fitted(arguments: argparse.Namespace, fields: list[str]) -> "Experiment":
    """The experiment that `fit` writes beside its results."""
    from jaxunshear.config import override, validate
    from jaxunshear.fit import BASE, with_recordings, write_experiment

    if not (arguments.taps or arguments.slides):
        raise UserError("name the folders of your recordings: --taps DIR --slides DIR")
    experiment = override(BASE, ["--name", "fit", *fields])
    words = (str(folder or "") for folder in (arguments.taps, arguments.slides, arguments.pairs))
    experiment = with_recordings(experiment, *words)
    validate(experiment)
    file = arguments.out / f"{experiment.name}.py"
    write_experiment(experiment, file)
    print(f"experiment: {file}")
    return experiment


def _finished(arguments: argparse.Namespace, fields: list[str]) -> "Experiment":
    """The experiment of a finished run, which is named by its folder."""
    from dataclasses import replace

    from jaxunshear.infer import load_settings

    if fields or arguments.sensor_from:
        asked = fields[0] if fields else "--sensor-from"
        raise UserError(
            f"{asked}: the settings of a finished run stay as they are; name its experiment file to change them"
        )
    experiment = load_settings(arguments.file)
    folder = arguments.file.resolve()
    arguments.out = folder.parent
    return replace(experiment, name=folder.name)


def _score(experiment: "Experiment", arguments: argparse.Namespace, command: str) -> None:
    from jaxunshear.applications.transfer import score_transfer
    from jaxunshear.evaluation.measurements import measurements
    from jaxunshear.evaluation.unseen import score_recordings, table
    from jaxunshear.experiment import recorded_of
    from jaxunshear.storage import write_json

    if recorded_of(experiment):
        results = score_recordings(experiment, arguments.file, arguments.recordings, arguments.data, command)
    else:
        results = score_transfer(experiment, arguments.file, arguments.recordings, command)
    print(table(results))
    if arguments.json:
        write_json(arguments.json, measurements(results))


def _report(run: Path) -> None:
    if not (run / "results.json").is_file():
        raise UserError(f"{run} holds no results.json: name the folder of a finished run, such as runs/demo")
    from jaxunshear.report.report import write_report

    print(write_report(run))


def _ablate(arguments: argparse.Namespace, command: str) -> None:
    from jaxunshear.config import from_json
    from jaxunshear.evaluation import ablation, exchange, leakage
    from jaxunshear.storage import read_json, write_json

    settings = arguments.run / "experiment.json"
    if not settings.is_file():
        raise UserError(
            f"{arguments.run} holds no experiment.json: name the folder of a finished run, such as runs/demo"
        )
    experiment = from_json(read_json(settings), str(settings))
    if arguments.leakage:
        from jaxunshear.report.leakage_figure import leakage_figure
        from jaxunshear.storage import write_bytes

        results = leakage.leakage(experiment, arguments.run, arguments.data, command)
        drawn = exchange.exchanged(experiment, arguments.run, arguments.data)
        write_bytes(arguments.run / "leakage.png", leakage_figure(results, drawn))
        print(leakage.table(results))
        print(arguments.run / "leakage.png")
    else:
        results = ablation.ablate(experiment, arguments.run, arguments.data, command)
        print(ablation.table(results["rows"]))
        print(arguments.run / "ablation.png")
    if arguments.json:
        write_json(arguments.json, results)


def _infer(arguments: argparse.Namespace) -> None:
    from jaxunshear import infer

    if arguments.command == "unshear":
        measured = infer.unshear_recordings(
            arguments.path, arguments.model, arguments.out, force=arguments.force, like=arguments.like
        )
    else:
        measured = infer.pose_of_recordings(arguments.path, arguments.model, force=arguments.force, like=arguments.like)
    if arguments.json:
        from jaxunshear.storage import write_json

        write_json(arguments.json, measured)


def _catalogue(arguments: argparse.Namespace) -> None:
    from jaxunshear import catalogue

    if arguments.action == "list":
        if arguments.name or arguments.out:
            raise UserError(f"`list` takes nothing more; to draw: jaxunshear {arguments.command} draw NAME --out FILE")
        print(catalogue.listing(arguments.command))
        return
    if not arguments.name:
        raise UserError(f"name what to draw: {', '.join(catalogue.names(arguments.command))}")
    out = arguments.out or Path(f"{arguments.name}.png")
    catalogue.draw(arguments.command, arguments.name, out)
    print(out)
