"""Evaluate networks that learned from recordings, on these recordings and on others.

>>> evaluate_recordings(experiment, Path("runs/recorded"), data)  # on their held-out part
>>> results = score_recordings(experiment, run_dir, Path("other_day"), data, command)
>>> results.pose_mae["unsheared"]["y_mm"]

Taps and slides of a test need not have the same poses. PoseNet is scored on taps, and on slides
sheared and unsheared. Similarity is that of an unsheared slide to its partner, which is a recorded
tap or rendered.
"""

import dataclasses
import shutil
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import POSENET, POSENETS
from jaxunshear.config.targets import Targets, list_label_fields, locate_targets
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_contacts import compute_digest
from jaxunshear.data.recorded_set import RecordedSet, read_other_recordings
from jaxunshear.data.recorded_source import RecordedSource, read_pin_layout
from jaxunshear.data.sensor_frame import parse_frame
from jaxunshear.errors import UserError
from jaxunshear.evaluation.contact_scores import BATCH, ContactScores, Scorer, TestSet, score_test
from jaxunshear.evaluation.evaluate import EvaluatedRun
from jaxunshear.evaluation.intervals import compute_coverage, compute_half_widths
from jaxunshear.evaluation.network_outputs import load_run
from jaxunshear.evaluation.pose_estimators import PIXELS, fit_estimators
from jaxunshear.evaluation.recorded_results import (
    RecordedScores,
    RecordedTest,
    build_recorded_results,
)
from jaxunshear.evaluation.result_tables import finish_results
from jaxunshear.evaluation.score import TARGET_KIND
from jaxunshear.files import read_object
from jaxunshear.inference.readers import add_no_contact, judge_batch, make_touch_reader
from jaxunshear.models.modality import PINS, Modality, get_modality
from jaxunshear.perception.sensor_check import measure_sensor_appearance
from jaxunshear.perception.touch import find_no_contact, measure_touch
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, FullTable, Results
from jaxunshear.training.checkpoint import check_training, read_targets
from jaxunshear.training.examples import FRAME, HelperLoader
from jaxunshear.training.provenance import check_unseen

KEPT_SLIDES = 72  # slides whose pins are detected, and from which the montage is chosen
TAP_LABELS = ("pose", "pose_id", "stimulus", "sure")
SLIDE_LABELS = (*TAP_LABELS, "move")


def evaluate_recordings(experiment: Experiment, run_dir: Path, data_dir: Path) -> EvaluatedRun:
    """Score networks on the test split of a recorded set, with conformal intervals.

    Raises `UserError` if nothing can be scored, or a network or the data set is missing or damaged.
    """
    stored = RecordedSource(experiment).open_stored(data_dir)
    targets = stored.make_targets(experiment.targets)
    test = _choose_test(experiment, stored, targets, run_dir, data_dir)
    scorer = _load_scorer(experiment, run_dir, stored, targets)
    estimators = {}
    if stored.count_contacts("taps", "train"):
        # the pins in unsheared images of recordings have no identities
        estimators = fit_estimators(experiment, data_dir, run_dir, (PIXELS,))
    modality = get_modality(experiment)
    scores = _score_contacts(scorer._replace(estimators=estimators), modality, test)
    results = build_recorded_results(experiment, stored, targets, scores, test)
    validation = _score_contacts(scorer, modality, test, "validation")
    half_widths = compute_half_widths(validation.list_pose_errors())
    taps = {name: estimator.taps for name, estimator in estimators.items()}
    results = dataclasses.replace(
        results,
        half_width=half_widths,
        coverage=compute_coverage(half_widths, scores.list_pose_errors()),
        counts=dataclasses.replace(results.counts, reader_taps=taps),
    )
    if scores.slides is None:
        return EvaluatedRun(results, scores.taps, {}, ())
    further = {} if scores.taps is None else {"taps": scores.taps}
    montage_names = ("recorded",) if test.paired else ()
    return EvaluatedRun(results, convert_montage_labels(scores.slides), further, montage_names)


def convert_montage_labels(slides: ContactScores) -> ContactScores:
    """Convert labels to those of a montage: depth in the fourth column, slides along x and y."""
    pose, move = slides.labels["pose"][:, [0, 1, 5, 2]], slides.labels["move"][:, :2]
    return slides._replace(labels=slides.labels | {"pose": pose, "move": move})


def score_recordings(
    experiment: Experiment, run_dir: Path, recordings: Path, data_dir: Path, command: str
) -> Results:
    """Score a run on other recordings of its sensor: other days, other poses.

    All contacts are scored, and nothing is fitted to them. Pins are identified by their rest
    positions in the training taps. Raises UserError if the run is about simulated touches, has
    learned from these recordings, or nothing can be read or scored.
    """
    settings = experiment.paired
    if not isinstance(settings, Recorded):
        raise UserError(
            f"{run_dir} learnt from simulated touches: score it with `jaxunshear evaluate`"
        )
    started = time.perf_counter()
    for network in experiment.networks:
        check_training(run_dir / network)
    digest = _check_not_learned_from(experiment, settings, run_dir, recordings)
    settings = dataclasses.replace(
        settings, tap_folder=str(recordings), slide_folder=str(recordings), digest=digest, pairs=""
    )
    folder = Path(data_dir) / ".partial" / f"unseen-{digest}"
    # crop and rest positions of the run's own sensor
    stored_frame = read_object(run_dir / FRAME)
    frame = parse_frame(stored_frame)
    stored = read_other_recordings(settings, stored_frame, folder, experiment.targets)
    targets = locate_targets(read_targets(run_dir / experiment.networks[-1]), stored.columns)
    unseen = dataclasses.replace(experiment, paired=settings)
    appearance = measure_sensor_appearance(frame.rest, frame.size)
    touch = make_touch_reader(frame, experiment.sensor)
    test = _choose_test(unseen, stored, targets, run_dir)
    test = test._replace(appearance=appearance, touch=touch)
    scorer = _load_scorer(unseen, run_dir, stored, targets)
    scores = _score_contacts(scorer, get_modality(unseen), test)
    results = build_recorded_results(unseen, stored, targets, scores, test)
    half_widths: FullTable = {}
    if (run_dir / "results.json").exists():
        run_results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
        half_widths = run_results.half_width or {}
    shutil.rmtree(folder, ignore_errors=True)
    results = dataclasses.replace(
        results,
        half_width=half_widths,
        coverage=compute_coverage(half_widths, scores.list_pose_errors()),
        trained_in=run_dir.name,
        time_s={"evaluate": time.perf_counter() - started},
    )
    return finish_results(results, experiment, run_dir, command)


def _check_not_learned_from(
    experiment: Experiment, settings: Recorded, run_dir: Path, recordings: Path
) -> str:
    """Return the digest of recordings. Raises UserError if the run learned from them."""
    digest, here = compute_digest((str(recordings),)), Path(recordings).resolve()
    names = (settings.tap_folder, settings.slide_folder)
    folders = [Path(name).resolve() for name in names if name and Path(name).is_dir()]
    overlap = any(here.is_relative_to(each) or each.is_relative_to(here) for each in folders)
    if digest == settings.digest or overlap:
        raise UserError(
            f"{recordings} shares its files with what {run_dir} learnt from: name recordings that "
            f"it has not seen; its held-out tenth is scored by `jaxunshear evaluate {run_dir}`"
        )
    for network in experiment.networks:
        check_unseen(run_dir / network, [digest])
    return digest


def _choose_test(
    experiment: Experiment,
    stored: RecordedSet,
    targets: Targets,
    run_dir: Path,
    data_dir: Path | None = None,
) -> RecordedTest:
    """Choose the contacts to score: the test split of the recordings that the run learned from.

    Without `data_dir` these are other recordings: slides have no partners, and no similarity.
    """
    unshears = any(name not in POSENETS for name in experiment.networks)
    slides = taps = None
    if stored.count_contacts("slides", "test"):
        if data_dir and unshears:
            helpers = HelperLoader(experiment, data_dir, run_dir)
            images = get_modality(experiment) is not PINS
            slides = RecordedSource(experiment).open_pairs(stored, targets, helpers, images)
        else:
            slides = stored.read_slides()
    if stored.count_contacts("taps", "test") and POSENET in experiment.networks:
        taps = stored.read_taps()
    paired = slides is not None and data_dir is not None and unshears
    return RecordedTest(slides, taps, paired, "same session" if data_dir else "other recordings")


def _load_scorer(
    experiment: Experiment, run_dir: Path, stored: RecordedSet, targets: Targets
) -> Scorer:
    pins = read_pin_layout(stored.frame)
    return Scorer(load_run(run_dir, experiment.networks, get_modality(experiment), pins), targets)


def _score_contacts(
    scorer: Scorer, modality: Modality, test: RecordedTest, split: str = "test"
) -> RecordedScores:
    """Score the slides and the taps of a split.

    Networks over pins are scored on contacts whose pins were identified, networks over images, on
    other recordings, on contacts that show the model's sensor. Images of other recordings that show
    no contact are left out, too. Raises UserError if no slide and no tap is left that has a label.
    """
    slides = taps = None
    if test.slides is not None:
        rows = _select_understood(modality, test, test.slides, split, test.paired)
        slides = _score_rows(scorer, modality, test.slides, split, rows, test.paired)
    if slides is not None:
        slides = slides._replace(scores=_select_slide_scores(slides.scores, test.paired))
    if test.taps is not None:
        rows = _select_understood(modality, test, test.taps, split, None)
        taps = _score_rows(scorer, modality, test.taps, split, rows)
    if taps is not None:
        prefixes = ("pose/tap/", *(f"read/{name}/tap/" for name in scorer.estimators))
        chosen = {name: score for name, score in taps.scores.items() if name.startswith(prefixes)}
        taps = taps._replace(scores=chosen)
    if slides is None and taps is None:
        needed = "pins that are identified"
        if not modality.needs_identified_pins:
            needed = "the pins of the model's sensor"
        raise UserError(f"nothing can be scored: no {split} slide or tap has a label and {needed}")
    return RecordedScores(slides, taps)


def _name_sources(modality: Modality, paired: bool | None) -> dict[str, str]:
    """Name the field of a reader by the field of a pair that it stands for.

    `paired` says whether slides have partners, and is None for taps. A slide without partner, and a
    tap, stand for both contacts of a pair.
    """
    sources: dict[str, str] = {}
    for each in (modality, PINS):
        alone = each.single if paired is None else each.sheared
        sources |= {each.canonical: each.canonical if paired else alone, each.sheared: alone}
    return sources


def _select_understood(
    modality: Modality, test: RecordedTest, reader: Reader, split: str, paired: bool | None
) -> np.ndarray:
    """Select the rows of a split that `unshear` would answer; `paired` as in `_name_sources`."""
    sources, rows = _name_sources(modality, paired), np.arange(reader.length(split))
    if modality.needs_identified_pins:
        fields = tuple(dict.fromkeys(sources[name] for name in PINS.pair))
        stored = reader.take(split, rows, fields)
        identified = [np.isfinite(pins).any(axis=(1, 2)) for pins in stored.values()]
        understood = np.all(identified, axis=0)
        if test.touch is not None:
            touch = measure_touch(test.touch.gauge, stored[sources[PINS.sheared]])
            understood = understood & ~find_no_contact(touch)
        return rows[understood]
    if test.appearance is None or test.touch is None or not len(rows):
        return rows
    field, accepted = sources[modality.sheared], []
    for start in range(0, len(rows), BATCH):
        images = reader.take(split, rows[start : start + BATCH], (field,))[field][..., 0]
        judged = judge_batch(images, np.ones(len(images), bool), test.appearance, force=False)
        touch, _ = test.touch.measure_some(images, None, judged, force=False)
        accepted.append(add_no_contact(judged.rejection, touch, force=False) == "")
    return rows[np.concatenate(accepted)]


def _score_rows(
    scorer: Scorer,
    modality: Modality,
    reader: Reader,
    split: str,
    rows: np.ndarray,
    paired: bool | None = None,
) -> ContactScores | None:
    """Score rows of a split; None if there are none. `paired` as in `_name_sources`."""
    sources = _name_sources(modality, paired)
    if not len(rows):
        return None
    labels = TAP_LABELS if paired is None else SLIDE_LABELS
    labels = tuple(dict.fromkeys((*labels, *list_label_fields(scorer.targets))))

    def read_batch(start: int) -> Batch:
        fields = (*dict.fromkeys(sources.values()), *labels)
        batch = reader.take(split, rows[start : start + BATCH], fields)
        return batch | {name: batch[source] for name, source in sources.items()}

    batches = map(read_batch, range(0, len(rows), BATCH))
    keep, title = KEPT_SLIDES, "evaluate"
    if paired is None:
        keep, title = 0, f"evaluate taps ({modality.single})"
    return score_test(scorer, TestSet(batches, len(rows), modality.pair, labels, keep, title))


def _select_slide_scores(scores: Mapping[str, np.ndarray], paired: bool) -> dict[str, np.ndarray]:
    """Name the tap of a pair TARGET_KIND; of slides without partners select the poses alone."""
    selected = {}
    for name, score in scores.items():
        if not paired and ("/tap/" in name or not name.startswith(("pose/", "read/"))):
            continue
        selected[name.replace("/tap/", f"/{TARGET_KIND}/")] = score
    return selected
