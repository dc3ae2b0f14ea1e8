"""What results say of recordings: which they are, how slides are paired, and what is scored."""

import numpy as np

from jaxunshear.config.data import SPLIT_TEXTS
from jaxunshear.config.experiment import Experiment, get_recorded
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import Targets
from jaxunshear.data.reader import Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.evaluation.score_collection import CollectedScores
from jaxunshear.results.run import Counts, Pairing, Recordings, Results, Scores


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
        **{
            name: counts[name]
            for name in ("contacts", "dropped", "unsure", "taps", "slides", "dropped_frames")
        },
        labelled=settings.labelled,
        notes=stored.metadata["notes"][:20],
    )


def describe_pairing(experiment: Experiment, slides: Reader | None, targets: Targets) -> Pairing:
    """How slides are paired, and how far the partners' poses are off."""
    recorded = get_recorded(experiment)
    if recorded is None or slides is None:
        return Pairing("none", {})
    shown: dict[str, dict[str, Scores | int]] = {}
    for split in ("train", "test"):
        count = slides.length(split)
        if not count:
            continue
        gap = slides.take(split, np.arange(count), ("gap",))["gap"]
        shown[split] = {"pairs": count}
        for target in targets:
            median, p95 = np.quantile(gap[:, target.column], (0.5, 0.95)).tolist()
            shown[split][target.name] = {"median": median, "p95": p95}
    return Pairing(recorded.pairing, shown)


ScoredContacts = tuple[
    Reader | None, CollectedScores | None
]  # contacts of the test, and what was scored of them


def describe_test(results: Results) -> str:
    """Name the recorded contacts that a run is tested on.

    Runs of earlier versions do not say: they were tested on a random split of their own session.
    """
    if results.test_data == "other recordings":
        return results.test_data
    return f"same session, {SPLIT_TEXTS[results.settings['paired'].get('split', 'random')]}"


def count_test_contacts(
    stored: RecordedSet, slides: ScoredContacts, taps: ScoredContacts
) -> Counts:
    """How many contacts there are by split, and how many of the test were scored, or left out."""
    written = stored.metadata["counts"]["written"]
    all_slides, all_taps = (
        0 if reader is None else reader.length("test") for reader, _ in (slides, taps)
    )
    test_poses, test_taps = (
        0 if found is None else len(found.labels["number"]) for _, found in (slides, taps)
    )
    return Counts(
        **{split: written[split] for split in SPLITS},
        test_poses=test_poses,
        test_taps=test_taps,
        test_unsure=all_slides - test_poses,
        unread_taps=all_taps - test_taps,
        pin_images=0 if slides[1] is None else len(slides[1].kept_rows),
    )
