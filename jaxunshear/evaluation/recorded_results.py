"""Build the results of a recorded test from its scores alone, and format them for people."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from jaxunshear.config.data import SPLIT_TEXTS
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import Targets, list_target_names
from jaxunshear.data.reader import Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.result_tables import (
    SEED,
    build_tables,
    describe_run,
    describe_similarity,
    tabulate_by_size,
)
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.inference.readers import TouchReader
from jaxunshear.metrics.errors import measure_pin_errors
from jaxunshear.models.modality import PINS, Modality, get_modality
from jaxunshear.perception.sensor_check import SensorAppearance
from jaxunshear.results.run import Counts, Pairing, Recordings, Results, Scores, Tables, TestData
from jaxunshear.text_table import format_text_table

UNSHEARED = "unsheared"  # the network that stands for a run, whichever it is
RECORDED_COUNTS = ("contacts", "dropped", "unsure", "taps", "slides", "dropped_frames")
POSE_ROWS = ("tap", "sheared", UNSHEARED, "sheared_learnt")
METRIC_NOTES = {
    "pose_mae": "mean absolute error, in the labels' own frame, of a PoseNet trained on recorded "
    "taps (sheared_learnt: on labelled slides); tap: on test taps; partner: on what a test slide "
    "is paired with; others: on test slides",
    "difference": "disentangled less this network, slide by slide",
    "pin_error": "matched centroids with the partner's pins",
    "half_width": "holds 95 % of the errors on validation contacts of the run's own session",
    "readers": "as pose_mae, of a kernel ridge on the taps that PoseNet learnt from",
}
PIN_METRIC_NOTES = {
    "swap": "of drawn pins",
    "pin_error": "of pins by identity, with the partner's",
}

Row = TypeVar("Row")


class RecordedTest(NamedTuple):
    """The recorded contacts of a test: slides, with partners if `paired`, and taps."""

    slides: Reader | None
    taps: Reader | None
    paired: bool
    data: TestData
    # of the model's sensor, which images of other recordings must show, touched
    appearance: SensorAppearance | None = None
    touch: TouchReader | None = None


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
        kinds = {name.split("/")[1] for name in slide_scores if name.startswith("pose/")}
        main_kind = choose_main_kind(kinds)
        errors = {} if self.taps is None else dict(self.taps.scores)
        for name, score in slide_scores.items():
            if main_kind != "sheared":
                name = name.replace(f"pose/{main_kind}/", f"pose/{UNSHEARED}/")
            errors[name] = score
        return errors


def build_recorded_results(
    experiment: Experiment,
    stored: RecordedSet,
    targets: Targets,
    scores: RecordedScores,
    test: RecordedTest,
) -> Results:
    """Build the results that follow from the scores."""
    modality = get_modality(experiment)
    metric = describe_similarity(stored.size) | METRIC_NOTES
    metric |= PIN_METRIC_NOTES if modality is PINS else {}
    metric["input"] = modality.name
    metric["coverage"] = f"share of the errors here, on {test.data}, that half_width holds"
    pin_errors = {}
    if test.paired and scores.slides is not None:
        pin_errors = _measure_pin_errors(modality, scores.slides)
    tables = _build_tables(scores, targets)
    return Results(
        **describe_run(experiment, scores.get_main(), targets, tables),
        simulated=False,
        metric=metric,
        pin_error=pin_errors,
        test_data=test.data,
        recordings=_describe_recordings(experiment, stored),
        pairing=_describe_pairing(stored, test, targets),
        targets=targets,
        counts=_count_contacts(stored, scores, test),
        seeds={"experiment": experiment.seed, "splits": stored.settings.seed, "bootstrap": SEED},
    )


def _build_tables(scores: RecordedScores, targets: Targets) -> Tables:
    """Build all tables, of poses also by indentation depth and length of the slide, if known."""
    tables = build_tables(scores.get_main(), taps=scores.taps)
    slides = scores.slides
    if slides is not None:
        depth = slides.labels["pose"][:, 2]
        length = np.hypot(slides.labels["move"][:, 0], slides.labels["move"][:, 1])
        if "z_mm" in list_target_names(targets):
            parts = tabulate_by_size(slides, depth, float(depth.min()), float(depth.max()))
            tables = dataclasses.replace(tables, pose_by_depth=parts)
        if np.isfinite(length).all():
            parts = tabulate_by_size(slides, length, 0.0, float(length.max()))
            tables = dataclasses.replace(tables, pose_by_slide=parts)
    kind = choose_main_kind(tables.pose_mae)
    if kind == "sheared":
        return tables

    def copy_row(table: Mapping[str, Row]) -> Mapping[str, Row]:
        """Copy the row of the main network to UNSHEARED, the same name in every run."""
        return {**table, UNSHEARED: table[kind]} if kind in table else table

    spread = dataclasses.replace(
        tables.spread,
        pose_mae=copy_row(tables.spread.pose_mae),
        pose_recovery=copy_row(tables.spread.pose_recovery),
    )
    return dataclasses.replace(
        tables,
        pose_mae=copy_row(tables.pose_mae),
        pose_recovery=copy_row(tables.pose_recovery),
        spread=spread,
    )


def _measure_pin_errors(
    modality: Modality, slides: ContactScores
) -> dict[str, dict[str, float | None]]:
    """Measure errors against the partners' pins, in px; no recording shows how many mm they are.

    Networks over pins give pins with identities; in images pins are detected.
    """
    if modality is PINS:
        errors_px = {}
        for name, score in slides.scores.items():
            if name.startswith("pins/"):
                errors_px[name.removeprefix("pins/")] = float(np.sqrt(np.nanmean(np.square(score))))
        errors_px["true_slide"] = errors_px.pop("sheared")
        return {kind: {"rms_px": error, "rms_mm": None} for kind, error in errors_px.items()}
    tap_pins, sheared_pins = slides.pins[PINS.canonical], slides.pins[PINS.sheared]
    identified = np.isfinite(tap_pins).all((1, 2)) & np.isfinite(sheared_pins).all((1, 2))
    if not identified.any():
        return {}
    images = {kind: stack[identified] for kind, stack in slides.images.items()}
    return measure_pin_errors(images, tap_pins[identified], sheared_pins[identified], None)


def _describe_recordings(experiment: Experiment, stored: RecordedSet) -> Recordings:
    settings, counts = stored.settings, stored.metadata["counts"]
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


def _describe_pairing(stored: RecordedSet, test: RecordedTest, targets: Targets) -> Pairing:
    slides = test.slides
    if slides is None or not test.paired:
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
    return Pairing(stored.settings.pairing, gaps)


def _count_contacts(stored: RecordedSet, scores: RecordedScores, test: RecordedTest) -> Counts:
    def count_test_contacts(reader: Reader | None) -> int:
        return 0 if reader is None else reader.length("test")

    slides = 0 if scores.slides is None else scores.slides.total
    taps = 0 if scores.taps is None else scores.taps.total
    written = stored.metadata["counts"]["written"]
    return Counts(
        **{split: written[split] for split in SPLITS},
        test_poses=slides,
        test_taps=taps,
        test_unsure=count_test_contacts(test.slides) - slides,
        unread_taps=count_test_contacts(test.taps) - taps,
        pin_images=0 if scores.slides is None else len(scores.slides.kept_rows),
    )


def describe_test(results: Results) -> str:
    """Name the recorded contacts that a run is tested on.

    Results of earlier versions do not say: they are of a random split of the run's own session.
    """
    if results.test_data == "other recordings":
        return results.test_data
    return f"same session, {SPLIT_TEXTS[results.settings['paired'].get('split', 'random')]}"


def format_table(results: Results) -> str:
    """Format pose errors, PoseNet's and those of other estimators, for people."""
    names, errors = [target.name for target in results.targets or ()], results.pose_mae
    rows = [{"error": kind, **errors[kind]} for kind in POSE_ROWS if kind in errors]
    if UNSHEARED in results.pose_recovery:
        rows.append({"error": "recovery", **results.pose_recovery[UNSHEARED]})
    for name, table in results.readers.items():
        title = f"ridge on {name}, "
        rows += [{"error": title + kind, **table[kind]} for kind in POSE_ROWS if kind in table]
    lines = [format_text_table(rows, ("error", *names))]
    if results.coverage:
        lines.append(
            f"95 % half-widths of the run's own session, tried on {describe_test(results)}:"
        )
    for kind, shares in (results.coverage or {}).items():
        widths = (results.half_width or {})[kind]
        covered = [
            f"{name} {share:.1%} within {widths[name]:.3g}" for name, share in shares.items()
        ]
        lines.append(f"{kind}: {', '.join(covered)}")
    counts = results.counts
    lines.append(
        f"test, {describe_test(results)}: {counts.test_taps} taps, {counts.test_poses} slides; "
        f"left out: {counts.unread_taps or 0} taps and {counts.test_unsure or 0} slides "
        "were not understood"
    )
    return "\n".join(lines)
