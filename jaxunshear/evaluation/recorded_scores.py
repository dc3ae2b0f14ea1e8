"""Score networks that learned from recordings on recorded contacts.

Taps and slides of a test need not have the same poses. PoseNet is scored on taps, and on slides
sheared and unsheared. Similarity is that of an unsheared slide to its partner, which is a recorded
tap or rendered.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.registry import POSENET, POSENETS
from jaxunshear.config.targets import Targets
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.errors import UserError
from jaxunshear.evaluation.network_outputs import Run, load_run
from jaxunshear.evaluation.pose_estimators import BatchEstimator
from jaxunshear.evaluation.score import TARGET_KIND, choose_main_kind
from jaxunshear.evaluation.score_collection import (
    BATCH,
    CollectedScores,
    Scorer,
    collect_scores,
)
from jaxunshear.models.modality import IMAGES, PINS, Modality, get_modality
from jaxunshear.results.run import TestData
from jaxunshear.training.examples import open_pairs, read_pin_layout

KEPT_SLIDES = 72  # slides whose pins are detected, and from which the montage is chosen
LABELS = ("pose", "move", "pose_id", "stimulus", "number", "sure")
TAP_LABELS = tuple(name for name in LABELS if name != "move")
UNSHEARED = "unsheared"  # the network that stands for a run, whichever it is


class RecordedTest(NamedTuple):
    """The recorded contacts of a test: slides, with partners if `paired`, and taps."""

    slides: Reader | None
    taps: Reader | None
    paired: bool
    data: TestData


class RecordedScores(NamedTuple):
    """Scores of the slides and of the taps of a recorded test; None if there are none."""

    slides: CollectedScores | None
    taps: CollectedScores | None


def choose_test(
    experiment: Experiment,
    stored: RecordedSet,
    targets: Targets,
    run_dir: Path,
    data_dir: Path | None = None,
) -> RecordedTest:
    """Choose the contacts to score: the test split of the recordings that the run learnt from.

    Without `data_dir` these are other recordings: slides have no partners, and no similarity.
    """
    unshears = any(name not in POSENETS for name in experiment.networks)
    slides = taps = None
    paired = False
    if stored.count_contacts("slides", "test"):
        if data_dir is not None and unshears:
            slides = open_pairs(experiment, stored, targets, run_dir, data_dir)
            paired = True
        else:
            slides = stored.read_slides()
    if stored.count_contacts("taps", "test") and POSENET in experiment.networks:
        taps = stored.read_taps()
    return RecordedTest(slides, taps, paired, "same session" if data_dir else "other recordings")


def load_recorded_run(experiment: Experiment, run_dir: Path, stored: RecordedSet) -> Run:
    """Load a run's networks for contacts of a recorded set. Raises UserError if one is missing."""
    pins = read_pin_layout(stored.frame) if uses_pins(experiment) else None
    return load_run(run_dir, experiment.networks, None, pins)


def collect_recorded_scores(
    experiment: Experiment,
    run: Run,
    test: RecordedTest,
    targets: Targets,
    estimators: Mapping[str, BatchEstimator] = MappingProxyType({}),
    split: str = "test",
) -> RecordedScores:
    """Score the slides and the taps of a split by the networks `run` and by `estimators`.

    Networks over pins are scored on those contacts alone whose pins were identified.
    Raises UserError if no slide and no tap is labelled, or identified.
    """
    modality = get_modality(experiment)
    scorer = Scorer(run, targets, modality.pair, LABELS, estimators)
    scores = RecordedScores(
        _score_slides(scorer, modality, test, split), _score_taps(scorer, modality, test, split)
    )
    if scores.slides is None and scores.taps is None:
        requirement = " and pins that are identified" if modality.needs_identified_pins else ""
        raise UserError(f"nothing can be scored: no {split} slide or tap has a label{requirement}")
    return scores


def _score_slides(
    scorer: Scorer, modality: Modality, test: RecordedTest, split: str
) -> CollectedScores | None:
    if test.slides is None:
        return None
    pin_fields = PINS.pair if test.paired else (PINS.sheared,)
    rows = _select_usable(modality, test.slides, split, pin_fields)
    if not len(rows):
        return None
    if test.paired:
        fields = (*scorer.inputs, *PINS.pair, *LABELS)
        batches = _iterate_batches(test.slides, split, rows, fields)
    else:
        fields = (IMAGES.sheared, PINS.sheared, *LABELS)
        batches = _add_empty_taps(_iterate_batches(test.slides, split, rows, fields))
    scores = collect_scores(scorer, batches, len(rows), KEPT_SLIDES)
    return scores._replace(scores=_select_slide_scores(scores.scores, test.paired))


def _score_taps(
    scorer: Scorer, modality: Modality, test: RecordedTest, split: str
) -> CollectedScores | None:
    if test.taps is None:
        return None
    rows = _select_usable(modality, test.taps, split, (PINS.single,))
    if not len(rows):
        return None
    fields = (IMAGES.single, PINS.single, *TAP_LABELS)
    batches = _make_tap_pairs(_iterate_batches(test.taps, split, rows, fields))
    title = f"evaluate taps ({modality.single})"
    scores = collect_scores(scorer._replace(labels=TAP_LABELS), batches, len(rows), title=title)
    prefixes = ("pose/tap/", *(f"read/{name}/tap/" for name in scorer.estimators))
    selected = {name: score for name, score in scores.scores.items() if name.startswith(prefixes)}
    return scores._replace(scores=selected)


def _select_usable(
    modality: Modality, reader: Reader, split: str, pin_fields: Sequence[str]
) -> np.ndarray:
    """Select the rows of a split that networks can be given.

    Networks over pins can be given contacts whose pins were identified in all `pin_fields`.
    """
    rows = np.arange(reader.length(split))
    if not modality.needs_identified_pins:
        return rows
    pins = reader.take(split, rows, pin_fields)
    identified = [np.isfinite(pins[name]).any(axis=(1, 2)) for name in pin_fields]
    return rows[np.all(identified, axis=0)]


def _iterate_batches(
    reader: Reader, split: str, rows: np.ndarray, fields: Sequence[str]
) -> Iterator[Batch]:
    for start in range(0, len(rows), BATCH):
        yield reader.take(split, rows[start : start + BATCH], fields)


def _add_empty_taps(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Make pairs of slides without partners: each slide stands in for its tap."""
    for batch in batches:
        yield batch | {each.canonical: batch[each.sheared] for each in (IMAGES, PINS)}


def _make_tap_pairs(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Make pairs of taps: each tap stands in for its slide."""
    for batch in batches:
        for each in (IMAGES, PINS):
            batch = batch | dict.fromkeys(each.pair, batch[each.single])
        yield batch


def _select_slide_scores(scores: dict[str, np.ndarray], paired: bool) -> dict[str, np.ndarray]:
    """Select the scores of slides, and rename those of the kind "tap" to TARGET_KIND.

    That kind is the partner of a slide, not a recorded tap. Slides without partners have pose
    errors alone.
    """
    selected = {}
    for name, score in scores.items():
        table, kind, *rest = name.split("/")
        if table == "read":
            table, kind, *rest = f"{table}/{kind}", *rest
        elif not paired and table != "pose":
            continue
        if kind != "tap":
            selected[name] = score
        elif paired:
            selected["/".join([table, TARGET_KIND, *rest])] = score
    return selected


def list_pose_errors(scores: RecordedScores) -> dict[str, np.ndarray]:
    """List pose errors (N,) by `pose/<kind>/<target>`, with the main network's as `UNSHEARED`."""
    slide_scores = {} if scores.slides is None else scores.slides.scores
    kinds = {name.split("/")[1] for name in slide_scores if name.startswith("pose/")}
    main_kind = choose_main_kind(kinds)
    errors = {} if scores.taps is None else dict(scores.taps.scores)
    for name, score in slide_scores.items():
        if main_kind != "sheared":
            name = name.replace(f"pose/{main_kind}/", f"pose/{UNSHEARED}/")
        errors[name] = score
    return errors


def convert_montage_labels(slides: CollectedScores) -> CollectedScores:
    """Convert labels to those of a montage: depth in the fourth column, slides along x and y."""
    labels = slides.labels
    pose = labels["pose"][:, [0, 1, 5, 2]]
    return slides._replace(labels=labels | {"pose": pose, "move": labels["move"][:, :2]})
