"""Commands about finished runs: report, compare, release, ablate."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import DATA, RUN_DIR, Command, flag, json_file, path
from jaxunshear.errors import UserError

COMPARE_OUT = Path("runs/compare")


def report(arguments: argparse.Namespace, command: str) -> int:
    if not (arguments.run / "results.json").is_file():
        raise UserError(
            f"{arguments.run} holds no results.json: name the folder of a finished run, "
            "such as runs/demo"
        )
    from jaxunshear.report.report import write_report

    print(write_report(arguments.run))
    return 0


def compare(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.compare import write_comparison

    text, page = write_comparison(arguments.runs, arguments.out)
    print(text)
    print(f"page: {page}")
    return 0


def release(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.release import release

    print(release(arguments.run, arguments.out))
    return 0


def ablate(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.evaluation import code_swaps, codes, leakage
    from jaxunshear.files import write_bytes, write_json
    from jaxunshear.model_folders import load_settings

    experiment = load_settings(arguments.run)
    if arguments.leakage:
        from jaxunshear.report.leakage_figure import plot_leakage

        results = leakage.measure_leakage(experiment, arguments.run, arguments.data, command)
        exchange = codes.exchange_codes(experiment, arguments.run, arguments.data)
        write_bytes(arguments.run / "leakage.png", plot_leakage(results, exchange))
        print(leakage.format_table(results))
        print(arguments.run / "leakage.png")
    else:
        results = code_swaps.ablate(experiment, arguments.run, arguments.data, command)
        print(code_swaps.format_table(results["rows"]))
    if arguments.json:
        write_json(arguments.json, results)
    return 0


COMMANDS = (
    Command("report", "write the HTML page of a finished run", report, (RUN_DIR,), computes=False),
    Command(
        "compare",
        "finished runs side by side: settings that differ, scores with intervals, times",
        compare,
        (
            path("runs", "RUN", "folders of runs; the first is the reference", nargs="+"),
            path("--out", "DIR", f"where the page goes ({COMPARE_OUT})", default=COMPARE_OUT),
        ),
    ),
    Command(
        "release",
        "make weights with a model card of a finished run, for `unshear` and `pose`",
        release,
        (
            path("run", "RUN_DIR", "for example runs/standard"),
            path("--out", "DIR", "a new folder; its name is the weights'", required=True),
        ),
    ),
    Command(
        "ablate",
        "show what the decoders make of swapped, blanked and foreign codes "
        "(the paper's appendix D)",
        ablate,
        (
            RUN_DIR,
            DATA,
            flag("--leakage", "what each code holds that it should not, by probes"),
            json_file(),
        ),
    ),
)
