"""Describe the recordings of a run: which they are, how slides are paired, what is scored."""

from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import SPLIT_TEXTS, Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import Targets
from jaxunshear.data.reader import Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.evaluation.score_collection import CollectedScores
from jaxunshear.results.run import Counts, Pairing, Recordings, Results, Scores

RECORDED_COUNTS = ("contacts", "dropped", "unsure", "taps", "slides", "dropped_frames")


class ScoredContacts(NamedTuple):
    """Contacts of a test, and the scores of those that could be scored; None if there are none."""

    reader: Reader | None
    scores: CollectedScores | None

    def count_tested(self) -> int:
        return 0 if self.reader is None else self.reader.length("test")

    def count_scored(self) -> int:
        return 0 if self.scores is None else len(self.scores.labels["number"])


def describe_recordings(experiment: Experiment, stored: RecordedSet) -> Recordings:
    settings = stored.settings
    counts = stored.metadata["counts"]
    return Recordings(
        tap_folder=settings.tap_folder,
        slide_folder=settings.slide_folder,
        digest=settings.digest,
        sensor=experiment.sensor.name,
        pins=experiment.sensor.pins,
        pins_sure=stored.metadata["pins"]["sure"],
        **{name: counts[name] for name in RECORDED_COUNTS},
        labelled=settings.labelled,
        notes=stored.metadata["notes"][:20],
    )


def describe_pairing(experiment: Experiment, slides: Reader | None, targets: Targets) -> Pairing:
    """Describe how slides are paired, and how far the partners' poses are from theirs."""
    recorded = experiment.paired
    if not isinstance(recorded, Recorded) or slides is None:
        return Pairing("none", {})
    gaps: dict[str, dict[str, Scores | int]] = {}
    for split in ("train", "test"):
        count = slides.length(split)
        if not count:
            continue
        gap = slides.take(split, np.arange(count), ("gap",))["gap"]
        gaps[split] = {"pairs": count}
        for target in targets:
            median, p95 = np.quantile(gap[:, target.column], (0.5, 0.95)).tolist()
            gaps[split][target.name] = {"median": median, "p95": p95}
    return Pairing(recorded.pairing, gaps)


def describe_test(results: Results) -> str:
    """Name the recorded contacts that a run is tested on.

    Results of earlier versions do not say: they are of a random split of the run's own session.
    """
    if results.test_data == "other recordings":
        return results.test_data
    return f"same session, {SPLIT_TEXTS[results.settings['paired'].get('split', 'random')]}"


def count_test_contacts(
    stored: RecordedSet, slides: ScoredContacts, taps: ScoredContacts
) -> Counts:
    """Count contacts by split, and those of the test that were scored and left out."""
    written = stored.metadata["counts"]["written"]
    return Counts(
        **{split: written[split] for split in SPLITS},
        test_poses=slides.count_scored(),
        test_taps=taps.count_scored(),
        test_unsure=slides.count_tested() - slides.count_scored(),
        unread_taps=taps.count_tested() - taps.count_scored(),
        pin_images=0 if slides.scores is None else len(slides.scores.kept_rows),
    )
