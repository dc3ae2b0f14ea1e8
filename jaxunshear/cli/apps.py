"""Commands with extras of their own: stream, export, explore."""

import argparse
import contextlib
import importlib.util
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from jaxunshear.cli.models import (
    CAMERA_MODEL,
    LIKE,
    MODEL,
    apply,
    choose_exit_code,
    parse_stimuli,
)
from jaxunshear.cli.program import define_command, flag, integer, json_file, option, path
from jaxunshear.environment import keep_compiled_programs
from jaxunshear.errors import UserError
from jaxunshear.files import explain_os_error
from jaxunshear.output_checks import (
    check_new_file,
    check_new_folder,
    check_not_among,
    check_outside,
)
from jaxunshear.results.applications import StreamResult

if TYPE_CHECKING:
    from jaxunshear.apps.robot.cameras import CameraSettings
    from jaxunshear.inference.trained_model import TrainedModel

SHOWN_PROBLEMS = 5
CAMERA_LIST = "list"  # in the place of a source
INLINE = Path("-")
NO_PICTURE = "gives no picture: busy, or no camera"


@define_command(
    "estimate poses live from a camera, a video or a folder: one JSON line a frame",
    option(
        "source",
        "SOURCE",
        "a folder, an image, a video; camera:N, a camera's path, URL or GStreamer "
        "pipeline; tcp://HOST:PORT, zmq:ENDPOINT, - for stdin; or list, which shows the "
        "cameras",
    ),
    *CAMERA_MODEL,
    option("--size", "WxH", "ask the camera for frames of this size, such as 1280x720"),
    option(
        "--fps", "N", "ask the camera for this rate; a folder or video is played at it", type=float
    ),
    option("--exposure", "N", "exposure of the camera, in its own unit", type=float),
    flag("--filter", "also smooth poses over time, and give their rates"),
    path("--lines", "FILE", "file for the JSON lines (default: standard output)"),
    path("--images", "DIR", "folder for unsheared images; - puts them into the lines"),
    json_file("the summary, with command, machine and versions"),
    checks_out=False,
)
def stream(arguments: argparse.Namespace, command: str) -> int:
    if arguments.source == CAMERA_LIST:
        return _list_cameras()
    from jaxunshear.apps.robot.frame_sources import check_source
    from jaxunshear.data.videos import is_video

    check_source(arguments.source, _make_camera_settings(arguments))  # before a model is loaded
    source, images = Path(arguments.source), arguments.images
    if images == INLINE:
        images = None
    elif images is not None and os.path.exists(source):
        check_not_among(source, images, "--images")
    check_new_file(arguments.lines, "--lines")
    check_new_folder(images, "--images")
    check_outside(arguments.lines, "--lines")
    check_outside(images, "--images")
    if arguments.like is None and (os.path.isdir(source) or is_video(source)):
        arguments.like = source
    summary = apply(_stream, arguments, command)
    return int(bool(summary.lost)) or choose_exit_code(summary.used, summary.skipped)


def _stream(arguments: argparse.Namespace, out: Path, model: "TrainedModel") -> StreamResult:
    from jaxunshear.apps.robot.frame_sources import make_label_reader, open_source
    from jaxunshear.apps.robot.stream import Outputs, stream
    from jaxunshear.inference.infer import adapt_to_dome

    settings = _make_camera_settings(arguments)
    adapt_to_dome(model, arguments.untouched, arguments.without)
    model.with_sheared_poses = False
    if importlib.util.find_spec("onnxruntime") and importlib.util.find_spec("onnx"):
        from jaxunshear.apps.export.engine import compile_for_frames

        model.compile_networks = compile_for_frames
    model.compile(1)
    source = open_source(arguments.source, model.preprocess, settings)
    if arguments.filter and not source.has_times:
        raise UserError(f"--filter needs times, and {arguments.source} has none: add --fps N")
    read_labels = make_label_reader(arguments.source, model)
    with _open_lines(arguments.lines) as lines:
        outputs = Outputs(lines, arguments.images, arguments.filter, read_labels)
        summary = stream(source.frames, source.is_live, model, outputs)
    _print_summary(summary)
    print(f"note: {model.source.describe()}", file=sys.stderr)
    for problem, count in list(summary.problems.items())[:SHOWN_PROBLEMS]:
        print(f"skipped {count}: {problem}", file=sys.stderr)
    if summary.lost:
        print(f"lost: {summary.lost}", file=sys.stderr)
    return summary


def _make_camera_settings(arguments: argparse.Namespace) -> "CameraSettings":
    from jaxunshear.apps.robot.cameras import CameraSettings, parse_size

    size = parse_size(arguments.size) if arguments.size else None
    return CameraSettings(size, arguments.fps, arguments.exposure)


def _list_cameras() -> int:
    """Print the cameras that are plugged in; return 1 if none gives a picture."""
    from jaxunshear.apps.robot.frame_sources import find_cameras

    cameras = find_cameras()
    for camera in cameras:
        print(f"{camera.source}  {camera.picture or NO_PICTURE}  {camera.name}")
    if not cameras:
        print("no camera is plugged in")
    return int(not any(camera.picture for camera in cameras))


def _print_summary(summary: StreamResult) -> None:
    latency = summary.latency_ms
    times = f"; p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms a frame" if latency else ""
    print(
        f"{summary.used} frames used, {summary.skipped} skipped, {summary.dropped} dropped{times}",
        file=sys.stderr,
    )
    if summary.pose_mae:
        errors = ", ".join(f"{name} {value:.3f}" for name, value in summary.pose_mae.items())
        print(f"mean error against the labels: {errors}", file=sys.stderr)


@contextlib.contextmanager
def _open_lines(path: Path | None) -> Iterator[TextIO]:
    """Open the file of the lines, or standard output.

    Raises UserError if the file can no longer be written, also when it is closed.
    """
    if path is None:
        yield sys.stdout
        return
    try:
        with path.open("w") as file:
            yield file
    except OSError as error:
        if error.filename not in (None, str(path)):
            raise
        raise explain_os_error(path, error) from error


@define_command(
    "export a model to ONNX or StableHLO",
    path("model", "MODEL", "a finished run (runs/demo), or released weights by name (skin)"),
    path(
        "--out",
        "FILE",
        "new file; its name ends in .onnx or .stablehlo",
        dest="file",
        required=True,
    ),
    option("--batch", "N", "images that the file takes at once (default: any)", default="any"),
    path(
        "--preprocess",
        "RECORDINGS",
        "the file takes raw frames of a camera; these frames show their size and the dome's place",
    ),
    path(
        "--like",
        "RECORDINGS",
        "contacts of the camera, whose mean gives the pins' rest positions, "
        "for networks over pins that learnt from simulation alone",
    ),
)
def export(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.apps.export.export import export_model

    check_new_folder(arguments.file.parent)
    batch = None
    if arguments.batch != "any":
        try:
            batch = int(arguments.batch)
        except ValueError:
            raise UserError(f"--batch {arguments.batch}: use a number, or any") from None
    export_model(arguments.model, arguments.file, batch, arguments.preprocess, arguments.like)
    return 0


@define_command(
    "press and slide the dome over a shape in the browser",
    MODEL,
    LIKE,
    option("--stimulus", "FILE,FILE", "more shapes: outlines in files (.svg, .csv, .json)"),
    integer("--port", "port, for this machine alone (default: 8080)", 8080),
)
def explore(arguments: argparse.Namespace, command: str) -> int:
    if importlib.util.find_spec("nicegui") is None:
        raise UserError(
            "the page needs the extra `explore`: pip install -c constraints.txt '.[explore]'"
        )
    port = arguments.port
    if not 1 <= port <= 65535:
        raise UserError(f"--port {port}: use 1 to 65535")
    try:
        with socket.create_server(("127.0.0.1", port)):
            pass
    except OSError as error:
        raise UserError(f"--port {port} cannot be had ({error.strerror}): name another") from None
    keep_compiled_programs()
    from jaxunshear.apps.explore.explorer import make_explorer
    from jaxunshear.inference.trained_model import load_model
    from jaxunshear.simulator.stimuli import make_stimulus

    stimuli = parse_stimuli(arguments.stimulus) if arguments.stimulus else ()
    model = load_model(arguments.model, arguments.like)
    explorer = make_explorer(model, tuple(map(make_stimulus, stimuli)))
    from jaxunshear.apps.explore.page import HOST, serve  # the extra is imported here alone

    print(f"http://{HOST}:{port} (Ctrl+C ends it)", flush=True)
    serve(explorer, port)
    return 0


COMMANDS = (stream, export, explore)
