"""Perception for a robot: frame in; unsheared image, pose and a confidence out, as a JSON line each.

The step is compiled once, before the first frame, and holds E, DC and PoseNet with their weights: no
shear code, no DS. A frame that cannot be used, or is not understood, is reported
and counted, and the next one comes.
"""

import base64
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TextIO

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.apps.robot.frame_sources import SourceFrame
from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.image import Preprocess
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.config.targets import list_target_names
from jaxunshear.data.preprocessing import SensorFrame as PinFrame
from jaxunshear.data.recordings import PROBES
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes
from jaxunshear.inference.perceiver import UNSHEARED, load_perceiver, load_sensor_appearance
from jaxunshear.inference.perception import Forward, compute_confidence, load_forward
from jaxunshear.metrics import compute_pose_errors
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.weights import Variables
from jaxunshear.perception.png import encode_png, to_uint8
from jaxunshear.perception.preprocess import View, combine_views, find_view, prepare_frame
from jaxunshear.perception.sensor_check import (
    MIN_PLAUSIBILITY,
    NO_MINIMUM,
    SensorAppearance,
    compute_plausibility,
    explain_rejection,
)
from jaxunshear.results.applications import StreamResult

FAST_COMPRESSION = 1  # zlib's level: a frame has milliseconds


class StreamOutput(NamedTuple):
    """What networks give for one frame, whether they understood it or not."""

    unsheared: np.ndarray | None  # unsheared (S, S) in [0, 1]
    pose: dict[str, float]
    confidence: float  # see `confidence`
    identified: bool = True  # pins were identified, or none are needed


Step = Callable[[np.ndarray], StreamOutput]  # of a binary image (S, S) uint8
LabelReader = Callable[
    [int], Mapping[str, float]
]  # labels of a frame by its number, those that are known


class StreamModel(NamedTuple):
    """What a stream needs of a model."""

    step: Step
    preprocess: Preprocess  # how frames are prepared for it
    view: View | None  # crop of the frames that it learnt from; None: the stream's own
    expected: SensorAppearance | None = (
        None  # how its sensor appears: confidence falls for what appears otherwise
    )
    min_plausibility: float = MIN_PLAUSIBILITY  # plausibility of a frame that is understood


def load_stream_model(
    model: Path,
    experiment: Experiment,
    frame: PinFrame | None,
    force: bool = False,
) -> StreamModel:
    """Make a model ready for a stream, compiled already.

    `frame` as `load_perceiver` takes it; `force` answers frames of other sensors, too. Raises UserError.
    """
    least = NO_MINIMUM if force else MIN_PLAUSIBILITY
    if not isinstance(experiment.paired, Recorded) and not uses_pins(experiment):
        step = make_image_step(model, experiment)
        return StreamModel(
            step,
            experiment.paired.preprocess,
            None,
            load_sensor_appearance(model, experiment),
            least,
        )
    perceive = load_perceiver(model, experiment, with_sheared_poses=False, frame=frame)
    size = perceive.preprocess.size

    def step_on(image: np.ndarray) -> StreamOutput:
        seen = perceive.read(image[None])
        values = perceive.run(seen)
        after = None if values.unsheared is None else values.unsheared[0]
        poses = values.poses.get(UNSHEARED) or next(iter(values.poses.values()), {})
        crisp = 1.0 if after is None else float(compute_confidence(after[..., None]))
        return StreamOutput(
            after,
            {name: float(value[0]) for name, value in poses.items()},
            crisp,
            bool(seen.identified[0]),
        )

    step_on(np.zeros((size, size), np.uint8))  # compiles
    return StreamModel(step_on, perceive.preprocess, perceive.view, perceive.expected, least)


def make_image_step(model: Path, experiment: Experiment) -> Step:
    """Return what a frame is perceived by, of networks over images; compiled already."""
    forward, variables, targets = load_forward(model, DISENTANGLED)
    names = list_target_names(targets)
    run = jit_for_inference(make_perceive_function(forward, names), variables)
    size = experiment.paired.preprocess.size

    def step(image: np.ndarray) -> StreamOutput:
        after, (*pose, crisp) = jax.device_get(run(image))
        return StreamOutput(after, dict(zip(names, map(float, pose), strict=True)), float(crisp))

    step(np.zeros((size, size), np.uint8))  # compiles
    return step


def make_perceive_function(
    forward: Forward, names: tuple[str, ...]
) -> Callable[[Variables, Array], tuple[Array, Array]]:
    """The function (variables, image (S, S) uint8) -> what PoseNet sees (S, S) and, as one array for one way back to the host,
    the quantities of the pose and the confidence."""

    def perceive(variables: Variables, image: Array) -> tuple[Array, Array]:
        seen, pose = forward(variables, image[None])
        return seen[0, ..., 0], jnp.stack([*(pose[name][0] for name in names), compute_confidence(seen[0])])

    return perceive


@dataclass
class _StreamStats:
    """What a stream has come to so far."""

    total_ms: list[float] = field(default_factory=list)  # of each frame that was used
    networks_ms: list[float] = field(default_factory=list)
    confident: list[float] = field(default_factory=list)
    errors: dict[str, list[float]] = field(default_factory=dict)  # by quantity
    problems: dict[str, int] = field(default_factory=dict)
    skipped: int = 0
    missed: int = 0
    last: int = -1  # number of a frame


def stream(
    frames: Iterator[SourceFrame],
    live: bool,
    robot: StreamModel,
    out: TextIO,
    images: Path | None,
    inline: bool,
    truth: LabelReader | None = None,
) -> StreamResult:
    """Writes a line for each frame to `out`. One that cannot be used, or is not understood, has no pose and no image, but a reason and a
    confidence of 0.

    `images`: a folder for unsheared images; `inline`: as base64 PNG in the lines instead. With `truth`
    the errors, too. A live source also ends by Ctrl-C, or when its camera is lost.
    """
    seen = make_steady_view(robot.preprocess)
    found = _StreamStats()
    began = time.perf_counter()
    try:
        for frame in _until_lost(frames, live, found.problems):
            came = time.perf_counter()
            found.missed += frame.number - found.last - 1
            found.last = frame.number
            line: Json = {"frame": frame.number, "name": frame.name}
            try:
                after, pose, sure, spent = _answer(robot, frame, seen)
            except UserError as error:
                found.skipped += 1
                found.problems[str(error)] = found.problems.get(str(error), 0) + 1
                _write(out, line | {"confidence": 0.0, "error": str(error)})
                continue
            line |= {name: round(value, 4) for name, value in pose.items()} | {
                "confidence": round(sure, 4)
            }
            for name, off in _errors(pose, truth(frame.number) if truth else {}).items():
                line[f"error_{name}"] = round(off, 4)
                found.errors.setdefault(name, []).append(off)
            if images is not None and after is not None:
                line["image"] = _save(images, frame, after)
            elif inline and after is not None:
                line["image_png"] = base64.b64encode(
                    encode_png(to_uint8(after), FAST_COMPRESSION)
                ).decode()
            found.networks_ms.append(1e3 * spent)
            found.total_ms.append(1e3 * (time.perf_counter() - came))
            found.confident.append(sure)
            _write(out, line | {"ms": round(found.total_ms[-1], 3)})
    except KeyboardInterrupt:  # a camera's usual end
        if not live or not found.total_ms:
            raise
    return _summary(found, live, began)


def _answer(
    robot: StreamModel, frame: SourceFrame, seen: Callable[[np.ndarray], View]
) -> tuple[np.ndarray | None, dict[str, float], float, float]:
    """Unsheared image, pose, confidence, and the seconds that the networks took. Raises UserError for a frame that cannot
    be used, or is not understood."""
    if frame.pixels is None:
        raise UserError(frame.problem)
    image = prepare_frame(
        robot.preprocess, frame.pixels, robot.view or frame.view or seen(frame.pixels)
    )
    if not image.any():
        raise UserError("nothing white is left of this frame: no pins to see")
    asked = time.perf_counter()
    found = robot.step(image)
    answered = time.perf_counter()
    likely = 1.0 if robot.expected is None else compute_plausibility(image, robot.expected)
    if why := explain_rejection(found.identified, likely, robot.min_plausibility):
        raise UserError(why)
    return found.unsheared, found.pose, found.confidence * likely, answered - asked


def _summary(found: _StreamStats, live: bool, began: float) -> StreamResult:
    used = len(found.total_ms)
    return StreamResult(
        frames=used + found.skipped + found.missed,
        used=used,
        skipped=found.skipped,
        dropped=found.missed,
        problems=found.problems,
        live=live,
        frames_per_s=used / max(time.perf_counter() - began, 1e-9),
        confidence=float(np.mean(found.confident)) if used else None,
        pose_mae={name: float(np.mean(values)) for name, values in found.errors.items()},
        latency_ms=_spread(found.total_ms),
        networks_ms=_spread(found.networks_ms),
    )


def _errors(pose: dict[str, float], true: Mapping[str, float]) -> dict[str, float]:
    """Absolute errors of what has a label."""
    known = {name: np.array([true[name]]) for name in pose if np.isfinite(true.get(name, np.nan))}
    found = compute_pose_errors({name: np.array([pose[name]]) for name in known}, known)
    return {name: float(error[0]) for name, error in found.items()}


def make_steady_view(preprocess: Preprocess) -> Callable[[np.ndarray], View]:
    """A function of a camera's frames, one by one -> the view that the first PROBES usable ones of their size have had in common so
    far."""
    views: dict[tuple[int, ...], list[View]] = {}
    common: dict[tuple[int, ...], View] = {}

    def update_view(raw: np.ndarray) -> View:
        known = views.setdefault(raw.shape, [])
        if len(known) < PROBES:
            known.append(find_view(preprocess, raw))
            common[raw.shape] = combine_views(known)
        return common[raw.shape]

    return update_view


def _until_lost(
    frames: Iterator[SourceFrame], live: bool, problems: dict[str, int]
) -> Iterator[SourceFrame]:
    """The frames of a live source until it is lost, which ends them as a problem; of another source that is an error."""
    try:
        yield from frames
    except UserError as error:
        if not live:
            raise
        problems[str(error)] = 1


def _spread(values: list[float]) -> dict[str, float] | None:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 95, 99)} if values else None


def _write(out: TextIO, line: Json) -> None:
    out.write(json.dumps(line) + "\n")
    out.flush()


def _save(folder: Path, frame: SourceFrame, image: np.ndarray) -> str:
    path = folder / f"{frame.number:06d}.png"
    write_bytes(path, encode_png(to_uint8(image), FAST_COMPRESSION))
    return str(path)
