"""Commands that put networks to use: unshear, pose, pins, geometry, servo, reconstruct."""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from jaxunshear.cli.program import (
    LAYOUT,
    ROWS,
    WITHOUT,
    Command,
    Option,
    flag,
    integer,
    json_file,
    mark_rare,
    option,
    path,
)
from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.sensor import Preprocess, get_sensor
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.errors import UserError
from jaxunshear.files import format_csv, to_builtins, write_bytes, write_json, write_npz, write_text
from jaxunshear.output_checks import check_new_folder, check_not_among, check_outside
from jaxunshear.results.applications import ObjectScore, ScoreTable, TrajectoryScore
from jaxunshear.results.record_files import find_results_folder

if TYPE_CHECKING:
    from jaxunshear.inference.trained_model import TrainedModel
    from jaxunshear.perception.lattice import Lattice
    from jaxunshear.perception.lattice_fitting import MarkerLayout

IMAGES = "an image, a video, or a folder of recordings"
GEOMETRY_COLUMNS = (
    *("name", "contacts", "unmatched", "correlation", "rmse_mm", "largest_mm", "ms_per_image"),
)
SERVO_COLUMNS = ("name", "completed", "closed", "mean_mm", "p95_mm", "largest_mm")
OBJECT_COLUMNS = (
    *("name", "walks", "closed", "iou", "iou_felt", "mean_mm", "hausdorff_mm", "height_rms_mm"),
)


def _name_model(default: str, name: str = "--model", **settings: str) -> Option:
    text = f"a finished run (runs/demo), or released weights by name (default: {default})"
    return path(name, "MODEL", text, default=Path(default), **settings)


MODEL = _name_model("standard")
LIKE = path(
    "--like",
    "RECORDINGS",
    "contacts of the same sensor and camera, whose mean gives the pins' rest positions "
    "(default: the frames themselves)",
)
UNTOUCHED = path(
    "--untouched",
    "RECORDINGS",
    "frames of the untouched dome, in a folder or a video: contact and shear are measured "
    "from them (default: from the mean over contacts)",
)
FORCED = (
    "answer images of another sensor, of an untouched dome and of a frozen camera, too; "
    "pins that cannot be identified are still rejected"
)
CAMERA_MODEL = (  # trained for recordings, and what it needs to read them
    _name_model("skin"),
    LIKE,
    UNTOUCHED,
    *mark_rare(WITHOUT, flag("--force", FORCED)),
)
STIMULUS = option(
    "--stimulus", "NAME,FILE", "objects by name, or outlines in files (default: all)", default="all"
)


def infer(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.inference.infer import predict_recordings, unshear_recordings

    name = arguments.command
    shared = {key: getattr(arguments, key) for key in ("force", "like", "untouched", "without")}
    if name == "unshear":
        measured = unshear_recordings(arguments.path, arguments.model, arguments.out, **shared)
    else:
        measured = predict_recordings(arguments.path, arguments.model, **shared)
    if arguments.json:
        write_json(arguments.json, replace(measured, command=command))
    counts = {row.name: row.value or 0 for row in measured.rows}
    return choose_exit_code(counts[f"{name}.images"], counts[f"{name}.left_out"])


Outcome = TypeVar("Outcome")  # a record of results


def apply(
    application: Callable[..., Outcome], arguments: argparse.Namespace, command: str
) -> Outcome:
    """Run an application of arguments, folder and model; write its results and return them.

    Those of a finished run's networks go to its own folder, where its report finds them, unless
    --out names another. Those of a command without --out are written nowhere else.
    """
    from jaxunshear.results.provenance import describe_provenance, read_training_facts
    from jaxunshear.results.record_files import write_record

    model, given = None, vars(arguments)
    if arguments.model:
        from jaxunshear.inference.trained_model import load_model

        model = load_model(arguments.model, given.get("like"), given.get("force", False))
    finished = model is not None and (model.folder / "results.json").is_file()
    home = find_results_folder(model.folder if model and finished else Path(), arguments.command)
    out = given.get("out") or home
    check_new_folder(out)
    if out.resolve() != home.resolve():
        check_outside(out, "--out")
    outcome = application(arguments, out, model)
    results = describe_provenance(command) | vars(outcome)
    if model:
        results |= read_training_facts(model.folder, model.experiment.networks)
    if arguments.json:
        write_record(arguments.json, results)
    if finished or "out" in given:
        write_record(out / f"{arguments.command}.json", results)
    if model and finished and out == home:
        from jaxunshear.report.report import write_report

        print(write_report(model.folder), file=sys.stderr)
    return outcome


def _define_application(
    text: str, out: str, *options: Option | list[Option]
) -> Callable[[Callable[..., object]], Command]:
    """Make a decorator that turns an application into a command, see `apply`."""

    def define(application: Callable[..., object]) -> Command:
        name = application.__name__

        def run(arguments: argparse.Namespace, command: str) -> int:
            apply(application, arguments, command)
            return 0

        own = (path("--out", "DIR", out), json_file(ROWS), *options)
        return Command(name, text, run, own, is_resumable=name == "servo", checks_out=False)

    return define


@_define_application(
    "detect, track and draw the pins of recorded images",
    "folder of the results (default: pins)",
    path("path", "RECORDINGS", IMAGES),
    [
        option("--sensor", "NAME", "name of the sensor (default: tactip331)", default="tactip331"),
        LAYOUT,
        path("--model", "MODEL", "instead: sensor and camera of a simulated run"),
    ],
    path("--rest", "RECORDINGS", "frames of the untouched sensor (default: the images' mean)"),
    option(
        "--size",
        "PX",
        "size of the prepared images (default: the images' own, at most 256)",
        type=int,
    ),
    WITHOUT,
)
def pins(arguments: argparse.Namespace, out: Path, model: "TrainedModel | None") -> object:
    from jaxunshear.data.recorded_pins import find_pins, summary
    from jaxunshear.data.recordings import read_recordings
    from jaxunshear.perception.lattice_fitting import make_layout
    from jaxunshear.results.layout import read_layout

    if not arguments.path.exists():
        raise UserError(f"{arguments.path} does not exist: name {IMAGES}")
    for recordings in filter(None, (arguments.path, arguments.rest)):
        check_not_among(recordings, out, "--out")
        read_recordings(recordings, Preprocess())  # refuses a place without images
    size = arguments.size
    if size is not None and not 32 <= size <= 2048:
        raise UserError(f"--size {size}: use 32 to 2048 px")
    preprocess = Preprocess(size=size) if size else None
    lattice: Lattice | MarkerLayout
    if model:
        preprocess = model.require_simulation("pins --model").preprocess
        if size or arguments.rest:
            raise UserError(
                "--model knows the images' size and the untouched pins: leave --size and --rest out"
            )
        lattice = model.lattice
    elif arguments.layout:
        lattice = make_layout(read_layout(arguments.layout))
    else:
        lattice = make_layout(get_sensor(arguments.sensor))
    found = find_pins(arguments.path, lattice, preprocess, arguments.rest, arguments.without)
    from jaxunshear.report.application_figures import plot_pins

    arrays = {
        "name": found.name,
        "sure": found.sure,
        "place_px": found.place_px.astype("float32"),
        "motion_px": found.motion_px.astype("float32"),
        "undeformed_px": found.lattice.rest.astype("float32"),
    }
    write_npz(out / "pins.npz", arrays, compressed=True)
    write_text(out / "pins.csv", format_csv(to_builtins(found.table.rows)))
    write_bytes(out / "pins.png", plot_pins(found.lattice, found.shown))
    print(summary(found.table))
    print(out / "pins.png")
    return found.table


@_define_application(
    "estimate contact geometry from taps, sheared and unsheared images",
    "folder of the results (default: geometry)",
    path("path", "RECORDINGS", "recordings to estimate geometry from, too", nargs="?"),
    MODEL,
    integer("--contacts", "new contacts to score on, at least 5 of each shape (default: 300)", 300),
)
def geometry(arguments: argparse.Namespace, out: Path, model: "TrainedModel") -> object:
    from jaxunshear.data.recordings import read_recordings
    from jaxunshear.downstream.geometry_scores import estimate_recorded_heights, score_geometry
    from jaxunshear.report.application_figures import plot_contacts, plot_recordings
    from jaxunshear.text_table import format_text_table

    if arguments.path is not None:
        # refuses a place without images before there is work to lose
        read_recordings(arguments.path, Preprocess())
        check_not_among(arguments.path, out, "--out")
    scores = score_geometry(model, arguments.contacts)
    paired, rest = model.require_simulation("geometry"), model.lattice.rest
    places_mm = (rest - rest.mean(0)) * paired.camera.mm_across / paired.preprocess.size
    figure = plot_contacts(places_mm, paired.names, scores.contacts, scores.geometry)
    write_bytes(out / "geometry.png", figure)
    print(format_text_table([to_builtins(row) for row in scores.table.rows], GEOMETRY_COLUMNS))
    print(out / "geometry.png")
    if arguments.path is not None:
        heights = estimate_recorded_heights(arguments.path, model, scores)
        write_bytes(out / "recordings.png", plot_recordings(places_mm, heights))
        print(out / "recordings.png")
    return scores.table


@_define_application(
    "follow the contours of simulated objects by touch",
    "folder of the results (default: servo)",
    MODEL,
    STIMULUS,
    integer(
        "--starts", "trajectories around an object, for each method of perception (default: 5)", 5
    ),
    option(
        "--ways",
        "NAME,NAME",
        "methods of perception (default: all that the model's networks allow)",
    ),
    option("--depth", "MM", "depth of the contact in mm (default: 3)", type=float, default=3.0),
    integer("--seed", "seed of the starts (default: 0)", 0),
)
def servo(arguments: argparse.Namespace, out: Path, model: "TrainedModel") -> object:
    from jaxunshear.downstream.servo import ServoTask
    from jaxunshear.downstream.servo_scores import servo
    from jaxunshear.report.application_figures import plot_trajectories
    from jaxunshear.text_table import format_text_table

    tasks = [
        ServoTask(stimulus, arguments.starts, arguments.depth, seed=arguments.seed)
        for stimulus in parse_stimuli(arguments.stimulus)
    ]
    ways = None if arguments.ways is None else tuple(arguments.ways.split(","))
    rows: list[TrajectoryScore] = []
    for result in servo(model, tasks, ways, out):
        name = str(result.task.stimulus)
        rows += result.scores
        write_bytes(
            out / f"{name}.png", plot_trajectories(result.trajectories, result.contour, name)
        )
        print(format_text_table([vars(row) for row in result.scores], SERVO_COLUMNS))
    print(out)
    return ScoreTable(rows)


@_define_application(
    "reconstruct object shapes from the trajectories of `servo`",
    "folder of the trajectories and the results (default: the run's servo)",
    _name_model("standard", "model", nargs="?"),
    STIMULUS,
)
def reconstruct(arguments: argparse.Namespace, out: Path, model: "TrainedModel") -> object:
    from jaxunshear.downstream.object_reconstruction import reconstruct
    from jaxunshear.downstream.servo import load_trajectories
    from jaxunshear.report.application_figures import PICTURES, plot_objects
    from jaxunshear.text_table import format_text_table

    model.require_simulation("reconstruct")  # a model of recordings has no trajectories
    files = _find_trajectory_files(arguments, out)
    rows: list[ObjectScore] = []
    for result in reconstruct(model, [load_trajectories(file) for file in files]):
        name = str(result.task.stimulus)
        rows += result.scores
        for method, (file_name, text) in PICTURES.items():
            solids = {way: solid for (by, way), solid in result.objects.items() if by == method}
            write_bytes(out / f"{name}-{file_name}.png", plot_objects(name, solids, text))
        print(format_text_table([vars(row) for row in result.scores], OBJECT_COLUMNS))
    print(out)
    return ScoreTable(rows)


def _find_trajectory_files(arguments: argparse.Namespace, out: Path) -> list[Path]:
    names = list(list_stimulus_names(parse_stimuli(arguments.stimulus)))
    if arguments.stimulus == "all":  # outlines in files, too
        names += sorted({file.stem for file in out.glob("*.npz")} - set(names))
    files = {name: out / f"{name}.npz" for name in names}
    missing = [name for name, file in files.items() if not file.is_file()]
    if len(missing) == len(names):
        raise UserError(
            f"--out {out} holds no walks: "
            f"run `jaxunshear servo --model {arguments.model} --out {out}` first"
        )
    if arguments.stimulus != "all" and missing:
        raise UserError(
            f"--stimulus {', '.join(missing)}: {out} holds no walk of it; "
            "run `jaxunshear servo` for it first"
        )
    return [file for name, file in files.items() if name not in missing]


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


COMMANDS = (
    Command(
        "unshear",
        "remove shear from recorded images, and predict their poses",
        infer,
        (
            path("path", "RECORDINGS", IMAGES),
            *CAMERA_MODEL,
            path("--out", "DIR", "folder for images and poses.csv", required=True),
            json_file(),
        ),
    ),
    Command(
        "pose",
        "predict contact poses from recorded images, as recorded and unsheared",
        infer,
        (path("path", "RECORDINGS", IMAGES), *CAMERA_MODEL, json_file()),
    ),
    pins,
    geometry,
    servo,
    reconstruct,
)
