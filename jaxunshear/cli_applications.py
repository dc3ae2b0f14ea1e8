"""The commands that put networks to use: parsers, calls and what they print. Everything heavy is imported when it is needed."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxunshear.applications.folders import results_folder
from jaxunshear.errors import UserError
from jaxunshear.experiment import simulated_of
from jaxunshear.owners import check_apart
from jaxunshear.storage import check_beside, check_new_file, check_new_folder

if TYPE_CHECKING:
    from jaxunshear.applications.servo import Walks
    from jaxunshear.experiment import Experiment

    Model = tuple[Path, Experiment]

KNOWN = 300  # simulated taps that scales are fitted to
COMMANDS = ("pins", "geometry", "servo", "reconstruct", "stream")
DEFAULT, SKIN = Path("standard"), Path("skin")  # of the released weights, for simulated touches and for recorded ones


def add_parsers(commands: Any) -> None:
    """Adds the commands of COMMANDS to an argparse subparsers object."""

    def command(name: str, text: str, out: str) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=text, description=text)
        parser.add_argument("--out", metavar="DIR", type=Path, help=out)
        parser.add_argument(
            "--json", metavar="FILE", type=Path, help="write the rows, with command, machine and versions"
        )
        return parser

    parser = command("pins", "find, identify and draw the pins of recorded images", "for the results (pins)")
    parser.add_argument("path", metavar="IMAGES", type=Path, help="an image, or a folder of recordings")
    known = parser.add_mutually_exclusive_group()
    known.add_argument("--sensor", metavar="NAME", default="tactip331", help="whose pins they are (tactip331)")
    known.add_argument(
        "--layout", metavar="FILE", type=Path, help="instead: x and y of each pin, a line each, any unit"
    )
    known.add_argument("--model", metavar="DIR", type=Path, help="instead: images of the sensor and camera of this run")
    parser.add_argument(
        "--rest", metavar="IMAGES", type=Path, help="of the untouched sensor (default: the images' mean)"
    )
    parser.add_argument("--size", metavar="PX", type=int, help="of the prepared images (theirs, at most 256)")

    parser = command("geometry", "contact geometry of taps, sheared and unsheared images", "for the results (geometry)")
    parser.add_argument("path", metavar="IMAGES", type=Path, nargs="?", help="also of these recordings")
    add_model(parser)
    parser.add_argument(
        "--contacts",
        metavar="N",
        type=int,
        default=300,
        help="fresh ones to be scored on, at least 5 of each shape (300)",
    )

    parser = command("servo", "follow the outlines of objects by touch, in the simulator", "for the results (servo)")
    add_model(parser)
    _add_stimulus(parser)
    parser.add_argument("--starts", metavar="N", type=int, default=5, help="for each way of perceiving (5)")
    parser.add_argument(
        "--ways", metavar="NAME,NAME", help="of perceiving (default: all that the model's networks allow)"
    )
    parser.add_argument("--depth", metavar="MM", type=float, default=3.0, help="of the contact (3)")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the starts (0)")

    parser = command(
        "reconstruct", "complete objects from the walks that `servo` left", "where they are, and results go"
    )
    add_model(parser)
    _add_stimulus(parser)

    text = "perception for a robot: frames in; unsheared image, pose and confidence out, a JSON line each"
    parser = commands.add_parser("stream", help=text, description=text)
    parser.add_argument("source", metavar="SOURCE", help="a folder, an image, a video file, or camera:N")
    add_model(parser, SKIN)
    add_like(parser)
    parser.add_argument("--fps", metavar="N", type=float, help="play a folder or video at this rate, as a camera would")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32", help="(float32)")
    parser.add_argument(
        "--way",
        choices=("disentangled", "code", "both"),
        default="disentangled",
        help="whose pose: PoseNet's of the unsheared image; the head's of the pose code, without a PoseNet; their mean (disentangled)",
    )
    parser.add_argument("--lines", metavar="FILE", type=Path, help="for the JSON lines (default: standard output)")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--images", metavar="DIR", type=Path, help="for unsheared images (default: within the lines)")
    shown.add_argument("--no-images", action="store_true", help="leave them out")
    parser.add_argument(
        "--json", metavar="FILE", type=Path, help="write the summary, with command, machine and versions"
    )


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


def _add_stimulus(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--stimulus", metavar="NAME,NAME", default="all", help="which objects (all)")


def run(arguments: argparse.Namespace, command: str) -> int:
    """Runs one of COMMANDS. Returns the exit code.

    Results of a finished run's networks go to its own folder, where its report finds them, unless --out says otherwise.
    """
    from jaxunshear.memory import keep_freed_memory

    keep_freed_memory()
    model = _model(arguments) if arguments.model else None
    finished = model is not None and (model[0] / "results.json").is_file()
    home = results_folder(model[0] if model and finished else Path(), arguments.command)
    out = home if arguments.command == "stream" else arguments.out or home
    check_new_folder(out)
    if out.resolve() != home.resolve():
        check_apart(out, "--out")
    work: dict[str, Callable[..., dict[str, Any]]] = {
        "pins": _pins,
        "geometry": _geometry,
        "servo": _servo,
        "reconstruct": _reconstruct,
        "stream": _stream,
    }
    results = work[arguments.command](arguments, out, model)
    from jaxunshear.metrics.machine import machine, versions
    from jaxunshear.storage import write_json

    results = {"command": command} | results | {"machine": machine(), "versions": versions()}
    if arguments.json:
        write_json(arguments.json, results)
    if arguments.command != "stream" or finished:
        write_json(out / f"{arguments.command}.json", results)
    if model and finished and out == home:
        from jaxunshear.report.report import write_report

        print(write_report(model[0]), file=sys.stderr)
    return 0


def _model(arguments: argparse.Namespace) -> "Model":
    from jaxunshear import infer

    folder = infer.model_folder(arguments.model)
    return folder, infer.load_settings(folder)


def _pins(arguments: argparse.Namespace, out: Path, model: "Model | None") -> dict[str, Any]:
    from dataclasses import replace

    from jaxunshear.applications import pins
    from jaxunshear.dataset.recordings import read_recordings
    from jaxunshear.image.fitting import Layout, layout_of, read_layout
    from jaxunshear.image.lattice import Lattice
    from jaxunshear.image.settings import Preprocess
    from jaxunshear.scene.sensor import sensor_named
    from jaxunshear.storage import write_bytes

    if not arguments.path.exists():
        raise UserError(f"{arguments.path} does not exist: name an image or a folder of recordings")
    for recordings in (arguments.path, *([arguments.rest] if arguments.rest else [])):
        check_beside(recordings, out, "--out")
        read_recordings(recordings, Preprocess())  # refuses a place without images before there is work to lose
    if arguments.size is not None and not 32 <= arguments.size <= 2048:
        raise UserError(f"--size {arguments.size}: use 32 to 2048 px")
    preprocess = Preprocess()
    lattice: Lattice | Layout
    if model:
        from jaxunshear.image.framing import undeformed

        experiment = model[1]
        paired, _ = simulated_of(experiment, "pins --model")
        if arguments.size or arguments.rest:
            raise UserError("--model knows the images' size and the untouched pins: leave --size and --rest out")
        preprocess = paired.preprocess
        lattice = undeformed(experiment.sensor, paired.camera, preprocess)
    else:
        lattice = read_layout(arguments.layout) if arguments.layout else layout_of(sensor_named(arguments.sensor))
        preprocess = replace(preprocess, size=arguments.size or pins.prepared_size(arguments.path))
    measured, fitted, shown = pins.pins_of_recordings(arguments.path, lattice, preprocess, out, arguments.rest)
    from jaxunshear.report.pin_figure import pin_figure

    write_bytes(out / "pins.png", pin_figure(fitted, shown))
    print(pins.summary(measured))
    print(out / "pins.png")
    return measured


def _geometry(arguments: argparse.Namespace, out: Path, model: "Model") -> dict[str, Any]:
    from jaxunshear.applications.fresh import fresh_contacts, untouched_images
    from jaxunshear.applications.geometry_scores import geometry_of, geometry_rows
    from jaxunshear.applications.geometry_ways import INVERSE, ways_of
    from jaxunshear.applications.perception import unshearers, unshearing_of
    from jaxunshear.dataset.recordings import read_recordings
    from jaxunshear.image.framing import undeformed
    from jaxunshear.image.settings import Preprocess
    from jaxunshear.report import geometry_figure
    from jaxunshear.storage import write_bytes
    from jaxunshear.table import plain_table

    if arguments.contacts < 3:
        raise UserError(f"--contacts {arguments.contacts}: use at least 3")
    if arguments.path is not None:
        read_recordings(arguments.path, Preprocess())  # refuses a place without images before there is work to lose
        check_beside(arguments.path, out, "--out")
    folder, experiment = model
    paired, _ = simulated_of(experiment, "geometry")
    networks = unshearers(folder, experiment, unshearing_of(folder))
    if not networks:
        raise UserError(f"{folder} holds no trained network that unshears: train one first, or name another --model")
    lattice = undeformed(experiment.sensor, paired.camera, paired.preprocess)
    ways = ways_of(experiment, lattice, fresh_contacts(experiment, KNOWN, seed=1))
    contacts = fresh_contacts(experiment, arguments.contacts)
    untouched = untouched_images(experiment, len(contacts.stimulus))
    geometry = geometry_of(lattice, contacts, untouched, ways, networks)
    rows = geometry_rows(paired.stimuli, contacts, geometry)
    figure = geometry_figure.of_contacts(lattice, paired.stimuli, contacts, geometry)
    write_bytes(out / "geometry.png", figure)
    print(plain_table(rows, ("name", "contacts", "unmatched", "correlation", "rmse_mm", "largest_mm", "ms_per_image")))
    print(out / "geometry.png")
    if arguments.path is not None:
        from jaxunshear.applications.recorded_geometry import heights_of_recordings

        shown = heights_of_recordings(arguments.path, experiment, lattice, ways[INVERSE], networks)
        write_bytes(out / "recordings.png", geometry_figure.of_recordings(lattice, shown))
        print(out / "recordings.png")
    return {"rows": rows, "mm_per_height": {name: way.mm for name, way in ways.items()}, "dropped": contacts.dropped}


def _stimuli(text: str) -> tuple[str, ...]:
    from jaxunshear.scene.stimuli import SHAPES, shape_named

    names = SHAPES if text == "all" else tuple(name.strip() for name in text.split(","))
    for name in names:
        shape_named(name)
    if len(set(names)) < len(names):
        raise UserError(f"--stimulus {text}: name each once")
    return names


def _servo(arguments: argparse.Namespace, out: Path, model: "Model") -> dict[str, Any]:
    from jaxunshear.applications import perception, servo
    from jaxunshear.applications.walk_scores import walk_rows
    from jaxunshear.contact.rings import deepest_mm
    from jaxunshear.report.walk_figure import walk_figure
    from jaxunshear.storage import write_bytes
    from jaxunshear.table import plain_table

    names = _stimuli(arguments.stimulus)
    if arguments.starts < 1:
        raise UserError(f"--starts {arguments.starts}: use at least 1")
    if arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: use 0 or more")
    folder, experiment = model
    paired, _ = simulated_of(experiment, "servo")
    deepest = deepest_mm(experiment.sensor)
    if not 0 < arguments.depth <= deepest:
        raise UserError(f"--depth {arguments.depth:g}: use more than 0, up to {deepest:.1f} mm")
    if not arguments.ways and not perception.ways_of(folder):
        raise UserError(
            f"{folder} holds no trained networks to perceive by: train them first, or ask for --ways {perception.TRUE}"
        )
    chosen = arguments.ways.split(",") if arguments.ways else (perception.TRUE, *perception.ways_of(folder))
    known = perception.perceptions(folder, experiment, tuple(way for way in chosen if way != perception.TRUE))
    ways, digests = {way: known.get(way) for way in chosen}, perception.digests(folder, chosen)
    rows: list[dict[str, Any]] = []
    for name in names:
        course = servo.Course(name, arguments.starts, arguments.depth, seed=arguments.seed)
        walks, line = servo.follow_contour(course, experiment.sensor, paired, ways, out / f"{name}.npz", digests)
        rows += walk_rows(walks, line, name)
        write_bytes(out / f"{name}.png", walk_figure(walks, line, name))
        print(plain_table(rows[-len(ways) :], ("name", "completed", "closed", "mean_mm", "p95_mm", "largest_mm")))
    print(out)
    return {"rows": rows}


def _reconstruct(arguments: argparse.Namespace, out: Path, model: "Model") -> dict[str, Any]:
    from jaxunshear.applications import perception
    from jaxunshear.applications.fresh import fresh_contacts
    from jaxunshear.applications.objects import makers_for, objects_of
    from jaxunshear.applications.servo import made_with, stored_walks
    from jaxunshear.report.object_figure import PICTURES, object_figure
    from jaxunshear.storage import write_bytes
    from jaxunshear.table import plain_table

    folder, experiment = model
    paired, _ = simulated_of(experiment, "reconstruct")
    asked = _stimuli(arguments.stimulus)
    names = [name for name in asked if (out / f"{name}.npz").is_file()]
    if not names:
        raise UserError(
            f"--out {out} holds no walks: run `jaxunshear servo --model {arguments.model} --out {out}` first"
        )
    if arguments.stimulus != "all" and len(names) < len(asked):
        lacking = ", ".join(name for name in asked if name not in names)
        raise UserError(f"--stimulus {lacking}: {out} holds no walk of it; run `jaxunshear servo` for it first")
    networks = perception.unshearers(folder, experiment, perception.unshearing_of(folder))
    rows: list[dict[str, Any]] = []
    makers: dict[float, Any] = {}  # by depth
    made: dict[tuple[str, ...], str] = {}  # by ways
    for name in names:
        walked = stored_walks(out / f"{name}.npz")
        ways = tuple(dict.fromkeys(walked[1].way.tolist()))
        if ways not in made:
            made[ways] = made_with(experiment.sensor, paired, perception.digests(folder, ways))
        _check_walks(out / f"{name}.npz", walked[1], made[ways])
        depth = walked[0].depth_mm
        if depth not in makers:
            makers[depth] = makers_for(experiment, fresh_contacts(experiment, KNOWN, 1, depth))
        found = objects_of(experiment, walked, networks, makers[depth])
        rows += [row for row, _ in found.values()]
        for maker, (file, text) in PICTURES.items():
            solids = {way: solid for (by, way), (_, solid) in found.items() if by == maker}
            write_bytes(out / f"{name}-{file}.png", object_figure(name, solids, text))
        columns = ("name", "walks", "closed", "iou", "iou_felt", "mean_mm", "hausdorff_mm", "height_rms_mm")
        print(plain_table(rows[-len(found) :], columns))
    print(out)
    return {"rows": rows}


def _check_walks(file: Path, walks: "Walks", made: str) -> None:
    """Refuses walks that are not finished, and those of another model."""
    from jaxunshear.applications.servo import WALKING

    if (walks.end == WALKING).any():
        raise UserError(f"{file} holds walks that are not finished: run the same `jaxunshear servo` command again")
    if str(walks.made) != made:
        raise UserError(
            f"{file} holds walks of another model or sensor, or of an earlier simulator: name theirs with --model, or walk again"
        )


def _stream(arguments: argparse.Namespace, out: Path, model: "Model") -> dict[str, Any]:
    import contextlib

    from jaxunshear.applications.perceiver import frame_for
    from jaxunshear.applications.sources import frames_of, truth_of
    from jaxunshear.applications.stream import robot_of, stream
    from jaxunshear.infer import learnt_note

    if arguments.fps is not None and not 0 < arguments.fps <= 10_000:
        raise UserError(f"--fps {arguments.fps:g}: use more than 0, at most 10000")
    if arguments.images is not None and Path(arguments.source).exists():
        check_beside(Path(arguments.source), arguments.images, "--images")
    check_new_file(arguments.lines, "--lines")
    check_new_folder(arguments.images, "--images")
    check_apart(arguments.lines, "--lines")
    check_apart(arguments.images, "--images")
    folder, experiment = model
    source = Path(arguments.source)
    like = arguments.like or (source if source.is_dir() else None)
    frame = frame_for(like, experiment) if like else None
    robot = robot_of(folder, experiment, arguments.precision, arguments.way, frame)
    frames, live = frames_of(arguments.source, robot.preprocess, arguments.fps)
    truth = truth_of(arguments.source, experiment)
    with contextlib.ExitStack() as stack:
        lines = stack.enter_context(arguments.lines.open("w")) if arguments.lines else sys.stdout
        summary = stream(frames, live, robot, lines, arguments.images, not arguments.no_images, truth)
    latency = summary["latency_ms"]
    times = f"; p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms a frame" if latency else ""
    print(
        f"{summary['used']} frames used, {summary['skipped']} skipped, {summary['dropped']} dropped{times}",
        file=sys.stderr,
    )
    if summary["pose_mae"]:
        errors = ", ".join(f"{name} {value:.3f}" for name, value in summary["pose_mae"].items())
        print(f"mean error against the labels: {errors}", file=sys.stderr)
    print(f"note: {learnt_note(experiment)}", file=sys.stderr)
    for problem, count in list(summary["problems"].items())[:5]:
        print(f"skipped {count}: {problem}", file=sys.stderr)
    if not summary["used"]:
        raise UserError(f"no frame of {arguments.source} could be used")
    return summary
