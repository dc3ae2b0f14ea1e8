"""Perception for a robot: a frame in; unsheared image, pose and confidence out, as a JSON line.

A frame that cannot be used, or is not understood, is reported and counted, and the next one comes.
"""

import base64
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from jaxunshear.apps.robot.frame_sources import SourceFrame
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import PROBES
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes
from jaxunshear.inference.forward import UNSHEARED
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.metrics import compute_pose_errors
from jaxunshear.perception.drawing import encode_png, to_uint8
from jaxunshear.perception.preprocess import View, combine_views, find_view, prepare_frame
from jaxunshear.results.applications import StreamResult

FAST_COMPRESSION = 1  # zlib's level: a frame has milliseconds

LabelReader = Callable[[int], Mapping[str, float]]  # from a frame's number to its labels


class _Answer(NamedTuple):
    unsheared: np.ndarray | None  # (S, S) in [0, 1]
    pose: dict[str, float]
    confidence: float
    networks_ms: float
    touch: dict[str, float]  # what pins show of the contact
    error: str = ""  # why there is no pose


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

    def add(self, answer: _Answer, errors: Mapping[str, float], total_ms: float) -> None:
        self.networks_ms.append(answer.networks_ms)
        self.total_ms.append(total_ms)
        self.confidences.append(answer.confidence)
        for name, value in errors.items():
            self.errors.setdefault(name, []).append(value)


def stream(
    frames: Iterator[SourceFrame],
    live: bool,
    model: TrainedModel,
    out: TextIO,
    images: Path | None,
    inline: bool,
    read_labels: LabelReader | None = None,
) -> StreamResult:
    """Write a line for each frame to `out`, and return a summary.

    A frame that is not understood has no pose and no image, but a reason and a confidence of 0. A
    live source also ends by Ctrl-C, or when its camera is lost.

    Args:
        images: a folder for unsheared images.
        inline: whether images are written into the lines as base64 PNG instead.
        read_labels: with these, lines and summary have errors, too.
    """
    find_view = make_steady_view(model.preprocess)
    stats = _StreamStats()
    start = time.perf_counter()
    try:
        for frame in _end_when_lost(frames, live, stats.problems):
            arrival = time.perf_counter()
            stats.missed += frame.number - stats.last - 1
            stats.last = frame.number
            line: Json = {"frame": frame.number, "name": frame.name}
            try:
                answer = _answer_frame(model, frame, find_view)
            except UserError as error:
                answer = _Answer(None, {}, 0.0, 0.0, {}, str(error))
            if answer.touch:
                line["touch"] = {name: round(value, 4) for name, value in answer.touch.items()}
            if answer.error:
                stats.skipped += 1
                stats.problems[answer.error] += 1
                _write_line(out, line | {"confidence": 0.0, "error": answer.error})
                continue
            line |= {name: round(value, 4) for name, value in answer.pose.items()}
            line["confidence"] = round(answer.confidence, 4)
            errors = _compute_errors(answer.pose, read_labels(frame.number) if read_labels else {})
            line |= {f"error_{name}": round(value, 4) for name, value in errors.items()}
            if answer.unsheared is not None:
                line |= _store_image(images, inline, frame, answer.unsheared)
            stats.add(answer, errors, 1e3 * (time.perf_counter() - arrival))
            _write_line(out, line | {"ms": round(stats.total_ms[-1], 3)})
    except KeyboardInterrupt:  # a camera's usual end
        if not live or not stats.total_ms:
            raise
    return _summarise(stats, live, time.perf_counter() - start)


def _answer_frame(
    model: TrainedModel, frame: SourceFrame, find_view: Callable[[np.ndarray], View]
) -> _Answer:
    """Run the networks on a frame. Raises UserError if it cannot be used, or is not understood."""
    if frame.pixels is None:
        raise UserError(frame.problem)
    view = model.view or frame.view or find_view(frame.pixels)
    image = prepare_frame(model.preprocess, frame.pixels, view)
    if not image.any():
        raise UserError("nothing white is left of this frame: no pins to see")
    start = time.perf_counter()
    predictions = model.predict(image[None])
    networks_ms = 1e3 * (time.perf_counter() - start)
    touch = predictions.touch.describe(0)
    if reason := str(predictions.rejection[0]):
        return _Answer(None, {}, 0.0, networks_ms, touch, reason)
    poses = predictions.poses.get(UNSHEARED) or next(iter(predictions.poses.values()), {})
    pose = {name: float(values[0]) for name, values in poses.items()}
    unsheared = None if predictions.unsheared is None else predictions.unsheared[0]
    return _Answer(unsheared, pose, float(predictions.confidence[0]), networks_ms, touch)


def _summarise(stats: _StreamStats, live: bool, seconds: float) -> StreamResult:
    used = len(stats.total_ms)
    return StreamResult(
        frames=used + stats.skipped + stats.missed,
        used=used,
        skipped=stats.skipped,
        dropped=stats.missed,
        problems=dict(stats.problems),
        live=live,
        frames_per_s=used / max(seconds, 1e-9),
        confidence=float(np.mean(stats.confidences)) if used else None,
        pose_mae={name: float(np.mean(values)) for name, values in stats.errors.items()},
        latency_ms=_compute_percentiles(stats.total_ms),
        networks_ms=_compute_percentiles(stats.networks_ms),
    )


def _compute_errors(pose: dict[str, float], labels: Mapping[str, float]) -> dict[str, float]:
    names = [name for name in pose if np.isfinite(labels.get(name, np.nan))]
    truth = {name: np.array([labels[name]]) for name in names}
    errors = compute_pose_errors({name: np.array([pose[name]]) for name in truth}, truth)
    return {name: float(error[0]) for name, error in errors.items()}


def make_steady_view(preprocess: Preprocess) -> Callable[[np.ndarray], View]:
    """Make a function from a camera's frames, one by one, to the view that they have in common.

    It is that of the first PROBES usable frames of each size, as far as they have come.
    """
    views: dict[tuple[int, ...], list[View]] = {}
    common: dict[tuple[int, ...], View] = {}

    def update_view(raw: np.ndarray) -> View:
        views_of_size = views.setdefault(raw.shape, [])
        if len(views_of_size) < PROBES:
            views_of_size.append(find_view(preprocess, raw))
            common[raw.shape] = combine_views(views_of_size)
        return common[raw.shape]

    return update_view


def _end_when_lost(
    frames: Iterator[SourceFrame], live: bool, problems: Counter[str]
) -> Iterator[SourceFrame]:
    """Yield frames; if a live source is lost, end them and store the problem."""
    try:
        yield from frames
    except UserError as error:
        if not live:
            raise
        problems[str(error)] = 1


def _compute_percentiles(values: list[float]) -> dict[str, float] | None:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 95, 99)} if values else None


def _write_line(out: TextIO, line: Json) -> None:
    out.write(json.dumps(line) + "\n")
    out.flush()


def _store_image(folder: Path | None, inline: bool, frame: SourceFrame, image: np.ndarray) -> Json:
    """Write an image into `folder`, or return it inline, as a field of the line."""
    if folder is None and not inline:
        return {}
    png = encode_png(to_uint8(image), FAST_COMPRESSION)
    if folder is None:
        return {"image_png": base64.b64encode(png).decode()}
    path = folder / f"{frame.number:06d}.png"
    write_bytes(path, png)
    return {"image": str(path)}
