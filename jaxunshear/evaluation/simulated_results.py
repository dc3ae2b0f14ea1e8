"""Build the results of a simulated test from its scores alone."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import cast

import numpy as np

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment, list_further_tests
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.evaluation.bootstrap import number_poses
from jaxunshear.evaluation.detected_pins import DETECTED
from jaxunshear.evaluation.measurements import BARS
from jaxunshear.evaluation.paper_results import PAPER
from jaxunshear.evaluation.pin_errors import measure_pin_errors
from jaxunshear.evaluation.result_tables import (
    CONTACT_FIELDS,
    add_estimators,
    build_tables,
    summarise_contact_quality,
    tabulate_by_size,
)
from jaxunshear.evaluation.score import compute_chance_errors
from jaxunshear.evaluation.score_collection import CollectedScores
from jaxunshear.evaluation.unambiguous_edges import SMOOTH, SMOOTH_NOTE, score_edge_angles
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.results.run import Counts, FurtherTest, ResultBar, Results, Tables

BOOTSTRAP_SEED = 0


def build_results(
    experiment: Experiment,
    scores: CollectedScores,
    further: Mapping[str, CollectedScores] = MappingProxyType({}),
) -> Results:
    """Build the results that follow from the scores; the same scores give the same bits.

    `further` are scores of further tests, by name.
    """
    paired, pose = experiment.paired.get_simulated("this"), cast(PoseData, experiment.pose)
    labels = scores.labels
    targets = make_range_targets(experiment.targets, paired.ranges)
    further_data = list_further_tests(experiment) | {DETECTED: paired}
    chance = compute_chance_errors(read_true_values(targets, labels), targets)
    return Results(
        experiment=experiment.name,
        claim=experiment.claim,
        metric=_describe_metrics(paired, len(scores.kept_rows)),
        **vars(_build_tables(paired, scores)),
        pin_error=measure_pin_errors(
            scores.images,
            scores.pins["canonical_pins"],
            scores.pins["sheared_pins"],
            paired.camera.mm_across / paired.preprocess.size,
        ),
        tests={
            name: _build_further_test(further_data[name], test_scores)
            for name, test_scores in further.items()
        },
        baselines={"pose_chance": chance},
        contact=summarise_contact_quality({name: labels[name] for name in CONTACT_FIELDS}),
        counts=_count_contacts(paired, scores),
        bars={name: ResultBar(*bar) for name, bar in BARS.items()},
        paper=PAPER,
        seeds={
            "experiment": experiment.seed,
            "paired": paired.seed,
            "pose": pose.seed,
            "bootstrap": BOOTSTRAP_SEED,
        },
        settings=dataclasses.asdict(experiment),
    )


def _describe_metrics(paired: PairedData, kept_images: int) -> dict[str, str | int]:
    """Say what the names of the tables stand for."""
    size = paired.preprocess.size
    scales = count_scales(size)
    ms_ssim = format_ms_ssim_name(scales)
    return {
        "ms_ssim": ms_ssim,
        "image_px": size,
        "scales": scales,
        "pose_mae": "mean absolute error of a PoseNet trained on taps (sheared_learnt: on slides)",
        "pose_smooth": SMOOTH_NOTE,
        "pose_ratio": "error over the error on sheared images",
        "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
        "difference": "disentangled less this network, contact by contact",
        "swap": f"mean squared error, SSIM and {ms_ssim} of a decoder's image with its target",
        "pins": "root mean square distance of pins, by identity, from the tap's; mean over slides",
        "followed": "of test images: share whose pins were identified for sure, and how far these "
        "were from the true ones",
        "pin_error": f"matched centroids of {kept_images} images against the tap's true pins",
        "readers": "mean absolute error of kernel ridges that learnt from PoseNet's training taps: "
        "pixels: their images; pins: their true pins, to read those found, and known by name, in "
        "the images that pin_error is of",
    }


def _count_contacts(paired: PairedData, scores: CollectedScores) -> Counts:
    labels = scores.labels
    return Counts(
        test_poses=len(np.unique(number_poses(labels["stimulus"], labels["pose_id"]))),
        test_by_stimulus={
            name: int(np.sum(labels["stimulus"] == index))
            for index, name in enumerate(paired.names)
        },
        test_smooth=int(labels[SMOOTH].sum()) if SMOOTH in labels else None,
        pin_images=len(scores.kept_rows),
    )


def _build_further_test(settings: PairedData, scores: CollectedScores) -> FurtherTest:
    """Build the tables of a further test, with the settings of its data."""
    return FurtherTest(
        stimuli=settings.names,
        tap_depth_jitter_mm=settings.tap_depth_jitter_mm,
        ranges=dataclasses.asdict(settings.ranges),
        contacts=len(scores.labels["stimulus"]),
        **vars(_build_tables(settings, scores)),
    )


def _build_tables(settings: PairedData, scores: CollectedScores) -> Tables:
    """Build all tables of one test."""
    labels, ranges = scores.labels, settings.ranges
    poses = number_poses(labels["stimulus"], labels["pose_id"])
    tables = build_tables(scores.scores, settings.names, labels["stimulus"], poses, BOOTSTRAP_SEED)
    estimator_scores = [(scores.scores, poses), (scores.estimates, poses[scores.kept_rows])]
    pin_errors = {}
    for name, score in scores.scores.items():
        if name.startswith("pins/"):
            mean = float(np.mean(score, dtype=np.float64))
            pin_errors[name.removeprefix("pins/")] = {"rms_px": mean}
    return dataclasses.replace(
        add_estimators(tables, estimator_scores, BOOTSTRAP_SEED),
        pins=pin_errors,
        pose_by_depth=tabulate_by_size(
            scores.scores,
            labels["pose"][:, 3],
            ranges.depth_min_mm,
            ranges.depth_max_mm,
            poses,
            BOOTSTRAP_SEED,
        ),
        pose_smooth=score_edge_angles(scores, poses, BOOTSTRAP_SEED),
    )
