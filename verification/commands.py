"""The commands of `python -m verification`, which import heavy modules when needed."""

import argparse
import sys
from collections.abc import Callable, Sequence

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

COMMANDS = {
    "verify": "compare the simulator with closed forms, conservation laws and independent solvers",
    "stability": "run stiff, extreme and senseless contacts, "
    "and networks and trainings at their extremes",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of COMMANDS and return its exit code: 1 where a check does not hold."""
    words = sys.argv[1:] if argv is None else list(argv)
    return report_errors(lambda: run_tool(make_parser(), words, _run))


def make_parser() -> Parser:
    """Make the parser of COMMANDS."""
    parser = Parser(
        prog="python -m verification", description="Examines the simulator and the networks."
    )
    commands = add_commands(parser)
    parsers = {name: new_parser(commands, name, text) for name, text in COMMANDS.items()}
    text = "only those whose name contains one of these"
    for each in parsers.values():
        add_json(each, ROWS)
        each.add_argument("--only", metavar="NAME", nargs="+", default=(), help=text)
    return parser


def _run(arguments: argparse.Namespace, keep: Keep) -> int:
    return _RUN[arguments.command](arguments, keep)


def _verify(arguments: argparse.Namespace, keep: Keep) -> int:
    from verification import verify
    from verification.verification_rows import convert_row, format_rows

    rows = verify.run_verification(arguments.only)
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


_RUN: dict[str, Callable[[argparse.Namespace, Keep], int]] = {
    "verify": _verify,
    "stability": _stability,
}
