"""Command `jaxunshear explore`: a page on which a hand presses and slides the simulated dome."""

import argparse
import importlib.util
import socket

from jaxunshear.cli.options import Commands, add_like, add_model, new_parser, parse_stimuli
from jaxunshear.errors import UserError

COMMANDS = ("explore",)


def add_parsers(commands: Commands) -> None:
    text = "press and slide the dome over a shape with the mouse, on a page of this machine"
    parser = new_parser(commands, "explore", text)
    add_model(parser)
    add_like(parser)
    shapes = "outlines in files (.svg, .csv, .json) to be touched, too"
    parser.add_argument("--stimulus", metavar="FILE,FILE", help=shapes)
    parser.add_argument(
        "--port", metavar="N", type=int, default=8080, help="of this machine alone (8080)"
    )


def run(arguments: argparse.Namespace, command: str) -> int:
    if importlib.util.find_spec("nicegui") is None:
        raise UserError(
            "the page needs the extra `explore`: pip install -c constraints.txt '.[explore]'"
        )
    _check_port(arguments.port)
    from jaxunshear.apps.explore.explorer import make_explorer
    from jaxunshear.model_folders import find_model_folder, load_settings
    from jaxunshear.simulator.stimuli import Stimulus, make_stimulus

    own_stimuli: tuple[Stimulus, ...] = ()
    if arguments.stimulus:
        own_stimuli = tuple(map(make_stimulus, parse_stimuli(arguments.stimulus)))
    folder = find_model_folder(arguments.model)
    explorer = make_explorer(folder, load_settings(folder), arguments.like, own_stimuli)
    explorer.warm()
    from jaxunshear.apps.explore.page import HOST, serve  # the extra is imported here alone

    print(f"http://{HOST}:{arguments.port} (Ctrl+C ends it)", flush=True)
    serve(explorer, arguments.port)
    return 0


def _check_port(port: int) -> None:
    if not 1 <= port <= 65535:
        raise UserError(f"--port {port}: use 1 to 65535")
    try:
        with socket.create_server(("127.0.0.1", port)):
            pass
    except OSError as error:
        raise UserError(f"--port {port} cannot be had ({error.strerror}): name another") from None
