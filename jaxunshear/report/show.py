"""Draw what a model makes of a few frames: unsheared, the pins' motion, poses, and a sentence.

>>> model = load_model_for(Path("recordings/edge/shear"), Path("skin"))
>>> write_bytes(Path("show.png"), plot_frames(predict_frames(path, model), model))
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.data import Recorded
from jaxunshear.config.targets import get_unit
from jaxunshear.data.labels import name_labels
from jaxunshear.data.pairing import find_recorded_taps
from jaxunshear.data.recorded_contacts import read_test_contacts
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.data.videos import is_video
from jaxunshear.errors import UserError
from jaxunshear.inference.forward import AS_RECORDED, UNSHEARED
from jaxunshear.inference.readers import Predictions
from jaxunshear.inference.trained_model import TrainedModel, load_model
from jaxunshear.perception.pin_tracking import track_images
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.perception.touch import NO_CONTACT_REASON, TouchGauge, measure_field
from jaxunshear.selection import select_evenly
from jaxunshear.style import encode_png

SHOWN_FRAMES = 4
PICTURE_IN, HEAD_IN = 12.0, 1.5  # width of the picture; height of its title and keys
ROW_IN, DPI = 3.1, 100
PANELS = (1.0, 1.0, 1.05, 1.35)  # widths: frame, unsheared, motion, words
TITLES = ("the frame, black and white", "unsheared, as of a tap", "motion of the pins, mm")
TAKEN_OUT = "taken_out"  # by unshearing, of the motion
LABEL, TAP = "label", "tap"  # kinds of poses that show which estimate is right
TAP_FOLDER = "tap"  # beside the slides
COLOURS = {AS_RECORDED: "#8a93a3", UNSHEARED: "#1f6feb", TAKEN_OUT: "#d9822b"}
KEYS = {
    AS_RECORDED: "as recorded",
    UNSHEARED: "unsheared: what a tap would move",
    TAKEN_OUT: "taken out: what the slide has added",
}
ARROW_LENGTH = 3.0  # times the motion
WORDS, MONOSPACE = 46, "DejaVu Sans Mono"  # letters in a line
TITLE_PT, TEXT_PT, SMALL_PT = 11, 9.5, 8.5
NOTE_LETTERS = 150  # in a line above the panels
PNG_SOFTWARE = "jaxunshear show"


class ShownFrame(NamedTuple):
    """What a model makes of one frame."""

    name: str
    image: np.ndarray  # (S, S) of {0, 255}
    unsheared: np.ndarray | None  # (S, S) in [0, 1]; None for one that is rejected
    motion_mm: Mapping[str, np.ndarray]  # (P, 2) of the pins as (column, row), by kind
    place_mm: np.ndarray  # (P, 2) of the untouched pins
    poses: Mapping[str, Mapping[str, float]]  # by quantity, then by kind; empty if it is rejected
    sentence: str


def load_model_for(path: Path, name: Path, like: Path | None = None) -> TrainedModel:
    """Load a model for frames at `path`: without `like`, pins rest as in the folder of these."""
    holds_frames = path.is_dir() or is_video(path)
    return load_model(name, like or (path if holds_frames else path.parent))


def predict_frames(path: Path, model: TrainedModel) -> list[ShownFrame]:
    """Have a model read a frame, or up to SHOWN_FRAMES of a folder, evenly spaced.

    Raises UserError.
    """
    recordings = read_recordings(path, model.preprocess)
    labels = name_labels(recordings.poses, recordings.moves, recordings.others)
    rows = select_evenly(len(recordings), SHOWN_FRAMES)
    some = replace(recordings, files=tuple(recordings.files[row] for row in rows))
    frames = list(some.iterate_frames(model.view))
    images = np.stack([frame.image for frame in frames])
    predictions = model.predict(images)
    motions = _measure_motions(model, images, predictions)
    has_labels = set().union(*predictions.poses.values()) <= labels.keys()
    files = [some.files[frame.row] for frame in frames]
    taps = {} if has_labels else predict_taps(path, files, model)
    shown = []
    for i, frame in enumerate(frames):
        reason = str(predictions.rejection[i])
        label = {name: float(values[rows[frame.row]]) for name, values in labels.items()}
        tap = taps.get(files[i], {})
        poses = {} if reason else collect_poses(predictions, i, label, tap)
        unsheared = predictions.unsheared
        shown.append(
            ShownFrame(
                frame.name,
                frame.image,
                None if reason or unsheared is None else unsheared[i],
                {kind: motion[i] for kind, motion in motions.items()},
                model.touch_reader.gauge.place_mm,
                poses,
                describe_touch(reason, predictions.touch.describe(i)),
            )
        )
    return shown


def predict_taps(
    path: Path, files: Sequence[Path], model: TrainedModel
) -> dict[Path, dict[str, float]]:
    """Have PoseNet read recorded taps at the poses of slides, by the files of the slides.

    Taps lie at `path`, or in the folder `tap` beside it. Slides without such a tap are left out.
    """
    beside = path.resolve().parent / TAP_FOLDER
    folder = beside if beside.is_dir() and not beside.samefile(path) else path
    images: dict[Path, np.ndarray] = {}
    with suppress(UserError):  # labels do not say which are taps, or a tap cannot be read
        contacts = read_test_contacts(Recorded(tap_folder=str(folder), slide_folder=str(path)))
        is_shown = np.array([file in files for file in contacts.files])
        slides = np.flatnonzero(contacts.is_slide & is_shown)
        for slide, tap in zip(slides, find_recorded_taps(contacts, slides), strict=True):
            if tap >= 0:
                raw = read_image(contacts.files[tap])
                view = model.view or model.find_view(raw)
                images[contacts.files[slide]] = prepare_frame(model.preprocess, raw, view)
    poses = model.predict(np.stack(list(images.values()))).poses if images else {}
    rows = zip(*poses.get(AS_RECORDED, {}).values(), strict=True)  # (N,) of each quantity
    return {
        file: dict(zip(poses[AS_RECORDED], map(float, row), strict=True))
        for file, row in zip(images, rows, strict=False)  # no rows without a PoseNet
    }


def collect_poses(
    predictions: Predictions, row: int, label: Mapping[str, float], tap: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Collect poses by quantity and kind, and what is right: the label, or else the tap's pose.

    Labels count if they have all quantities: a name or two in common do not make them comparable.
    """
    poses: dict[str, dict[str, float]] = {}
    for kind, values in predictions.poses.items():
        for name, value in values.items():
            poses.setdefault(name, {})[kind] = float(value[row])
    kind, right = (LABEL, label) if poses.keys() <= label.keys() else (TAP, tap)
    for name, kinds in poses.items():
        if np.isfinite(right.get(name, np.nan)):
            kinds[kind] = right[name]
        if get_unit(name) == "deg":  # 182 beside 179, not -178
            angles = np.array(list(kinds.values()))
            near_last = angles[-1] + wrap_degrees(angles - angles[-1])
            kinds |= zip(kinds, near_last.tolist(), strict=True)
    return poses


def _measure_motions(
    model: TrainedModel, images: np.ndarray, predictions: Predictions
) -> dict[str, np.ndarray]:
    """Measure motions (B, P, 2) mm of pins from their untouched places, NaN where not known."""
    gauge, pins = model.touch_reader.gauge, model.reader.read(images).pins
    if pins is None:
        lattice = model.touch_reader.lattice
        pins = lattice.rest + track_images(lattice, images, independent=True).motion
    recorded = _measure_motion(gauge, pins)
    if UNSHEARED not in predictions.pins:
        return {AS_RECORDED: recorded}
    unsheared = _measure_motion(gauge, predictions.pins[UNSHEARED])
    rejected = np.isnan(unsheared)
    return {
        AS_RECORDED: np.where(rejected, recorded, np.nan),
        UNSHEARED: unsheared,
        TAKEN_OUT: recorded - unsheared,
    }


def _measure_motion(gauge: TouchGauge, pins: np.ndarray) -> np.ndarray:
    motion = np.full(pins.shape, np.nan)
    followed = np.isfinite(pins).any(axis=(1, 2))
    motion[followed] = measure_field(gauge, pins[followed]).motion_mm
    return motion


def describe_touch(reason: str, touch: Mapping[str, float]) -> str:
    """Say in a sentence what a frame shows, by fields of `Touch`, or why there is no value."""
    if reason == NO_CONTACT_REASON:
        return (
            f"No contact: the dome touches nothing (probability of a contact "
            f"{touch['contact']:.2f}). So there is no pose."
        )
    if reason:
        return f"Not understood: {reason}. So there is no value."
    if "slip" not in touch:
        return "Understood, but no contact could be measured."
    shear = np.hypot(touch["shear_x_mm"], touch["shear_y_mm"])
    return (
        f"Contact (probability {touch['contact']:.2f}). {touch['slip']:.0%} of the contact "
        f"slips. Friction has dragged the skin by {shear:.2f} mm \N{PLUS-MINUS SIGN} "
        f"{touch['shear_half_width_mm']:.2f} and turned it by {abs(touch['shear_deg']):.1f} deg "
        f"\N{PLUS-MINUS SIGN} {touch['shear_half_width_deg']:.1f} (95 % intervals)."
    )


def plot_frames(frames: Sequence[ShownFrame], model: TrainedModel) -> bytes:
    """Plot a row of panels for each frame as a PNG that `check_new_picture` knows."""
    height = ROW_IN * len(frames) + HEAD_IN
    figure = Figure(figsize=(PICTURE_IN, height), layout="constrained", dpi=DPI)
    panels = figure.subplots(len(frames), len(PANELS), squeeze=False, width_ratios=PANELS)
    for row, frame in zip(panels, frames, strict=True):
        _draw_image(row[0], frame.image)
        _draw_image(row[1], frame.unsheared)
        _draw_motion(row[2], frame)
        _write_words(row[3], frame)
    for axes, title in zip(panels[0], TITLES, strict=False):
        axes.set_title(title, fontsize=TITLE_PT)
    note = fill(model.source.describe(), NOTE_LETTERS)
    figure.suptitle(f"Model {model.folder.name}\n{note}", fontsize=TEXT_PT)
    drawn = []
    for kind in frames[0].motion_mm:
        if any(np.isfinite(frame.motion_mm[kind]).any() for frame in frames):
            drawn.append(kind)
    keys = [Line2D([], [], color=COLOURS[kind], linewidth=2, label=KEYS[kind]) for kind in drawn]
    title = f"Motion of pins from their untouched places, drawn {ARROW_LENGTH:g} times as long"
    figure.legend(
        handles=keys,
        title=title,
        fontsize=TEXT_PT,
        title_fontsize=TEXT_PT,
        loc="outside lower center",
        ncols=len(keys),
    )
    return encode_png(figure, PNG_SOFTWARE)


def _draw_image(axes: Axes, image: np.ndarray | None) -> None:
    axes.set(xticks=[], yticks=[])
    if image is None:
        axes.text(0.5, 0.5, "none", ha="center", transform=axes.transAxes, fontsize=TEXT_PT)
        axes.set_aspect("equal")
    else:
        axes.imshow(image, cmap="gray", vmin=0, vmax=image.max() or 1, interpolation="nearest")


def _draw_motion(axes: Axes, frame: ShownFrame) -> None:
    place = frame.place_mm
    axes.plot(*place.T, ".", color="0.8", markersize=2)
    for kind, motion in frame.motion_mm.items():
        if np.isfinite(motion).any():
            axes.quiver(
                *place.T,
                *motion.T,
                color=COLOURS[kind],
                angles="xy",
                scale_units="xy",
                scale=1 / ARROW_LENGTH,
                width=0.004,
            )
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.tick_params(labelsize=SMALL_PT)


def _write_words(axes: Axes, frame: ShownFrame) -> None:
    axes.set_axis_off()
    axes.text(0, 1, frame.name[-WORDS:], va="top", fontsize=TEXT_PT, fontweight="bold")
    axes.text(0, 0.88, fill(frame.sentence, WORDS), va="top", fontsize=TEXT_PT)
    table = "\n".join(format_poses(frame.poses))
    axes.text(0, 0.42, table, va="top", fontsize=SMALL_PT, family=MONOSPACE)


def format_poses(poses: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Format a heading and a line for each quantity; none without poses."""
    if not poses:
        return []
    kinds = dict.fromkeys(kind for values in poses.values() for kind in values)
    lines = ["pose       " + "".join(f"{kind.replace('_', ' '):>12}" for kind in kinds)]
    for name, values in poses.items():
        unit = get_unit(name)
        quantity = f"{name.removesuffix(f'_{unit}')}, {unit}"
        cells = [f"{values[kind]:.2f}" if kind in values else "-" for kind in kinds]
        lines.append(f"{quantity:<11}" + "".join(f"{cell:>12}" for cell in cells))
    return lines
