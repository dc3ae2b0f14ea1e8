"""The commands of `python -m verification`, which import heavy modules when needed."""

import argparse
import re
import sys
from collections.abc import Callable, Sequence

from jaxunshear.cli.options import ROWS, add_json, new_parser
from jaxunshear.cli.program import Keep, Parser, add_commands, report_errors, run_tool
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.simulator.level import LEVELS

COMMANDS = {
    "verify": "compare the simulator with closed forms, conservation laws and independent solvers",
    "stability": "run stiff, extreme and senseless contacts, "
    "and networks and trainings at their extremes",
    "plan": "show what a contact needs, and what leaving out the rest saves and costs",
}
# what `plan` shows by default
_CONTACT: Json = {
    "stimulus": "disk",
    "pose": "0,0,0,3",
    "move": "0,0",
    "twist": 0.0,
    "tilt": "0,0",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of COMMANDS and return its exit code: 1 where a check does not hold."""
    words = sys.argv[1:] if argv is None else list(argv)
    return report_errors(lambda: run_tool(make_parser(), join_numbers(words), _run))


def make_parser() -> Parser:
    """Make the parser of COMMANDS."""
    parser = Parser(
        prog="python -m verification", description="Examines the simulator and the networks."
    )
    commands = add_commands(parser)
    parsers = {name: new_parser(commands, name, text) for name, text in COMMANDS.items()}
    for each in parsers.values():
        add_json(each, ROWS)
    text = "only the cases whose name contains this"
    parsers["stability"].add_argument("--only", metavar="NAME", help=text)

    plan = parsers["plan"]
    plan.add_argument(
        "--stimulus", metavar="NAME", help="what is touched, or an outline's file (disk)"
    )
    plan.add_argument("--pose", metavar="X,Y,YAW,DEPTH", help="mm, mm, deg, mm (0,0,0,3)")
    plan.add_argument("--move", metavar="DX,DY", help="slide that ends at the pose, mm (0,0)")
    plan.add_argument("--twist", metavar="DEG", type=float, help="turn that ends at the pose (0)")
    plan.add_argument("--tilt", metavar="TX,TY", help="deg (0,0)")
    plan.add_argument(
        "--friction", metavar="MU", type=float, help="0 to inf (default: that of the stimulus)"
    )
    plan.add_argument("--level", choices=tuple(LEVELS), default="auto", help="(auto)")
    plan.add_argument("--sensor", metavar="NAME", default="tactip331", help="(tactip331)")
    text = "instead: how N random scenes of the paper are grouped"
    plan.add_argument("--scenes", metavar="N", type=int, help=text)
    return parser


def join_numbers(words: Sequence[str]) -> list[str]:
    """Join `--pose -1,0,0,3` into one word.

    argparse takes a value that begins with a minus for an option.
    """
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in ("--pose", "--move", "--tilt") and re.match(r"-[\d.]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _run(arguments: argparse.Namespace, keep: Keep) -> int:
    return _RUN[arguments.command](arguments, keep)


def _parse_numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count:
        raise UserError(f"{option} {text}: give {count} numbers with commas between them")
    return values


def _verify(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.progress import Progress
    from verification import verify
    from verification.verification_rows import convert_row, format_rows

    with Progress("verify", len(verify.CHECKS), unit="checks") as progress:
        rows = verify.run_verification(progress)
    print(format_rows(rows))
    keep([convert_row(row) for row in rows])
    missed = [row.problem for row in rows if not row.holds]
    names = f": {', '.join(missed)}" if missed else ""
    print(f"\n{len(rows)} rows, {len(missed)} do not hold{names}")
    return 1 if missed else 0


def _stability(arguments: argparse.Namespace, keep: Keep) -> int:
    from verification import stability

    rows = stability.run_stability(arguments.only)
    print(stability.format_table(rows))
    keep(stability.as_dicts(rows))
    return 1 if stability.select_failed(rows) else 0


def _plan(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.config.sensor import get_sensor
    from verification import plan_report

    options, sensor = vars(arguments), get_sensor(arguments.sensor)
    if arguments.scenes is not None:
        for option in (*_CONTACT, "friction"):
            if options[option] is not None:
                raise UserError(
                    f"--{option}: plan --scenes draws its own contacts; "
                    "it takes --level, --sensor and --json"
                )
        report = plan_report.show_grouping(arguments.scenes, arguments.level, sensor)
    else:
        values = {
            option: default if options[option] is None else options[option]
            for option, default in _CONTACT.items()
        }
        contact = plan_report.PlannedContact(
            values["stimulus"],
            _parse_numbers(values["pose"], 4, "--pose"),
            _parse_numbers(values["move"], 2, "--move"),
            values["twist"],
            _parse_numbers(values["tilt"], 2, "--tilt"),
            arguments.friction,
        )
        report = plan_report.show_plan(contact, arguments.level, sensor)
    print(report.text)
    keep(report.rows)
    return 0


_RUN: dict[str, Callable[[argparse.Namespace, Keep], int]] = {
    "verify": _verify,
    "stability": _stability,
    "plan": _plan,
}
