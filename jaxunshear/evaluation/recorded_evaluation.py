"""The paper's tables for networks that learnt from recordings, on recorded contacts kept out of training.

Taps and slides of a test need not be of the same poses: what a PoseNet reads of taps is scored on recorded taps, what it reads of
slides, as they are and unsheared, on recorded slides. Likeness is that of an unsheared slide to its partner, real or drawn.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.registry import POSENET, POSENETS
from jaxunshear.config.targets import Targets, list_target_names, read_true_values
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.errors import UserError
from jaxunshear.evaluation.bootstrap import number_poses, resample_means
from jaxunshear.evaluation.network_outputs import Run, load_run
from jaxunshear.evaluation.paper_results import PAPER
from jaxunshear.evaluation.pin_errors import measure_pin_errors
from jaxunshear.evaluation.pose_estimators import BatchEstimator
from jaxunshear.evaluation.recorded_descriptions import (
    count_test_contacts,
    describe_pairing,
    describe_recordings,
)
from jaxunshear.evaluation.result_tables import add_estimators, build_tables, tabulate_by_size
from jaxunshear.evaluation.score import TARGET_KIND, choose_main_kind, compute_chance_errors
from jaxunshear.evaluation.score_collection import (
    BATCH,
    IMAGES,
    PINS,
    CollectedScores,
    collect_scores,
)
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.results.run import Results, Tables, TestData
from jaxunshear.training.examples import open_pairs, read_pin_layout

Row = TypeVar("Row")
KEPT_SLIDES = 72  # slides whose pins are found, and from which the montage is chosen
SEED = 0  # of the bootstrap
LABELS = ("pose", "move", "pose_id", "stimulus", "number", "sure")
UNSHEARED = "unsheared"  # the network that a run is about, under a name that does not depend on which one it is


class RecordedTest(NamedTuple):
    """What is scored: slides, with partners where there are any, and taps; either may be missing."""

    slides: Reader | None
    taps: Reader | None
    paired: bool
    data: TestData


def choose_test(
    experiment: Experiment,
    stored: RecordedSet,
    targets: Targets,
    run_dir: Path,
    data_dir: Path | None = None,
) -> RecordedTest:
    """Choose the contacts to score: the test split of the recordings that the run learnt from.

    Without `data_dir` these are other recordings: slides have no partners, and no likeness.
    """
    paired = data_dir is not None and any(name not in POSENETS for name in experiment.networks)
    slides = None
    if stored.count_contacts("slides", "test"):
        slides = (
            open_pairs(experiment, stored, targets, run_dir, data_dir)
            if paired and data_dir
            else stored.read_slides()
        )
    taps = (
        stored.read_taps()
        if stored.count_contacts("taps", "test") and POSENET in experiment.networks
        else None
    )
    data: TestData = "same session" if data_dir else "other recordings"
    return RecordedTest(slides, taps, paired and slides is not None, data)


def load_recorded_run(experiment: Experiment, run_dir: Path, stored: RecordedSet) -> Run:
    """The networks of a run, for contacts of a recorded set. Raises UserError where one is missing."""
    pins = read_pin_layout(stored.frame) if uses_pins(experiment) else None
    return load_run(run_dir, experiment.networks, None, pins)


def collect_recorded_scores(
    experiment: Experiment,
    run: Run,
    test: RecordedTest,
    targets: Targets,
    readers: Mapping[str, BatchEstimator] = MappingProxyType({}),
    split: str = "test",
) -> tuple[CollectedScores | None, CollectedScores | None]:
    """Scores of a split's slides and of its taps, by the networks `run` and by `readers`; where these read pins, of those contacts
    alone whose pins were identified.

    Raises UserError where no slide and no tap is labelled, or read."""
    pins = uses_pins(experiment)
    inputs = PINS if pins else IMAGES
    slides = taps = None
    seen = PINS if test.paired else PINS[1:]
    if test.slides is not None and len(
        rows := select_identified(test.slides, split, seen if pins else ())
    ):
        if test.paired:
            batches = _take_batches(test.slides, split, rows, (*inputs, *PINS, *LABELS))
        else:
            batches = _add_empty_taps(
                _take_batches(test.slides, split, rows, (IMAGES[1], PINS[1], *LABELS))
            )
        slides = collect_scores(
            run,
            batches,
            len(rows),
            KEPT_SLIDES,
            targets,
            inputs=inputs,
            named=LABELS,
            readers=readers,
        )
        slides = slides._replace(scores=_select_slide_scores(slides.scores, test.paired))
    if test.taps is not None and len(
        rows := select_identified(test.taps, split, ("pins",) if pins else ())
    ):
        named = tuple(name for name in LABELS if name != "move")
        batches = _as_pairs(_take_batches(test.taps, split, rows, ("image", "pins", *named)))
        title = f"evaluate taps ({'pins' if pins else 'image'})"
        taps = collect_scores(run, batches, len(rows), 0, targets, title, inputs, named, readers)
        of_taps = ("pose/tap/", *(f"read/{name}/tap/" for name in readers))
        taps = taps._replace(scores={n: s for n, s in taps.scores.items() if n.startswith(of_taps)})
    if slides is None and taps is None:
        which = " and pins that are identified" if pins else ""
        raise UserError(f"nothing can be scored: no {split} slide or tap has a label{which}")
    return slides, taps


def select_identified(reader: Reader, split: str, fields: Sequence[str]) -> np.ndarray:
    """Rows of a split whose pins were identified for sure, in all of the `fields` that hold pins; all rows without any."""
    rows = np.arange(reader.length(split))
    pins = reader.take(split, rows, fields)
    return (
        rows[np.all([np.isfinite(pins[name]).any(axis=(1, 2)) for name in fields], axis=0)]
        if fields
        else rows
    )


def _take_batches(
    reader: Reader, split: str, rows: np.ndarray, fields: Sequence[str]
) -> Iterator[Batch]:
    """The given rows of a split, in order."""
    for start in range(0, len(rows), BATCH):
        yield reader.take(split, rows[start : start + BATCH], fields)


def build_results(
    experiment: Experiment,
    stored: RecordedSet,
    targets: Targets,
    slides: CollectedScores | None,
    taps: CollectedScores | None,
    test: RecordedTest,
) -> Results:
    """All of the results that follow from the scores alone."""
    size = stored.size
    scales = count_scales(size)
    pins = uses_pins(experiment)
    found = _tables(slides, taps, targets)
    labels = slides.labels if slides is not None else taps.labels if taps is not None else {}
    return Results(
        experiment=experiment.name,
        claim=experiment.claim,
        simulated=False,
        metric={
            "ms_ssim": format_ms_ssim_name(scales),
            "image_px": size,
            "scales": scales,
            "input": experiment.unshear.input,
            "pose_mae": "mean absolute error, in the labels' own frame, of a PoseNet trained on recorded taps (sheared_learnt: on "
            "labelled slides); tap: on test taps; partner: on what a test slide is paired with; others: on test slides",
            "pose_ratio": "error over the error on sheared images",
            "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
            "difference": "disentangled less this network, slide by slide",
            "swap": "of drawn pins"
            if pins
            else f"mean squared error, SSIM and {format_ms_ssim_name(scales)} of a decoder's image",
            "pin_error": "of pins by identity, with the partner's"
            if pins
            else "matched centroids with the partner's pins",
            "half_width": "holds 95 % of the errors on validation contacts of the run's own session",
            "coverage": f"share of the errors here, on {test.data}, that half_width holds",
            "readers": "as pose_mae, of a kernel ridge on the taps that PoseNet learnt from",
        },
        **vars(found),
        pin_error=_pin_error(slides, test, pins),
        baselines={
            "pose_chance": compute_chance_errors(read_true_values(targets, labels), targets)
        },
        test_data=test.data,
        recordings=describe_recordings(experiment, stored),
        pairing=describe_pairing(experiment, test.slides if test.paired else None, targets),
        targets=targets,
        counts=count_test_contacts(stored, (test.slides, slides), (test.taps, taps)),
        paper=PAPER,
        seeds={"experiment": experiment.seed, "splits": stored.settings.seed, "bootstrap": SEED},
        settings=dataclasses.asdict(experiment),
    )


def list_pose_errors(
    slides: CollectedScores | None, taps: CollectedScores | None
) -> dict[str, np.ndarray]:
    """Errors of pose (N,) by `pose/<way>/<target>`; what the run's network unshears under `UNSHEARED`, as in its tables."""
    scores = {} if slides is None else slides.scores
    kind = choose_main_kind({name.split("/")[1] for name in scores if name.startswith("pose/")})
    scores = {
        name.replace(f"pose/{kind}/", f"pose/{UNSHEARED}/") if kind != "sheared" else name: s
        for name, s in scores.items()
    }
    return ({} if taps is None else taps.scores) | scores


def convert_montage_labels(slides: CollectedScores) -> CollectedScores:
    """The same with labels as a montage names them: depth in the fourth column of the pose, slides along x and y."""
    labels = slides.labels
    pose = labels["pose"][:, [0, 1, 5, 2]]
    return slides._replace(labels=labels | {"pose": pose, "move": labels["move"][:, :2]})


def _tables(
    slides: CollectedScores | None, taps: CollectedScores | None, targets: Targets
) -> Tables:
    """Tables and their intervals: taps and slides are drawn apart, as they are no pairs."""
    of_taps = {} if taps is None else taps.scores
    tap_means = (
        {}
        if taps is None or not of_taps
        else resample_means(of_taps, taps.labels["number"], SEED + 1)
    )
    one = slides if slides is not None else taps
    assert one is not None
    scores = {} if slides is None else slides.scores
    poses = number_poses(one.labels["stimulus"], one.labels["number"])
    found = build_tables(scores, (), one.labels["stimulus"], poses, SEED, (of_taps, tap_means))
    if slides is not None:
        depth, length = slides.labels["pose"][:, 2], np.hypot(*slides.labels["move"][:, :2].T)
        if "z_mm" in list_target_names(targets):
            by = tabulate_by_size(
                scores, depth, float(depth.min()), float(depth.max()), poses, SEED
            )
            found = dataclasses.replace(found, pose_by_depth=by)
        if np.isfinite(length).all():
            by = tabulate_by_size(scores, length, 0.0, float(length.max()), poses, SEED)
            found = dataclasses.replace(found, pose_by_slide=by)
    read = [(each.scores, each.labels["number"]) for each in (taps, slides) if each is not None]
    return _add_unsheared(add_estimators(found, read, SEED))


def _add_unsheared(found: Tables) -> Tables:
    """With what the run's network unshears once more, as UNSHEARED."""
    kind = choose_main_kind(found.pose_mae)
    if kind == "sheared":
        return found

    def add_row(table: Mapping[str, Row]) -> Mapping[str, Row]:
        return {**table, UNSHEARED: table[kind]} if kind in table else table

    spread = found.spread
    spread = dataclasses.replace(
        spread, pose_mae=add_row(spread.pose_mae), pose_recovery=add_row(spread.pose_recovery)
    )
    return dataclasses.replace(
        found,
        pose_mae=add_row(found.pose_mae),
        pose_recovery=add_row(found.pose_recovery),
        spread=spread,
    )


def _select_slide_scores(scores: dict[str, np.ndarray], paired: bool) -> dict[str, np.ndarray]:
    """Scores of slides: what is read off a partner is no reading of a tap; without partners there is no likeness."""
    kept = {}
    for name, score in scores.items():
        table, kind, *rest = name.split("/")
        if table == "read":
            table, kind, *rest = f"{table}/{kind}", *rest
        elif not paired and table != "pose":
            continue
        if kind == "tap":
            if paired:
                kept["/".join([table, TARGET_KIND, *rest])] = score
        else:
            kept[name] = score
    return kept


def _add_empty_taps(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Slides without partners, in the form of pairs."""
    for batch in batches:
        yield batch | {IMAGES[0]: batch[IMAGES[1]], PINS[0]: batch[PINS[1]]}


def _as_pairs(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Taps in the form of pairs, each its own slide."""
    for batch in batches:
        yield batch | dict.fromkeys(IMAGES, batch["image"]) | dict.fromkeys(PINS, batch["pins"])


def _pin_error(
    slides: CollectedScores | None, test: RecordedTest, over: bool
) -> dict[str, dict[str, float | None]]:
    """In px; how many mm these are no recording says."""
    if slides is None or not test.paired:
        return {}
    if over:
        means = {
            name.removeprefix("pins/"): float(np.sqrt(np.nanmean(np.square(score))))
            for name, score in slides.scores.items()
            if name.startswith("pins/")
        }
        means["true_slide"] = means.pop("sheared")
        return {kind: {"rms_px": value, "rms_mm": None} for kind, value in means.items()}
    sure = np.all([np.isfinite(slides.pins[name]).all(axis=(1, 2)) for name in PINS], axis=0)
    if not sure.any():
        return {}
    kept = {kind: images[sure] for kind, images in slides.images.items()}
    tap_pins, sheared_pins = (slides.pins[name][sure] for name in PINS)
    return measure_pin_errors(kept, tap_pins, sheared_pins, None)
