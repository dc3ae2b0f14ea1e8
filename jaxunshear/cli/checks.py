"""The commands that examine the simulator and the networks: parsers, calls and tables. Everything heavy is imported when it is needed."""

import argparse
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxunshear.cli import bench
from jaxunshear.cli.bench import Keep
from jaxunshear.cli.options import ROWS, Commands, add_json, new_parser
from jaxunshear.contact.level import LEVELS
from jaxunshear.errors import UserError
from jaxunshear.storage import Json

COMMANDS = {
    "verify": "compare the simulator with closed forms, conservation laws and independent solvers",
    "stability": "run stiff, extreme and senseless contacts, and networks and trainings at their extremes",
    "bench": "error against run time",
    "plan": "show what a contact needs, and what leaving out the rest saves and costs",
    "identify": "find friction and stiffness from simulated pins by gradient descent",
}
_CONTACT: Json = {"stimulus": "disk", "pose": "0,0,0,3", "move": "0,0", "twist": 0.0, "tilt": "0,0"}  # of plan


def add_parsers(commands: Commands) -> None:
    parsers = {name: new_parser(commands, name, text) for name, text in COMMANDS.items()}
    for parser in parsers.values():
        add_json(parser, ROWS)
    parser = parsers["plan"]
    parser.add_argument("--stimulus", metavar="NAME", help="what is touched, or an outline's file (disk)")
    parser.add_argument("--pose", metavar="X,Y,YAW,DEPTH", help="mm, mm, deg, mm (0,0,0,3)")
    parser.add_argument("--move", metavar="DX,DY", help="slide that ends at the pose, mm (0,0)")
    parser.add_argument("--twist", metavar="DEG", type=float, help="turn that ends at the pose (0)")
    parser.add_argument("--tilt", metavar="TX,TY", help="deg (0,0)")
    parser.add_argument("--friction", metavar="MU", type=float, help="0 to inf (default: that of the stimulus)")
    parser.add_argument("--level", choices=tuple(LEVELS), default="auto", help="(auto)")
    parser.add_argument("--sensor", metavar="NAME", default="tactip331", help="(tactip331)")
    parser.add_argument("--scenes", metavar="N", type=int, help="instead: how N random scenes of the paper are grouped")

    parsers["stability"].add_argument("--only", metavar="NAME", help="only the cases whose name contains this")

    parser = parsers["bench"]
    parser.add_argument("--out", metavar="DIR", type=Path, help="sim: folder for the figure")
    parser.add_argument(
        "what",
        choices=tuple(bench.OPTIONS),
        help="the simulator, the networks, parts left out, pins of images, a robot's perception, the "
        "making of a data set, whether training waits for its examples, or pictures of `explore`",
    )
    parser.add_argument("--level", choices=tuple(LEVELS), help="sim: only rows of this level")
    parser.add_argument(
        "--batch", metavar="N", type=int, help="sim, train, infer: only rows with N scenes or images in a batch"
    )
    parser.add_argument("--size", metavar="PX", type=int, help="all but sim: only images of this size")
    parser.add_argument("--seed", metavar="N", type=int, help="pins: of the contacts (0)")

    parsers["identify"].add_argument("--out", metavar="DIR", type=Path, help="folder for the figure")


def joined(argv: list[str]) -> list[str]:
    """`--pose -1,0,0,3` as one word: argparse takes a value that begins with a minus for an option."""
    words: list[str] = []
    for word in argv:
        if words and words[-1] in ("--pose", "--move", "--tilt") and re.match(r"-[\d.]", word):
            words[-1] += f"={word}"
        else:
            words.append(word)
    return words


def run(arguments: argparse.Namespace, command: str) -> int:
    """Runs one of `add_parsers`' commands. Returns 0, or 1 where a check does not hold."""
    rivals = ("torch",) if arguments.command == "bench" else ()  # timed beside ours
    return _RUN[arguments.command](arguments, _writer(arguments.json, command, rivals))


def _writer(file: Path | None, command: str, rivals: Sequence[str]) -> Keep:
    """Keeps rows in `file`, if there is one; called again it replaces what it wrote."""

    def keep(rows: list[Json]) -> None:
        if file is None:
            return
        from jaxunshear.metrics.machine import provenance
        from jaxunshear.storage import write_json

        write_json(file, provenance(command, *rivals) | {"rows": rows})

    return keep


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count:
        raise UserError(f"{option} {text}: give {count} numbers with commas between them")
    return values


def _verify(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.progress import Progress
    from jaxunshear.verification import verify
    from jaxunshear.verification.tables import as_dict, table

    with Progress("verify", len(verify.CHECKS), unit="checks") as progress:
        rows = verify.verify(progress)
    print(table(rows))
    keep([as_dict(row) for row in rows])
    missed = [row.problem for row in rows if not row.holds]
    print(f"\n{len(rows)} rows, {len(missed)} do not hold{': ' if missed else ''}{', '.join(missed)}")
    return 1 if missed else 0


def _stability(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.verification import stability

    rows = stability.stability(arguments.only)
    print(stability.table(rows))
    keep(stability.as_dicts(rows))
    return 1 if stability.failed(rows) else 0


def _plan(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.settings.sensor import sensor_named
    from jaxunshear.verification import show_plan

    given, sensor = vars(arguments), sensor_named(arguments.sensor)
    if arguments.scenes is not None:
        for option in (*_CONTACT, "friction"):
            if given[option] is not None:
                raise UserError(
                    f"--{option}: plan --scenes draws its own contacts; it takes --level, --sensor and --json"
                )
        shown = show_plan.show_grouping(arguments.scenes, arguments.level, sensor)
    else:
        one = {option: usual if given[option] is None else given[option] for option, usual in _CONTACT.items()}
        shown = show_plan.show_plan(
            one["stimulus"],
            _numbers(one["pose"], 4, "--pose"),
            _numbers(one["move"], 2, "--move"),
            one["twist"],
            _numbers(one["tilt"], 2, "--tilt"),
            arguments.friction,
            arguments.level,
            sensor,
        )
    print(shown.text)
    keep(shown.rows)
    return 0


def _identify(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.calibration import identify

    found = identify.run(arguments.out)
    print(found["text"])
    keep(found["rows"])
    return 0


_RUN: dict[str, Callable[[argparse.Namespace, Keep], int]] = {
    "verify": _verify,
    "stability": _stability,
    "bench": bench.run,
    "plan": _plan,
    "identify": _identify,
}
