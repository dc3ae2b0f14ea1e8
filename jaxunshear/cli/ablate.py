"""Command `jaxunshear ablate`: what the decoders make of codes, and what codes leak."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import Commands, add_data, add_json, new_parser
from jaxunshear.errors import UserError

COMMANDS = ("ablate",)


def add_parsers(commands: Commands) -> None:
    text = (
        "show what the decoders make of swapped, blanked and foreign codes (the paper's appendix D)"
    )
    parser = new_parser(commands, "ablate", text)
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="for example runs/demo")
    add_data(parser)
    parser.add_argument(
        "--leakage", action="store_true", help="what each code holds that it should not, by probes"
    )
    add_json(parser)


def run(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.config.serialization import from_json
    from jaxunshear.evaluation import code_exchange, code_swaps, leakage, leakage_table
    from jaxunshear.files import read_object, write_bytes, write_json

    settings = arguments.run / "experiment.json"
    if not settings.is_file():
        raise UserError(
            f"{arguments.run} holds no experiment.json: name the folder of a finished run, "
            "such as runs/demo"
        )
    experiment = from_json(read_object(settings), str(settings))
    if arguments.leakage:
        from jaxunshear.report.leakage_figure import plot_leakage

        results = leakage.measure_leakage(experiment, arguments.run, arguments.data, command)
        exchange = code_exchange.exchange_codes(experiment, arguments.run, arguments.data)
        write_bytes(arguments.run / "leakage.png", plot_leakage(results, exchange))
        print(leakage_table.format_table(results))
        print(arguments.run / "leakage.png")
    else:
        results = code_swaps.ablate(experiment, arguments.run, arguments.data, command)
        print(code_swaps.format_table(results["rows"]))
    if arguments.json:
        write_json(arguments.json, results)
    return 0
