"""Command `jaxunshear stream`: perception for a robot, a JSON line per frame."""

import argparse
import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from jaxunshear.cli.options import (
    SKIN,
    Commands,
    Model,
    add_force,
    add_json,
    add_like,
    add_model,
    new_parser,
)
from jaxunshear.errors import UserError
from jaxunshear.files import explain_os_error
from jaxunshear.output_checks import check_new_file, check_new_folder, check_not_among
from jaxunshear.protected_folders import check_outside
from jaxunshear.results.applications import StreamResult


def add_parser(commands: Commands) -> None:
    text = (
        "perception for a robot: frames in; unsheared image, pose and confidence out, "
        "a JSON line each"
    )
    parser = new_parser(commands, "stream", text)
    parser.add_argument(
        "source", metavar="SOURCE", help="a folder, an image, a video file, or camera:N"
    )
    add_model(parser, SKIN)
    add_like(parser)
    add_force(parser)
    parser.add_argument(
        "--fps",
        metavar="N",
        type=float,
        help="play a folder or video at this rate, as a camera would",
    )
    parser.add_argument(
        "--lines", metavar="FILE", type=Path, help="for the JSON lines (default: standard output)"
    )
    images = parser.add_mutually_exclusive_group()
    images.add_argument(
        "--images",
        metavar="DIR",
        type=Path,
        help="for unsheared images (default: within the lines)",
    )
    images.add_argument("--no-images", action="store_true", help="leave them out")
    add_json(parser, "the summary, with command, machine and versions")


def run(arguments: argparse.Namespace, out: Path, model: Model) -> StreamResult:
    from jaxunshear.apps.robot.frame_sources import make_label_reader, open_frames
    from jaxunshear.apps.robot.stream import load_stream_model, stream
    from jaxunshear.data.sources import open_source
    from jaxunshear.inference.perceiver import find_pin_frame

    if arguments.fps is not None and not 0 < arguments.fps <= 10_000:
        raise UserError(f"--fps {arguments.fps:g}: use more than 0, at most 10000")
    if arguments.images is not None and Path(arguments.source).exists():
        check_not_among(Path(arguments.source), arguments.images, "--images")
    check_new_file(arguments.lines, "--lines")
    check_new_folder(arguments.images, "--images")
    check_outside(arguments.lines, "--lines")
    check_outside(arguments.images, "--images")
    folder, experiment = model
    source = Path(arguments.source)
    like = arguments.like or (source if source.is_dir() else None)
    frame = find_pin_frame(like, experiment) if like else None
    robot = load_stream_model(folder, experiment, frame, arguments.force)
    frames, live = open_frames(arguments.source, robot.preprocess, arguments.fps)
    truth = make_label_reader(arguments.source, experiment)
    with _open_lines(arguments.lines) as lines:
        summary = stream(
            frames, live, robot, lines, arguments.images, not arguments.no_images, truth
        )
    latency = summary.latency_ms
    times = f"; p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms a frame" if latency else ""
    print(
        f"{summary.used} frames used, {summary.skipped} skipped, {summary.dropped} dropped{times}",
        file=sys.stderr,
    )
    if summary.pose_mae:
        errors = ", ".join(f"{name} {value:.3f}" for name, value in summary.pose_mae.items())
        print(f"mean error against the labels: {errors}", file=sys.stderr)
    print(f"note: {open_source(experiment).describe()}", file=sys.stderr)
    for problem, count in list(summary.problems.items())[:5]:
        print(f"skipped {count}: {problem}", file=sys.stderr)
    return summary


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
