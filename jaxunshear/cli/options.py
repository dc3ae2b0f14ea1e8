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
# released weights, for simulated contacts and for recorded ones
DEFAULT, SKIN = Path("standard"), Path("skin")
DEFAULT_RAY_CORES = 2  # for each row or chunk
ROWS = "the rows, with command, machine and versions"  # what `--json` writes for benchmarks


def new_parser(
    commands: Commands, name: str, text: str, usage: str | None = None
) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=text, description=text, usage=usage)


def add_json(
    parser: argparse.ArgumentParser, content: str = "what was measured, with machine and versions"
) -> None:
    parser.add_argument("--json", metavar="FILE", type=Path, help=f"write {content}")


def add_results(parser: argparse.ArgumentParser, out: str, content: str = ROWS) -> None:
    """Add --out, whose help is `out`, and --json."""
    parser.add_argument("--out", metavar="DIR", type=Path, help=out)
    add_json(parser, content)


def add_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", metavar="DIR", type=Path, default=Path("datasets"), help="data sets (datasets)"
    )


def add_base(parser: argparse.ArgumentParser) -> None:
    """Add the recordings and the sensor that an experiment in a file is about."""
    text = "taps and slides that an experiment such as experiments/recorded.py is about"
    parser.add_argument("--recordings", metavar="DIR", type=Path, help=text)
    text = (
        "a calibration.json of `jaxunshear calibrate`: its sensor, camera and friction "
        "in the simulated experiment"
    )
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
    text = (
        "contacts of the same sensor and camera, whose mean shows where pins stand "
        "(default: the frames themselves)"
    )
    parser.add_argument("--like", metavar="DIR", type=Path, help=text)


def add_stimulus(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stimulus",
        metavar="NAME,FILE",
        default="all",
        help="which objects, outlines in files among them (all)",
    )


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


def add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--force", action="store_true", help="answer images that are not of the model's sensor, too"
    )


def choose_exit_code(used: float, left_out: float) -> int:
    """Return 1 if half of the images or more are left out: that is no success."""
    return int(left_out >= used)


def add_engine(parser: argparse.ArgumentParser, piece: str) -> None:
    """Add the options of who runs the pieces of a command, for `read_engine_options`."""
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
    """Return address and cores of `--engine ray`; None for the serial one. Raises UserError."""
    address, cores = arguments.ray_address, arguments.ray_cores
    if arguments.engine != "ray" and (address is not None or cores is not None):
        raise UserError("--ray-address and --ray-cores go with --engine ray")
    if cores is not None and cores < 1:
        raise UserError(f"--ray-cores {cores}: use at least 1")
    return (address, cores or DEFAULT_RAY_CORES) if arguments.engine == "ray" else None
