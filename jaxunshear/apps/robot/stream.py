"""Perception for a robot: a frame in; pose and confidence out, as a line of JSON.

A frame that cannot be used, or is not understood, is reported and counted, and the next one comes.
"""

import base64
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TextIO

import numpy as np

from jaxunshear.apps.robot.pose_filter import FilterState, find_noise, update_filter
from jaxunshear.apps.robot.source_frame import SourceFrame, SourceLostError
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object_if_sound, write_bytes
from jaxunshear.inference.forward import UNSHEARED
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.metrics import compute_pose_errors
from jaxunshear.perception.drawing import encode_png, to_uint8
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.results.applications import StreamResult

SCHEMA = 1  # of the lines
INLINE = Path("-")  # images go into the lines
FAST_COMPRESSION = 1  # zlib's level: a frame has milliseconds
FROZEN_S = 1.0  # for which a camera's picture does not change by one pixel before it is frozen,
FROZEN_FRAMES = 10  # and in how many frames at least: noise changes each
BINARY_LEVELS = 2  # of images that show no noise

LabelReader = Callable[[int], Mapping[str, float]]  # from a frame's number to its labels


class Outputs(NamedTuple):
    """What goes where."""

    lines: TextIO
    images: Path | None = None  # a folder for unsheared images, or INLINE
    is_filtered: bool = False  # poses are also smoothed over time
    read_labels: LabelReader | None = None  # with these, lines and summary have errors, too


class _Answer(NamedTuple):
    """What becomes of a frame; poses, mm and deg, are by quantity."""

    pose: Mapping[str, float]
    confidence: float
    error: str = ""  # why there is no pose
    unsheared: np.ndarray | None = None  # (S, S) in [0, 1]
    networks_ms: float = 0.0
    touch: Mapping[str, float] = MappingProxyType({})  # what pins show of the contact


@dataclass
class _StreamStats:
    """What a stream has come to so far."""

    total_ms: list[float] = field(default_factory=list)  # of each frame that was used
    networks_ms: list[float] = field(default_factory=list)
    confidences: list[float] = field(default_factory=list)
    errors: dict[str, list[float]] = field(default_factory=dict)  # by quantity
    problems: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    missed: int = 0
    last: int = -1  # number of a frame
    lost: str = ""

    def add(self, answer: _Answer, errors: Mapping[str, float], total_ms: float) -> None:
        if answer.error:
            self.skipped += 1
            self.problems[answer.error] += 1
            return
        self.networks_ms.append(answer.networks_ms)
        self.total_ms.append(total_ms)
        self.confidences.append(answer.confidence)
        for name, value in errors.items():
            self.errors.setdefault(name, []).append(value)


def stream(
    frames: Iterator[SourceFrame], is_live: bool, model: TrainedModel, outputs: Outputs
) -> StreamResult:
    """Write a line for each frame, and return a summary.

    A frame that is not understood has no pose and no image, but a reason and a confidence of 0. So
    has one of a camera whose picture is frozen. A live source also ends by Ctrl-C, or when it is
    lost.
    """
    check_frozen = make_frozen_check(model.force)
    half_widths = read_half_widths(model.folder)
    noise = find_noise(model.targets, half_widths) if outputs.is_filtered else {}
    state: FilterState | None = None
    stats, start = _StreamStats(), time.perf_counter()
    try:
        for frame in _end_when_lost(frames, stats):
            arrival = time.perf_counter()
            stats.missed += frame.number - stats.last - 1
            stats.last = frame.number
            try:
                check_frozen(frame)
                answer = _answer_frame(model, frame)
            except UserError as error:
                answer = _Answer({}, 0.0, str(error))
            if outputs.is_filtered and answer.pose and frame.time_s is not None:
                state = update_filter(state, frame.time_s, answer.pose, noise)
            labels = outputs.read_labels(frame.number) if outputs.read_labels else {}
            errors = _compute_errors(answer.pose, labels)
            line = make_line(frame, answer, errors, half_widths, state)
            line |= _store_image(outputs.images, frame, answer.unsheared)
            total_ms = 1e3 * (time.perf_counter() - arrival)
            stats.add(answer, errors, total_ms)
            _write_line(outputs.lines, line | {"ms": round(total_ms, 3)})
    except KeyboardInterrupt:  # a camera's usual end
        if not is_live or not stats.total_ms:
            raise
    return _summarise(stats, is_live, time.perf_counter() - start)


def make_line(
    frame: SourceFrame,
    answer: _Answer,
    errors: Mapping[str, float],
    half_widths: Mapping[str, float],
    state: FilterState | None,
) -> Json:
    """Make the line of a frame, but for its image and its time; docs/stream.md has the fields."""
    line: Json = {"schema": SCHEMA, "frame": frame.number, "name": frame.name}
    line |= {"time_s": frame.time_s, "confidence": round(answer.confidence, 4)}
    if answer.touch:
        line["touch"] = _round(answer.touch)
    if answer.error:
        return line | {"error": answer.error}
    line["pose"] = _round(answer.pose)
    if half_widths:
        line["half_width"] = _round(half_widths)
    if state is not None and state.time_s == frame.time_s:
        line |= {"filtered": _round(state.pose), "rate": _round(state.rate)}
    if errors:
        line["label_error"] = _round(errors)
    return line


def _round(values: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in values.items()}


def _answer_frame(model: TrainedModel, frame: SourceFrame) -> _Answer:
    """Run the networks on a frame. Raises UserError if it cannot be used, or is not understood."""
    if frame.pixels is None:
        raise UserError(frame.problem)
    view = model.view or frame.view or model.find_view(frame.pixels)
    image = prepare_frame(model.preprocess, frame.pixels, view)
    if not image.any():
        raise UserError("nothing white is left of this frame: no pins to see")
    start = time.perf_counter()
    predictions = model.predict(image[None])
    networks_ms = 1e3 * (time.perf_counter() - start)
    touch = predictions.touch.describe(0)
    if reason := str(predictions.rejection[0]):
        return _Answer({}, 0.0, reason, networks_ms=networks_ms, touch=touch)
    poses = predictions.poses.get(UNSHEARED) or next(iter(predictions.poses.values()), {})
    pose = {name: float(values[0]) for name, values in poses.items()}
    if not np.isfinite([*pose.values()]).all():
        raise UserError("the networks gave no finite pose for this frame")
    unsheared = None if predictions.unsheared is None else predictions.unsheared[0]
    return _Answer(pose, float(predictions.confidence[0]), "", unsheared, networks_ms, touch)


def make_frozen_check(force: bool) -> Callable[[SourceFrame], None]:
    """Make a function of a camera's or video's frames, one by one, that refuses a frozen picture.

    With `force` it refuses none: a simulated camera has no noise. Binary images show none either.
    """
    first: list[SourceFrame] = []  # of those that show the same
    count = 0

    def check(frame: SourceFrame) -> None:
        nonlocal count
        if force or frame.time_s is None or frame.pixels is None:
            return
        if not first or not np.array_equal(np.asarray(first[0].pixels), frame.pixels):
            first[:], count = [frame], 0
        count += 1
        since = frame.time_s - (first[0].time_s or 0.0)
        is_frozen = count > FROZEN_FRAMES and since > FROZEN_S
        if is_frozen and len(np.unique(frame.pixels)) > BINARY_LEVELS:
            raise UserError("the picture is frozen: no pixel of it changes any more")

    return check


def read_half_widths(run: Path) -> dict[str, float]:
    """Read the half-widths that hold 95 % of a run's errors, by quantity; none for other models."""
    results = read_object_if_sound(run / "results.json") or {}
    by_kind = results.get("half_width") or {}
    return dict(by_kind.get(UNSHEARED) or {})


def _summarise(stats: _StreamStats, is_live: bool, seconds: float) -> StreamResult:
    used = len(stats.total_ms)
    return StreamResult(
        frames=used + stats.skipped + stats.missed,
        used=used,
        skipped=stats.skipped,
        dropped=stats.missed,
        problems=dict(stats.problems),
        live=is_live,
        lost=stats.lost,
        frames_per_s=used / max(seconds, 1e-9),
        confidence=float(np.mean(stats.confidences)) if used else None,
        pose_mae={name: float(np.mean(values)) for name, values in stats.errors.items()},
        latency_ms=_compute_percentiles(stats.total_ms),
        networks_ms=_compute_percentiles(stats.networks_ms),
    )


def _compute_errors(pose: Mapping[str, float], labels: Mapping[str, float]) -> dict[str, float]:
    names = [name for name in pose if np.isfinite(labels.get(name, np.nan))]
    truth = {name: np.array([labels[name]]) for name in names}
    errors = compute_pose_errors({name: np.array([pose[name]]) for name in truth}, truth)
    return {name: float(error[0]) for name, error in errors.items()}


def _end_when_lost(frames: Iterator[SourceFrame], stats: _StreamStats) -> Iterator[SourceFrame]:
    """Yield frames; if a live source is lost, end them and store why."""
    try:
        yield from frames
    except SourceLostError as error:
        stats.lost = str(error)


def _compute_percentiles(values: list[float]) -> dict[str, float] | None:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 95, 99)} if values else None


def _write_line(out: TextIO, line: Json) -> None:
    out.write(json.dumps(line) + "\n")
    out.flush()


def _store_image(images: Path | None, frame: SourceFrame, image: np.ndarray | None) -> Json:
    """Write an image into a folder, or return it INLINE, as a field of the line."""
    if images is None or image is None:
        return {}
    png = encode_png(to_uint8(image), FAST_COMPRESSION)
    if images == INLINE:
        return {"image_png": base64.b64encode(png).decode()}
    path = images / f"{frame.number:06d}.png"
    write_bytes(path, png)
    return {"image": str(path)}
