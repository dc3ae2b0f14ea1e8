"""Which data sets a network learnt from: they stand in its model.json. Imports no JAX.

`origin` is its own set; `taken_over` are those of all that it got from others: of weights that it began from, of a teacher, a renderer, a
reader of poses, and of whatever these took over.
"""

from collections.abc import Iterable
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.settings.configs import PAIRED_SET, POSE_SET, RECORDED_SET, RECORDED_VERSION, describe, differences
from jaxunshear.settings.data import PoseData, Recorded
from jaxunshear.settings.experiment import Experiment, learnt_from, needed, training_of
from jaxunshear.settings.registry import OF_TAPS, POSENETS
from jaxunshear.storage import Json, read_object, read_object_if_sound
from jaxunshear.training.kept_out import Exam, exams_of, known

TRAININGS = ("train", "train_posenet", "train_teacher", "train_pins")


def origin_of(experiment: Experiment, network: str) -> Json:
    """The description of the data set that `network` is to learn from, and of what is made of it."""
    settings = learnt_from(experiment, network)
    described = describe(settings, experiment.sensor)
    if isinstance(settings, Recorded) and network not in OF_TAPS:
        described |= {"labelled": settings.labelled}
        if network not in POSENETS or settings.pairing == "simulated":
            described |= {"pairing": settings.pairing}
        if network not in POSENETS:
            described |= {"unlabelled": settings.unlabelled} if settings.unlabelled != "left_out" else {}
        elif settings.direct_taps != "none":
            described |= {"direct_taps": settings.direct_taps}
    return described


def taken_over(experiment: Experiment, network: str, run_dir: Path, begin: Path | None) -> list[Json]:
    """The origins, beside its own, that `network` is to learn from taps without slides, and through networks of `run_dir` and the weights
    in `begin`."""
    helpers = [run_dir / name for name in needed(experiment, network) if name != network]
    folders = [*helpers, begin] if begin else helpers
    kept = [_split_rule(origin_of(experiment, network))]
    if isinstance(experiment.pose, PoseData) and training_of(experiment, network).tap_weight:
        kept.append(_split_rule(describe(experiment.pose, experiment.sensor)))
    for origin in (_split_rule(origin) for folder in folders for origin in origins_of(folder)):
        kept += [origin] if origin not in kept else []
    return kept[1:]


def _split_rule(origin: Json) -> Json:
    """What of an origin decides which contacts were learnt."""
    return {name: origin[name] for name in ("set", "version", "settings")}


def origins_of(folder: Path) -> list[Json]:
    """Of all that the weights in `folder` have learnt from, their own set first. Raises UserError where they do not say."""
    model = read_object(folder / "model.json")
    if model.get("origin") and "taken_over" in model:
        return [model["origin"], *model["taken_over"]]
    return _earlier_origins(folder, model)


def _earlier_origins(folder: Path, model: Json) -> list[Json]:
    """Of weights that do not list what they took over: at most both sets of their experiment, unless they began from others."""
    experiment = read_object_if_sound(folder.parent / "experiment.json") or {}
    own = model.get("origin")
    started = "start" in model if own else any(experiment.get(name, {}).get("start") for name in TRAININGS)
    if started:
        raise UserError(f"{folder} began from weights whose data it does not name: use weights that were trained anew")
    version = (own or {}).get("version", "before 3.0.0")
    origins = [own] if own else []
    for name, kind in (("paired", PAIRED_SET), ("pose", POSE_SET)):
        settings = experiment.get(name, {})
        if "digest" in settings or "poses" in settings:
            recorded = "digest" in settings
            set_ = RECORDED_SET if recorded else kind
            made = RECORDED_VERSION if recorded else version
            origins.append({"set": set_, "version": made, "settings": settings})
    if not origins:
        raise UserError(f"{folder} does not say what it learnt from: use weights with an experiment.json beside them")
    return origins


def check_kept_out(folder: Path, exams: Iterable[Exam]) -> None:
    """Raises UserError where the weights in `folder` may know contacts of `exams`."""
    origins = origins_of(folder)
    for exam in exams:
        for origin in origins:
            if reason := known(origin, exam):
                raise UserError(f"{folder} {reason}")


def check_origin(experiment: Experiment, network: str, run_dir: Path) -> None:
    """Raises UserError where the trained `network` in `run_dir` learnt from another data set, such as one of an earlier version of the
    data, or took over what may know its tests, or where its model.json cannot be read."""
    folder = Path(run_dir) / network
    stored = read_object(folder / "model.json").get("origin") or {}
    changed = differences(stored, origin_of(experiment, network))
    if changed:
        raise UserError(
            f"{folder} learnt from a data set with another {', '.join(changed[:3])}: give another --out, or delete that folder"
        )
    check_kept_out(folder, exams_of(experiment))
