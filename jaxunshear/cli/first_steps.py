"""Commands to begin with, which need no training: demo-data, show."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from jaxunshear.cli.models import IMAGES, LIKE, UNTOUCHED, choose_exit_code
from jaxunshear.cli.program import define_command, integer, path
from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes
from jaxunshear.output_checks import check_new_picture, check_not_among, check_outside
from jaxunshear.progress import Progress

if TYPE_CHECKING:
    from jaxunshear.inference.trained_model import TrainedModel

DEFAULT_MODELS = (Path("skin"), Path("skin127"))  # for 331 and for 127 pins
NEXT_STEPS = """\
{folder}: 331_pins, 127_pins and, of a flat pad, 165_markers;
each with edge (taps and slides), camera and untouched; try
  jaxunshear doctor {folder}/331_pins/edge
  jaxunshear show {folder}/331_pins/edge/shear
  jaxunshear fit --taps {folder}/331_pins/edge/tap --slides {folder}/331_pins/edge/shear \
--unshear.input pins"""


@define_command(
    "write a small simulated recording with labels, to try the other commands on",
    path("folder", "DIR", "a new or an empty folder"),
    integer(
        "--contacts",
        "taps, and as many slides, of 331 pins; of other sensors a fifth (default: 300)",
        300,
    ),
    integer("--seed", "seed of poses, slides and noise (default: 0)", 0),
    name="demo-data",
)
def write_demo_data(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.demo_data import write_demo_data

    write_demo_data(arguments.folder, arguments.contacts, arguments.seed)
    print(NEXT_STEPS.format(folder=arguments.folder))
    return 0


@define_command(
    "draw a few frames: sheared, unsheared, motion of the pins, poses and contact",
    path("path", "RECORDINGS", IMAGES),
    path(
        "model",
        "MODEL",
        "a finished run, or released weights (default: skin, or skin127 for 127 pins)",
        nargs="?",
    ),
    LIKE,
    UNTOUCHED,
    path("--out", "FILE", "PNG file (default: show_NAME.png)", dest="file"),
    name="show",
)
def show_frames(arguments: argparse.Namespace, command: str) -> int:
    path = arguments.path
    if not path.exists():
        raise UserError(f"{path} does not exist: name {IMAGES}")
    out = arguments.file or Path(f"show_{path.resolve().stem}.png")
    check_not_among(path, out.parent, "--out")
    check_outside(out, "--out")
    from jaxunshear.inference.infer import adapt_to_dome
    from jaxunshear.report import show

    check_new_picture(out, show.PNG_SOFTWARE)
    with Progress("show", 3, "steps") as progress:
        model = _load_model(path, arguments)
        adapt_to_dome(model, arguments.untouched)
        progress.advance()
        frames = show.predict_frames(path, model)
        progress.advance()
        write_bytes(out, show.plot_frames(frames, model))
        progress.advance()
    for frame in frames:
        print("\n  ".join([f"{frame.name}: {frame.sentence}", *show.format_poses(frame.poses)]))
    print(out)
    return choose_exit_code(len(frames), sum(frame.unsheared is None for frame in frames))


def _load_model(path: Path, arguments: argparse.Namespace) -> "TrainedModel":
    """Load the model, or the first of DEFAULT_MODELS that suits the frames. Raises UserError."""
    from jaxunshear.report import show

    if arguments.model:
        return show.load_model_for(path, arguments.model, arguments.like)
    problems = []
    for name in DEFAULT_MODELS:
        try:
            return show.load_model_for(path, name, arguments.like)
        except UserError as error:
            problems.append(str(error))
    remedy = "for another sensor name a MODEL that learnt from it, as `jaxunshear fit` makes"
    raise UserError(f"{problems[0]}; {remedy}")


COMMANDS = (write_demo_data, show_frames)
