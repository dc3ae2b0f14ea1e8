"""Commands to begin with, which need no training: demo-data, show."""

import argparse
from pathlib import Path

from jaxunshear.cli.models import IMAGES, LIKE, UNTOUCHED, choose_exit_code
from jaxunshear.cli.program import Command, integer, path
from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes
from jaxunshear.output_checks import check_new_picture, check_not_among, check_outside

DEFAULT_MODEL = Path("skin")
NEXT_STEPS = """\
{folder}: 331_pins and 127_pins, each with edge (taps and slides), camera and untouched; try
  jaxunshear doctor {folder}/331_pins/edge
  jaxunshear show {folder}/331_pins/edge/shear
  jaxunshear fit --taps {folder}/331_pins/edge/tap --slides {folder}/331_pins/edge/shear \
--unshear.input pins"""


def write_demo_data(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.demo_data import write_demo_data

    write_demo_data(arguments.folder, arguments.contacts, arguments.seed)
    print(NEXT_STEPS.format(folder=arguments.folder))
    return 0


def show_frames(arguments: argparse.Namespace, command: str) -> int:
    path = arguments.path
    if not path.exists():
        raise UserError(f"{path} does not exist: name {IMAGES}")
    out = arguments.file or Path(f"show_{path.resolve().stem}.png")
    check_not_among(path, out.parent, "--out")
    check_outside(out, "--out")
    from jaxunshear.inference.adaptation import adapt_to_dome
    from jaxunshear.report import show

    check_new_picture(out, show.PNG_SOFTWARE)
    try:
        model = show.load_model_for(path, arguments.model or DEFAULT_MODEL, arguments.like)
    except UserError as error:
        if arguments.model:
            raise
        remedy = "for another sensor name a MODEL that learnt from it, as `jaxunshear fit` makes"
        raise UserError(f"{error}; {remedy}") from error
    adapt_to_dome(model, arguments.untouched)
    frames = show.predict_frames(path, model)
    write_bytes(out, show.plot_frames(frames, model))
    for frame in frames:
        print("\n  ".join([f"{frame.name}: {frame.sentence}", *show.format_poses(frame.poses)]))
    print(out)
    return choose_exit_code(len(frames), sum(frame.unsheared is None for frame in frames))


COMMANDS = (
    Command(
        "demo-data",
        "write a small labelled recording, simulated, to try the other commands on",
        write_demo_data,
        (
            path("folder", "DIR", "a new or an empty folder"),
            integer(
                "--contacts", "taps, and as many slides, of 331 pins; 127 pins: a fifth (300)", 300
            ),
            integer("--seed", "seed of poses, slides and noise (default: 0)", 0),
        ),
    ),
    Command(
        "show",
        "draw a few frames, unsheared, with the motion of their pins, poses and contact",
        show_frames,
        (
            path("path", "FRAME", IMAGES),
            path(
                "model",
                "MODEL",
                f"a finished run, or released weights by name ({DEFAULT_MODEL}, for 331 pins)",
                nargs="?",
            ),
            LIKE,
            UNTOUCHED,
            path("--out", "FILE", "PNG to draw to (default: show_NAME.png)", dest="file"),
        ),
    ),
)
