"""Commands and their options as data.

An option is a name and what argparse takes of it; a list among the options of a command holds some
of which only one may be given.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.errors import UserError

Commands: TypeAlias = "argparse._SubParsersAction[Any]"  # of a command line, to add one to
Option = tuple[str, dict[str, Any]]
Run = Callable[[argparse.Namespace, str], int]  # arguments, command line -> exit code

ROWS = "the rows, with command, machine and versions"  # what `--json` writes for benchmarks
DEFAULT_RAY_CORES = 2  # for each row or chunk


@dataclass(frozen=True)
class Command:
    name: str
    help: str
    run: Run
    options: tuple[Option | list[Option], ...] = ()
    takes_fields: str = ""  # what it takes beside fields of an experiment, if it takes these
    is_resumable: bool = False  # continues where it stopped
    checks_out: bool = True  # --out may not lie in a run; else `run` checks it
    computes: bool = True  # results, which depend on the environment and on the code

    def list_options(self) -> list[Option]:
        flat: list[Option] = []
        for each in self.options:
            flat += each if isinstance(each, list) else [each]
        return flat

    def add_to(self, commands: Commands) -> None:
        parser = new_parser(commands, self.name, self.help)
        if self.takes_fields:
            start = f"jaxunshear {self.name} {self.takes_fields}"
            parser.usage = f"{start} [options] [--field value ...]"
            parser.set_defaults(takes_fields=True)
        for each in self.options:
            if isinstance(each, list):
                group = parser.add_mutually_exclusive_group()
                for name, settings in each:
                    group.add_argument(name, **settings)
            else:
                parser.add_argument(each[0], **each[1])


def new_parser(commands: Commands, name: str, text: str) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=text, description=text)


def option(name: str, metavar: str, text: str, **settings: Any) -> Option:
    return name, {"metavar": metavar, "help": text, **settings}


def path(name: str, metavar: str, text: str, **settings: Any) -> Option:
    return option(name, metavar, text, type=Path, **settings)


def integer(name: str, text: str, default: int | None = None) -> Option:
    return option(name, "N", text, type=int, default=default)


def flag(name: str, text: str) -> Option:
    return name, {"action": "store_true", "help": text}


def json_file(content: str = "what was measured, with machine and versions") -> Option:
    return path("--json", "FILE", f"write {content}")


def add_json(parser: argparse.ArgumentParser, content: str) -> None:
    name, settings = json_file(content)
    parser.add_argument(name, **settings)


def model_dir(default: str = "standard") -> Option:
    text = f"a finished run (runs/demo), or released weights by name ({default})"
    return path("--model", "DIR", text, default=Path(default))


DATA = path("--data", "DIR", "data sets (datasets)", default=Path("datasets"))
RUN_DIR = path("run", "RUN_DIR", "for example runs/demo")
CAMERA_MODEL = (  # trained for recordings, and what it needs to read them
    model_dir("skin"),
    path(
        "--like",
        "DIR",
        "contacts of the same sensor and camera, whose mean shows where pins stand "
        "(default: the frames themselves)",
    ),
    flag("--force", "answer images that are not of the model's sensor, too"),
)
STIMULUS = option(
    "--stimulus", "NAME,FILE", "which objects, outlines in files among them (all)", default="all"
)
EXPERIMENT = (  # the recordings and the sensor that an experiment in a file is about
    path(
        "--recordings",
        "DIR",
        "taps and slides that an experiment such as experiments/recorded.py is about",
    ),
    path(
        "--sensor-from",
        "FILE",
        "a calibration.json of `jaxunshear calibrate`: its sensor, camera and friction "
        "in the simulated experiment",
    ),
)


def engine(piece: str) -> tuple[Option, ...]:
    """Return the options of who runs the pieces of a command, for `read_engine_options`."""
    text = f"one {piece} after the other, or all over a Ray cluster (serial)"
    return (
        ("--engine", {"choices": ("serial", "ray"), "default": "serial", "help": text}),
        option("--ray-address", "ADDRESS", "of a Ray cluster (default: one on this machine)"),
        integer("--ray-cores", f"cores that a {piece} takes of the cluster ({DEFAULT_RAY_CORES})"),
    )


def read_engine_options(arguments: argparse.Namespace) -> tuple[str | None, int] | None:
    """Return address and cores of `--engine ray`; None for the serial one. Raises UserError."""
    if "engine" not in arguments:
        return None
    address, cores = arguments.ray_address, arguments.ray_cores
    if arguments.engine != "ray" and (address is not None or cores is not None):
        raise UserError("--ray-address and --ray-cores go with --engine ray")
    if cores is not None and cores < 1:
        raise UserError(f"--ray-cores {cores}: use at least 1")
    return (address, cores or DEFAULT_RAY_CORES) if arguments.engine == "ray" else None


def parse_stimuli(text: str) -> tuple[StimulusSetting, ...]:
    """Return the objects that --stimulus names. Raises UserError."""
    from jaxunshear.simulator.stimuli import SHAPES, get_closed_stimulus

    names = SHAPES if text == "all" else text.split(",")
    stimuli = tuple(parse_stimulus(name.strip()) for name in names)
    for stimulus in stimuli:
        get_closed_stimulus(stimulus)
    if len(set(list_stimulus_names(stimuli))) < len(stimuli):
        raise UserError(f"--stimulus {text}: name each once")
    return stimuli


def choose_exit_code(used: float, left_out: float) -> int:
    """Return 1 if half of the images or more are left out: that is no success."""
    return int(left_out >= used)
