"""Build the results of a recorded test from its scores alone."""

import dataclasses
from collections.abc import Mapping
from typing import TypeVar

import numpy as np

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.targets import Targets, list_target_names, read_true_values
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.evaluation.bootstrap import number_poses, resample_means
from jaxunshear.evaluation.paper_results import PAPER
from jaxunshear.evaluation.pin_errors import measure_pin_errors
from jaxunshear.evaluation.recorded_descriptions import (
    ScoredContacts,
    count_test_contacts,
    describe_pairing,
    describe_recordings,
)
from jaxunshear.evaluation.recorded_scores import UNSHEARED, RecordedScores, RecordedTest
from jaxunshear.evaluation.result_tables import (
    Resampled,
    add_estimators,
    build_tables,
    tabulate_by_size,
)
from jaxunshear.evaluation.score import choose_main_kind, compute_chance_errors
from jaxunshear.evaluation.score_collection import CollectedScores
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.models.modality import PINS
from jaxunshear.results.run import Results, Tables

Row = TypeVar("Row")
PinErrors = dict[str, dict[str, float | None]]  # px and mm by kind
SEED = 0  # of the bootstrap


def build_results(
    experiment: Experiment,
    stored: RecordedSet,
    targets: Targets,
    scores: RecordedScores,
    test: RecordedTest,
) -> Results:
    """Build the results that follow from the scores."""
    labels = _get_contacts(scores).labels
    chance = compute_chance_errors(read_true_values(targets, labels), targets)
    return Results(
        experiment=experiment.name,
        claim=experiment.claim,
        simulated=False,
        metric=_describe_metrics(experiment, stored.size, test),
        **vars(_build_tables(scores, targets)),
        pin_error=_measure_pin_errors(experiment, scores.slides) if test.paired else {},
        baselines={"pose_chance": chance},
        test_data=test.data,
        recordings=describe_recordings(experiment, stored),
        pairing=describe_pairing(experiment, test.slides if test.paired else None, targets),
        targets=targets,
        counts=count_test_contacts(
            stored,
            ScoredContacts(test.slides, scores.slides),
            ScoredContacts(test.taps, scores.taps),
        ),
        paper=PAPER,
        seeds={"experiment": experiment.seed, "splits": stored.settings.seed, "bootstrap": SEED},
        settings=dataclasses.asdict(experiment),
    )


def _get_contacts(scores: RecordedScores) -> CollectedScores:
    """Return the slides, or the taps of a test without slides."""
    contacts = scores.taps if scores.slides is None else scores.slides
    assert contacts is not None
    return contacts


def _describe_metrics(
    experiment: Experiment, size: int, test: RecordedTest
) -> dict[str, str | int]:
    """Say what the names of the tables stand for."""
    scales = count_scales(size)
    ms_ssim = format_ms_ssim_name(scales)
    if uses_pins(experiment):
        swap, pin_error = "of drawn pins", "of pins by identity, with the partner's"
    else:
        swap = f"mean squared error, SSIM and {ms_ssim} of a decoder's image"
        pin_error = "matched centroids with the partner's pins"
    return {
        "ms_ssim": ms_ssim,
        "image_px": size,
        "scales": scales,
        "input": experiment.unshear.input,
        "pose_mae": "mean absolute error, in the labels' own frame, of a PoseNet trained on "
        "recorded taps (sheared_learnt: on labelled slides); tap: on test taps; partner: on what a "
        "test slide is paired with; others: on test slides",
        "pose_ratio": "error over the error on sheared images",
        "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
        "difference": "disentangled less this network, slide by slide",
        "swap": swap,
        "pin_error": pin_error,
        "half_width": "holds 95 % of the errors on validation contacts of the run's own session",
        "coverage": f"share of the errors here, on {test.data}, that half_width holds",
        "readers": "as pose_mae, of a kernel ridge on the taps that PoseNet learnt from",
    }


def _build_tables(scores: RecordedScores, targets: Targets) -> Tables:
    """Build all tables; taps and slides are resampled separately, as they are no pairs."""
    slides, taps = scores
    separate = None
    if taps is not None and taps.scores:
        means = resample_means(taps.scores, taps.labels["number"], SEED + 1)
        separate = Resampled(taps.scores, means)
    labels = _get_contacts(scores).labels
    slide_scores = {} if slides is None else slides.scores
    poses = number_poses(labels["stimulus"], labels["number"])
    tables = build_tables(slide_scores, (), labels["stimulus"], poses, SEED, separate)
    if slides is not None:
        tables = _add_sizes(tables, slides, poses, targets)
    estimator_scores = []
    for contacts in (taps, slides):
        if contacts is not None:
            estimator_scores.append((contacts.scores, contacts.labels["number"]))
    return _copy_main_network(add_estimators(tables, estimator_scores, SEED))


def _add_sizes(
    tables: Tables, slides: CollectedScores, poses: np.ndarray, targets: Targets
) -> Tables:
    """Add the poses by indentation depth and by length of the slide, if these are known."""
    scores, labels = slides.scores, slides.labels
    depth = labels["pose"][:, 2]
    length = np.hypot(labels["move"][:, 0], labels["move"][:, 1])
    if "z_mm" in list_target_names(targets):
        parts = tabulate_by_size(scores, depth, float(depth.min()), float(depth.max()), poses, SEED)
        tables = dataclasses.replace(tables, pose_by_depth=parts)
    if np.isfinite(length).all():
        parts = tabulate_by_size(scores, length, 0.0, float(length.max()), poses, SEED)
        tables = dataclasses.replace(tables, pose_by_slide=parts)
    return tables


def _copy_main_network(tables: Tables) -> Tables:
    """Copy the rows of the main network to UNSHEARED, the same name in every run."""
    kind = choose_main_kind(tables.pose_mae)
    if kind == "sheared":
        return tables

    def copy_row(table: Mapping[str, Row]) -> Mapping[str, Row]:
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


def _measure_pin_errors(experiment: Experiment, slides: CollectedScores | None) -> PinErrors:
    """Measure errors against the partners' pins, in px; no recording shows how many mm they are."""
    if slides is None:
        return {}
    if uses_pins(experiment):
        return _summarise_pin_scores(slides)
    tap_pins, sheared_pins = slides.pins[PINS.canonical], slides.pins[PINS.sheared]
    identified = np.isfinite(tap_pins).all((1, 2)) & np.isfinite(sheared_pins).all((1, 2))
    if not identified.any():
        return {}
    images = {kind: stack[identified] for kind, stack in slides.images.items()}
    return measure_pin_errors(images, tap_pins[identified], sheared_pins[identified], None)


def _summarise_pin_scores(slides: CollectedScores) -> PinErrors:
    """Summarise the errors of networks over pins, whose pins have identities."""
    errors_px = {}
    for name, score in slides.scores.items():
        if name.startswith("pins/"):
            errors_px[name.removeprefix("pins/")] = float(np.sqrt(np.nanmean(np.square(score))))
    errors_px["true_slide"] = errors_px.pop("sheared")
    return {kind: {"rms_px": error, "rms_mm": None} for kind, error in errors_px.items()}
