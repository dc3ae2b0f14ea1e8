"""Commands that put networks to use: where their results go, and what is stored with them."""

import argparse
import sys
from pathlib import Path
from types import ModuleType

from jaxunshear.cli import geometry, pins, reconstruct, servo, stream
from jaxunshear.cli.options import Commands, Model, choose_exit_code
from jaxunshear.output_checks import check_new_folder
from jaxunshear.protected_folders import check_outside
from jaxunshear.results.applications import StreamResult
from jaxunshear.results.folders import find_results_folder

APPLICATIONS: dict[str, ModuleType] = {
    "pins": pins,
    "geometry": geometry,
    "servo": servo,
    "reconstruct": reconstruct,
    "stream": stream,
}
COMMANDS = tuple(APPLICATIONS)


def add_parsers(commands: Commands) -> None:
    for application in APPLICATIONS.values():
        application.add_parser(commands)


def run(arguments: argparse.Namespace, command: str) -> int:
    """Run one of COMMANDS. Return the exit code.

    Results of a finished run's networks go to its own folder, where its report finds them, unless
    --out names another.
    """
    from jaxunshear.allocator import keep_freed_memory

    keep_freed_memory()
    model = _load_model(arguments) if arguments.model else None
    finished = model is not None and (model[0] / "results.json").is_file()
    home = find_results_folder(model[0] if model and finished else Path(), arguments.command)
    out = home if arguments.command == "stream" else arguments.out or home
    check_new_folder(out)
    if out.resolve() != home.resolve():
        check_outside(out, "--out")
    outcome = APPLICATIONS[arguments.command].run(arguments, out, model)
    from jaxunshear.metrics.machine import describe_provenance
    from jaxunshear.results.record_files import write_record
    from jaxunshear.results.training_summaries import read_training_facts

    results = describe_provenance(command) | vars(outcome)
    if model:
        results |= read_training_facts(model[0], model[1].networks)
    if arguments.json:
        write_record(arguments.json, results)
    if arguments.command != "stream" or finished:
        write_record(out / f"{arguments.command}.json", results)
    if model and finished and out == home:
        from jaxunshear.report.report import write_report

        print(write_report(model[0]), file=sys.stderr)
    if isinstance(outcome, StreamResult):
        return choose_exit_code(outcome.used, outcome.skipped)
    return 0


def _load_model(arguments: argparse.Namespace) -> Model:
    from jaxunshear.model_folders import find_model_folder, load_settings

    folder = find_model_folder(arguments.model)
    return folder, load_settings(folder)
