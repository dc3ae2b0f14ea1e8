"""Check a folder of recordings: frames, sensor, labels, and the command to run next.

diagnosis = check_recordings(Path("recordings/edge_2d"))
print("\n".join(describe(diagnosis)))
"""

import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Preprocess, Sensor
from jaxunshear.data.labels import name_labels
from jaxunshear.data.recorded_contacts import MIN_MOVE
from jaxunshear.data.recordings import IMAGE_FOLDERS, Recordings, read_image, read_recordings
from jaxunshear.data.sensor_frame import LARGEST_PX, MIN_FRAMES
from jaxunshear.data.tables import LabelProblem
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.grey import check_frame, explain_exposure, to_grey
from jaxunshear.perception.lattice import check_pin_numbers
from jaxunshear.perception.lattice_fitting import fit_lattice, make_layout
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.preprocess import combine_views, find_view, prepare_frame
from jaxunshear.progress import Progress
from jaxunshear.results.layout import read_layout
from jaxunshear.selection import select_evenly

LAYOUTS = (TACTIP_331, TACTIP_127)
INSPECTED_IMAGES = 40  # frames whose pins are found, shared by the folders
MIN_INSPECTED_PER_FOLDER = 8  # in each of many folders
MIN_PX = 32  # side of the prepared frames
MIN_PINS = 20  # frames with fewer show no layout
MIN_DOTS = 5  # frames with fewer show no pins
MIN_FOLLOWED = 0.5  # share of the frames: commands leave out the others, and half is no success
MAX_LISTED_IMAGES = 20  # problems in the text; --json has all
INVERTED = "the pins are dark on a light ground, which a layout file says"
NO_PINS = "no pins are found: frames must show light pins on a dark ground, or dark ones on a light"
FEW_PINS = f"about {{:.0f}} pins are found: sensors of fewer than {MIN_PINS} are not known here"
UNSURE = (
    "identities of pins are sure in only {:.0%} of the frames: light and focus the sensor well, "
    "and keep all of its pins in view"
)


@dataclass(frozen=True)
class PinCheck:
    """The pins in the sampled frames of a folder."""

    sampled: int  # frames
    median: float  # pins per frame
    layout: str | None  # name of the sensor with this layout; None if no layout fits
    followed: float  # share of the sampled frames in which every pin is identified
    inverted: bool  # dark pins on a light ground
    exposure: str  # what is wrong with the light or the focus; empty if pins are identified


@dataclass(frozen=True)
class LabelCheck:
    """The labels of a folder's frames."""

    posed: int  # frames with a known pose
    taps: int  # with a known pose and no move
    slides: int  # with a known pose and a move
    ranges: dict[str, tuple[float, float]]  # least and greatest value of each varying label


@dataclass(frozen=True)
class FolderCheck:
    """One folder of frames."""

    name: str
    frames: int
    left_out: dict[str, int]  # frames by reason
    size: tuple[int, int]  # width and height of the other frames, px
    pins: PinCheck | None  # None if no frame can be used
    labels: LabelCheck

    @property
    def usable(self) -> int:
        return self.frames - sum(self.left_out.values())


@dataclass(frozen=True)
class Diagnosis:
    """The result of checking the recordings at `path`."""

    path: str
    rows: list[FolderCheck]
    problems: list[Json]  # with place, row of a table, and text
    usable: bool
    next: str  # command; empty if none can use the frames
    note: str  # advice on that command, or what to do first


def check_recordings(
    path: Path, without: Sequence[int] = (), layout: Path | None = None
) -> Diagnosis:
    """Read every frame at `path` and detect the pins in about INSPECTED_IMAGES of them.

    Pins in `without` are lost, or else those that no frame shows. They are those of the file
    `layout`, or of a known sensor. Raises UserError if no frame can be used.
    """
    sensors = LAYOUTS if layout is None else (read_layout(layout),)
    check_pin_numbers(without, max(sensor.pins for sensor in sensors))
    recordings = read_recordings(path, Preprocess())
    problems = [
        note if isinstance(note, LabelProblem) else LabelProblem.from_line(path, note)
        for note in recordings.notes
    ]
    rows: dict[Path, list[int]] = {}
    for row, file in enumerate(recordings.files):
        rows.setdefault(file.parent, []).append(row)
    share = max(MIN_INSPECTED_PER_FOLDER, INSPECTED_IMAGES // len(rows))
    check_pins = partial(_check_pins, share, partial(_track_pins, sensors, without))
    with Progress(f"doctor {path.name}", len(recordings)) as progress:
        folders = [
            _check_folder(recordings, folder_rows, check_pins, problems, progress)
            for folder_rows in rows.values()
        ]
    if not any(folder.usable for folder in folders):
        raise UserError(
            f"none of {len(recordings)} images in {path} can be used; the last: {problems[-1]}"
        )
    command, note = _choose_command(path, [folder for folder in folders if folder.pins], layout)
    listed = [{"place": str(each.place), "row": each.row, "text": str(each)} for each in problems]
    return Diagnosis(str(path), folders, listed, bool(command), command, note)


def _check_folder(
    recordings: Recordings,
    rows: list[int],
    check_pins: Callable[[list[Path]], PinCheck | None],
    problems: list[LabelProblem],
    progress: Progress,
) -> FolderCheck:
    """Check the frames in `rows`, which lie in one folder, and add to `problems`."""
    files, root = [recordings.files[row] for row in rows], recordings.path
    sizes: dict[Path, tuple[int, int]] = {}
    for file in files:
        try:
            raw = read_image(file)
            check_frame(raw)
            sizes[file] = (raw.shape[1], raw.shape[0])
        except UserError as error:
            problems.append(LabelProblem.with_place(file, str(error)))
        progress.advance()
    usual = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
    usable = [file for file, size in sizes.items() if size == usual]
    for file, (width, height) in sizes.items():
        if (width, height) != usual:
            text = f"{width} x {height} pixels, where most here have {usual[0]} x {usual[1]}"
            problems.append(LabelProblem.with_place(file, text))
    unread, other_size = len(files) - len(sizes), len(sizes) - len(usable)
    left_out = {"cannot be read": unread, "of another size": other_size}
    # labels lie above the images in most layouts
    folder = files[0].parent
    labelled = folder.parent if folder.name in IMAGE_FOLDERS else folder
    is_root = root.is_file() or root in (folder, labelled)
    return FolderCheck(
        root.absolute().name if is_root else labelled.relative_to(root).as_posix(),
        len(rows),
        {reason: count for reason, count in left_out.items() if count},
        usual,
        check_pins(usable),
        _check_labels(recordings, rows),
    )


def _check_labels(recordings: Recordings, rows: list[int]) -> LabelCheck:
    unknown = np.full((len(rows), 6), np.nan)
    poses = unknown if recordings.poses is None else recordings.poses[rows]
    moves = unknown if recordings.moves is None else recordings.moves[rows]
    has_pose, has_move = np.isfinite(poses).all(axis=1), np.isfinite(moves).all(axis=1)
    is_slide = (np.abs(moves) > MIN_MOVE).any(axis=1)
    ranges = {}
    others = {name: values[rows] for name, values in recordings.others.items()}
    for name, values in name_labels(poses, moves, others).items():
        known = values[np.isfinite(values)]
        if len(known) and np.ptp(known) > (0 if name in others else MIN_MOVE):
            ranges[name] = (float(known.min()), float(known.max()))
    complete = has_pose & has_move
    taps, slides = int((complete & ~is_slide).sum()), int((complete & is_slide).sum())
    return LabelCheck(int(has_pose.sum()), taps, slides, ranges)


def _check_pins(
    share: int, track: Callable[[list[np.ndarray], bool], PinCheck], files: list[Path]
) -> PinCheck | None:
    """Detect the pins of `share` frames of one size, light or, if only these fit, dark ones."""
    raws = [read_image(files[i]) for i in select_evenly(len(files), share)]
    if not raws:
        return None
    check = track(raws, False)
    if check.followed >= MIN_FOLLOWED:
        return check
    negative = track(raws, True)
    exposure = explain_exposure(to_grey(raws[len(raws) // 2]))
    is_better = not exposure and check.median < MIN_PINS <= negative.median
    if negative.followed > check.followed or (negative.followed == check.followed and is_better):
        return negative
    return replace(check, exposure=exposure)


def _track_pins(
    sensors: Sequence[Sensor], without: Sequence[int], raws: list[np.ndarray], dark: bool
) -> PinCheck:
    preprocess = Preprocess(size=int(np.clip(min(raws[0].shape[:2]), MIN_PX, LARGEST_PX)))
    view = combine_views([find_view(preprocess, raw, dark) for raw in raws])
    detections = [detect_pins(prepare_frame(preprocess, raw, view)) for raw in raws]
    median = float(np.median([len(each.pins) for each in detections]))
    layout, followed = None, 0.0
    for sensor in sensors:
        with suppress(UserError):  # too few pins, or in another pattern
            lattice = fit_lattice([each.pins for each in detections], make_layout(sensor), without)
            tracks = track_all(lattice, detections)
            followed = float(np.mean([track.identified for track in tracks]))
            layout = sensor.name
            break
    is_known = any(sensor.is_dark for sensor in sensors)
    return PinCheck(len(detections), median, layout, followed, dark and not is_known, "")


def _choose_command(
    path: Path, usable: Sequence[FolderCheck], file: Path | None
) -> tuple[str, str]:
    """Choose the next command for the usable folders at `path`, and advice on it.

    `file` is a layout's.
    """
    pins = usable[0].pins
    assert pins is not None
    if len({(each.size, each.pins.layout, each.pins.inverted) for each in usable if each.pins}) > 1:
        largest = path / max(usable, key=lambda folder: folder.usable).name
        advice = "these folders differ in size or sensor: check each on its own"
        return _join("doctor", largest), advice
    if reason := _explain_pins(pins):
        return "", reason
    if pins.layout is None or pins.inverted:
        known = " and ".join(f"{sensor.pins} ({sensor.name})" for sensor in LAYOUTS)
        layouts = f"no known layout, {known}" if file is None else f"{file} not"
        unknown = f"about {pins.median:.0f} pins match {layouts}"
        advice = (
            f"{INVERTED if pins.inverted else unknown}; frames of the untouched sensor are best"
        )
        return _join("layout", path, "--out", "layout.json"), advice
    taps = sum(each.labels.taps for each in usable)
    slides = sum(each.labels.slides for each in usable)
    named = () if file is None else ("--layout", file)
    if taps and slides:
        folders = _find_taps_and_slides(path, usable)
        return _join("fit", *folders, *named, "--unshear.input", "pins"), ""
    if taps or slides:
        advice = "these networks learn to read poses, not to unshear"
        if taps and pins.layout == TACTIP_331.name and not file:
            advice += "; with --unshear.input pins --paired.pairing simulated they unshear"
        return _join("fit", "--taps" if taps else "--slides", path, *named), advice
    if file is None:
        return _choose_inference(path, usable, pins.layout)
    return _join("pins", path, *named), "training needs labels of poses, which these frames lack"


def _find_taps_and_slides(path: Path, usable: Sequence[FolderCheck]) -> tuple[str | Path, ...]:
    """Find the arguments of `fit`: a folder of taps and one of slides, or else `path` for both."""
    taps = [path / each.name for each in usable if not each.labels.slides]
    slides = [path / each.name for each in usable if not each.labels.taps]
    if len(taps) == len(slides) == 1 and len(usable) == 2:
        return "--taps", taps[0], "--slides", slides[0]
    return "--taps", path, "--slides", path


def _explain_pins(pins: PinCheck) -> str:
    """Say why no command can follow these pins; empty if one may."""
    if pins.median < MIN_DOTS:
        return "; ".join(filter(None, (NO_PINS, pins.exposure)))
    if pins.exposure:
        return pins.exposure
    if pins.median < MIN_PINS:
        return FEW_PINS.format(pins.median)
    unsure = pins.layout is not None and pins.followed < MIN_FOLLOWED
    return UNSURE.format(pins.followed) if unsure else ""


def _choose_inference(path: Path, usable: Sequence[FolderCheck], layout: str) -> tuple[str, str]:
    """Choose the command for frames whose labels are not enough for training."""
    if sum(each.usable for each in usable) < MIN_FRAMES:
        advice = f"`unshear` needs {MIN_FRAMES} frames of the same sensor: name them by --like"
        return _join("pins", path, "--sensor", layout), advice
    advice = "training needs labels of poses, which these frames lack"
    if any(each.labels.posed for each in usable):
        advice = "no moves are known: to train, name a folder each by `fit --taps DIR --slides DIR`"
    named = () if layout == TACTIP_331.name else ("--model", "skin127")
    return _join("unshear", path, *named, "--out", "unsheared"), advice


def _join(*words: str | Path) -> str:
    return shlex.join(["jaxunshear", *map(str, words)])


def describe(diagnosis: Diagnosis) -> list[str]:
    """Describe the diagnosis in lines of text."""
    folders, problems = diagnosis.rows, diagnosis.problems
    frames, usable = sum(each.frames for each in folders), sum(each.usable for each in folders)
    lines = [f"{diagnosis.path}: {_count(frames, 'frame')} in {_count(len(folders), 'folder')}"]
    reasons: Counter[str] = Counter()
    for folder in folders:
        lines += ["", folder.name, *_describe_folder(folder)]
        reasons.update(folder.left_out)
    counts = "".join(f", {count} {reason}" for reason, count in reasons.items())
    share = f"{frames - usable} of {frames} frames ({1 - usable / frames:.1%})"
    lines += ["", f"left out: {share}{counts}"]
    lines += [f"problem: {problem['text']}" for problem in problems[:MAX_LISTED_IMAGES]]
    if len(problems) > MAX_LISTED_IMAGES:
        lines.append(f"problem: {len(problems) - MAX_LISTED_IMAGES} more, listed by --json")
    lines.append(f"next: {diagnosis.next or 'no command can use these frames'}")
    return [*lines, f"note: {diagnosis.note}"] if diagnosis.note else lines


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _describe_folder(folder: FolderCheck) -> list[str]:
    pins, labels = folder.pins, folder.labels
    if pins is None:
        return [f"  frames: {folder.frames}, none can be used"]
    layout = f"layout of {pins.layout}" if pins.layout else "no known layout"
    dark = ", dark on a light ground" if pins.inverted else ""
    share = f"followed in {pins.followed:.0%} of {_count(pins.sampled, 'sampled frame')}"
    ranges = [f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in labels.ranges.items()]
    counted = (("pose", labels.posed), ("tap", labels.taps), ("slide", labels.slides))
    counts = ", ".join(_count(number, noun) for noun, number in counted)
    return [
        f"  frames: {folder.usable} of {folder.size[0]} x {folder.size[1]} px",
        f"  pins: about {pins.median:.0f}, {layout}{dark}; {share}",
        f"  labels: {counts}; varying: {', '.join(ranges) or 'none'}",
    ]
