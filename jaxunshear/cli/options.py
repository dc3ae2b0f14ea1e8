"""Options that several commands share."""

import argparse
from pathlib import Path
from typing import Any, TypeAlias

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.errors import UserError

Commands: TypeAlias = "argparse._SubParsersAction[Any]"  # of a command line, to add one to
Model = tuple[Path, Experiment]  # the folder and the settings of trained networks
DEFAULT, SKIN = (
    Path("standard"),
    Path("skin"),
)  # of the released weights, for simulated touches and for recorded ones
DEFAULT_RAY_CORES = 2  # for each row or chunk
ROWS = "the rows, with command, machine and versions"  # what `--json` writes, of commands that measure in rows


def new_parser(
    commands: Commands, name: str, text: str, usage: str | None = None
) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=text, description=text, usage=usage)


def add_json(
    parser: argparse.ArgumentParser, content: str = "what was measured, with machine and versions"
) -> None:
    parser.add_argument("--json", metavar="FILE", type=Path, help=f"write {content}")


def add_results(parser: argparse.ArgumentParser, out: str, content: str = ROWS) -> None:
    """A folder and a file; `out` says for what in the folder."""
    parser.add_argument("--out", metavar="DIR", type=Path, help=out)
    add_json(parser, content)


def add_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", metavar="DIR", type=Path, default=Path("datasets"), help="data sets (datasets)"
    )


def add_base(parser: argparse.ArgumentParser) -> None:
    """What an experiment in a file is about, in the place of what the file says."""
    text = "taps and slides that an experiment such as experiments/recorded.py is about"
    parser.add_argument("--recordings", metavar="DIR", type=Path, help=text)
    text = "a calibration.json of `jaxunshear calibrate`: its sensor, camera and friction in the simulated experiment"
    parser.add_argument("--sensor-from", metavar="FILE", type=Path, help=text)


def add_model(parser: argparse.ArgumentParser, default: Path = DEFAULT) -> None:
    parser.add_argument(
        "--model",
        metavar="DIR",
        type=Path,
        default=default,
        help=f"a finished run (runs/demo), or released weights by name ({default})",
    )


def add_like(parser: argparse.ArgumentParser) -> None:
    text = "contacts of the same sensor and camera, whose mean shows where pins stand (default: the frames themselves)"
    parser.add_argument("--like", metavar="DIR", type=Path, help=text)


def add_stimulus(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stimulus",
        metavar="NAME,FILE",
        default="all",
        help="which objects, outlines in files among them (all)",
    )


def parse_stimuli(text: str) -> tuple[StimulusSetting, ...]:
    """The objects that --stimulus names. Raises UserError."""
    from jaxunshear.simulator.stimuli import SHAPES, get_closed_stimulus

    found = tuple(
        parse_stimulus(name.strip()) for name in (SHAPES if text == "all" else text.split(","))
    )
    for one in found:
        get_closed_stimulus(one)
    if len(set(list_stimulus_names(found))) < len(found):
        raise UserError(f"--stimulus {text}: name each once")
    return found


def add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--force", action="store_true", help="answer images that are not of the model's sensor, too"
    )


def choose_exit_code(used: float, left_out: float) -> int:
    """Return 1 where half of the images or more are left out: what is said of the others is no success."""
    return int(left_out >= used)


def add_engine(parser: argparse.ArgumentParser, piece: str) -> None:
    """Who does the pieces of a command; `read_engine_options` reads it."""
    text = f"one {piece} after the other, or all over a Ray cluster (serial)"
    parser.add_argument("--engine", choices=("serial", "ray"), default="serial", help=text)
    parser.add_argument(
        "--ray-address", metavar="ADDRESS", help="of a Ray cluster (default: one on this machine)"
    )
    parser.add_argument(
        "--ray-cores",
        metavar="N",
        type=int,
        help=f"cores that a {piece} takes of the cluster ({DEFAULT_RAY_CORES})",
    )


def read_engine_options(arguments: argparse.Namespace) -> tuple[str | None, int] | None:
    """Address and cores of `--engine ray`; None for the serial one. Raises UserError."""
    address, cores = arguments.ray_address, arguments.ray_cores
    if arguments.engine != "ray" and (address is not None or cores is not None):
        raise UserError("--ray-address and --ray-cores go with --engine ray")
    if cores is not None and cores < 1:
        raise UserError(f"--ray-cores {cores}: use at least 1")
    return (address, cores or DEFAULT_RAY_CORES) if arguments.engine == "ray" else None
