"""Score networks that learned from recordings on recorded contacts.

Taps and slides of a test need not have the same poses. PoseNet is scored on taps, and on slides
sheared and unsheared. Similarity is that of an unsheared slide to its partner, which is a recorded
tap or rendered.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import POSENET, POSENETS
from jaxunshear.config.targets import Targets
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.data.recorded_source import read_pin_layout
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.evaluation.contact_scores import (
    BATCH,
    ContactScores,
    Scorer,
    TestSet,
    score_test,
)
from jaxunshear.evaluation.network_outputs import load_run
from jaxunshear.evaluation.score import TARGET_KIND, choose_main_kind
from jaxunshear.models.modality import IMAGES, PINS, Modality, get_modality
from jaxunshear.results.run import TestData
from jaxunshear.training.examples import HelperLoader

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

    slides: ContactScores | None
    taps: ContactScores | None

    def get_main(self) -> ContactScores:
        """Return the slides; of a test without slides the taps, without their scores."""
        if self.slides is not None:
            return self.slides
        assert self.taps is not None
        return self.taps._replace(scores={})

    def list_pose_errors(self) -> dict[str, np.ndarray]:
        """List pose errors (N,) by `pose/<kind>/<target>`; the main network's are UNSHEARED."""
        slide_scores = {} if self.slides is None else self.slides.scores
        main_kind = choose_main_kind(
            {name.split("/")[1] for name in slide_scores if name.startswith("pose/")}
        )
        errors = {} if self.taps is None else dict(self.taps.scores)
        for name, score in slide_scores.items():
            if main_kind != "sheared":
                name = name.replace(f"pose/{main_kind}/", f"pose/{UNSHEARED}/")
            errors[name] = score
        return errors


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
    paired = data_dir is not None and unshears and stored.count_contacts("slides", "test") > 0
    if paired:
        assert data_dir is not None
        inputs = HelperLoader(experiment, data_dir, run_dir)
        images = get_modality(experiment) is IMAGES
        slides = open_source(experiment).open_pairs(stored, targets, inputs, images)
    elif stored.count_contacts("slides", "test"):
        slides = stored.read_slides()
    if stored.count_contacts("taps", "test") and POSENET in experiment.networks:
        taps = stored.read_taps()
    return RecordedTest(slides, taps, paired, "same session" if data_dir else "other recordings")


def load_scorer(
    experiment: Experiment, run_dir: Path, stored: RecordedSet, targets: Targets
) -> Scorer:
    """Load a run's networks for contacts of a recorded set. Raises UserError if one is missing."""
    pins = read_pin_layout(stored.frame)
    return Scorer(load_run(run_dir, experiment.networks, get_modality(experiment), pins), targets)


def score_contacts(
    scorer: Scorer, modality: Modality, test: RecordedTest, split: str = "test"
) -> RecordedScores:
    """Score the slides and the taps of a split.

    Networks over pins are scored on those contacts alone whose pins were identified.
    Raises UserError if no slide and no tap is labelled, or identified.
    """
    slides = taps = None
    if test.slides is not None:
        # a slide without partner stands in for its tap
        stand_ins = {} if test.paired else {each.canonical: each.sheared for each in (IMAGES, PINS)}
        slides = _score_split(scorer, modality, test.slides, split, stand_ins)
    if slides is not None:
        slides = slides._replace(scores=_select_slide_scores(slides.scores, test.paired))
    if test.taps is not None:
        stand_ins = {field: each.single for each in (IMAGES, PINS) for field in each.pair}
        taps = _score_split(scorer, modality, test.taps, split, stand_ins)
    if taps is not None:
        prefixes = ("pose/tap/", *(f"read/{name}/tap/" for name in scorer.estimators))
        chosen = {name: score for name, score in taps.scores.items() if name.startswith(prefixes)}
        taps = taps._replace(scores=chosen)
    if slides is None and taps is None:
        requirement = " and pins that are identified" if modality.needs_identified_pins else ""
        raise UserError(f"nothing can be scored: no {split} slide or tap has a label{requirement}")
    return RecordedScores(slides, taps)


def _score_split(
    scorer: Scorer, modality: Modality, reader: Reader, split: str, stand_ins: Mapping[str, str]
) -> ContactScores | None:
    """Score the rows of a split that networks can be given; None if there are none.

    `stand_ins` are fields of the reader, by the fields of pairs in whose place they are given.
    """
    sources = {name: stand_ins.get(name, name) for name in (*IMAGES.pair, *PINS.pair)}
    if not stand_ins and modality is PINS:  # partners may be pins alone
        sources = {name: name for name in PINS.pair}
    rows = np.arange(reader.length(split))
    if modality.needs_identified_pins:
        fields = {sources[name] for name in PINS.pair}
        pins = reader.take(split, rows, tuple(fields))
        identified = [np.isfinite(pins[name]).any(axis=(1, 2)) for name in fields]
        rows = rows[np.all(identified, axis=0)]
    if not len(rows):
        return None
    is_tap = IMAGES.single in stand_ins.values()
    labels = TAP_LABELS if is_tap else LABELS
    batches = _iterate_batches(reader, split, rows, sources, labels)
    keep, title = (0, f"evaluate taps ({modality.single})") if is_tap else (KEPT_SLIDES, "evaluate")
    return score_test(scorer, TestSet(batches, len(rows), modality.pair, labels, keep, title))


def _iterate_batches(
    reader: Reader,
    split: str,
    rows: np.ndarray,
    sources: Mapping[str, str],
    labels: Sequence[str],
) -> Iterator[Batch]:
    fields = (*dict.fromkeys(sources.values()), *labels)
    for start in range(0, len(rows), BATCH):
        batch = reader.take(split, rows[start : start + BATCH], fields)
        yield batch | {name: batch[source] for name, source in sources.items()}


def _select_slide_scores(scores: Mapping[str, np.ndarray], paired: bool) -> dict[str, np.ndarray]:
    """Name the tap of a pair TARGET_KIND; of slides without partners select the poses alone."""
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


def convert_montage_labels(slides: ContactScores) -> ContactScores:
    """Convert labels to those of a montage: depth in the fourth column, slides along x and y."""
    pose, move = slides.labels["pose"][:, [0, 1, 5, 2]], slides.labels["move"][:, :2]
    return slides._replace(labels=slides.labels | {"pose": pose, "move": move})
