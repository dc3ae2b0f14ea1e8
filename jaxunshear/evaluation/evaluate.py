"""The paper's tables for one run, on its held-out poses: networks and data in, `results.json` and `montage.npz` out.

The way through: `network_outputs.load_run` (what the networks say) -> `collect_scores` (one number an image) -> `build_results` (tables).
"""

import dataclasses
import io
import time
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import MappingProxyType

import numpy as np

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import (
    Experiment,
    get_recorded,
    list_further_tests,
    require_simulated,
    uses_pins,
)
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.data.generation import read_metadata
from jaxunshear.data.reader import open_set
from jaxunshear.errors import UserError
from jaxunshear.evaluation import recorded_evaluation
from jaxunshear.evaluation.baselines import collect_training_taps
from jaxunshear.evaluation.bootstrap import number_poses
from jaxunshear.evaluation.conformal import compute_coverage, compute_half_widths
from jaxunshear.evaluation.detected_pins import DETECTED, INPUTS, detect_pairs, iterate_batches
from jaxunshear.evaluation.inference_time import measure_ms_per_image
from jaxunshear.evaluation.measurements import BARS, round_values
from jaxunshear.evaluation.network_outputs import load_run
from jaxunshear.evaluation.paper_results import PAPER
from jaxunshear.evaluation.pin_errors import measure_pin_errors
from jaxunshear.evaluation.pose_estimators import (
    PIN_PLACES,
    PIXELS,
    fit_estimators,
    make_batch_estimators,
    score_detected_pins,
)
from jaxunshear.evaluation.result_tables import (
    CONTACT_FIELDS,
    add_estimators,
    build_tables,
    select_typical,
    summarise_contact_quality,
    tabulate_by_size,
)
from jaxunshear.evaluation.score import choose_main_kind, compute_chance_errors
from jaxunshear.evaluation.score_collection import (
    BATCH,
    FIELDS,
    IMAGES,
    PINS,
    CollectedScores,
    collect_scores,
)
from jaxunshear.evaluation.unambiguous_edges import (
    SMOOTH,
    SMOOTH_NOTE,
    mark_smooth,
    score_edge_angles,
)
from jaxunshear.files import write_bytes
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.results.record_files import write_record
from jaxunshear.results.run import Counts, FurtherTest, ResultBar, Results, Tables
from jaxunshear.results.times import read_times
from jaxunshear.results.training_summaries import read_training_facts
from jaxunshear.training.checkpoint import check_finished
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.examples import open_examples, open_recorded_set

KEPT_CONTACTS = (
    72  # contacts whose pins are found (50 ms an image), and from which the montage is chosen
)
BOOTSTRAP_SEED = 0
ScoredRun = tuple[
    Results, CollectedScores | None, dict[str, CollectedScores], tuple[str, ...]
]  # results, scores, further ones, stimuli


def evaluate(experiment: Experiment, run_dir: Path, data_dir: Path, command: str) -> Results:
    """Scores the experiment's networks in `run_dir` on the test split of the paired set, and on its further tests.

    Writes and returns the results; also writes `montage.npz` and, for who wants to compare runs contact by contact, every score
    of every contact: `scores.npz`, `scores-<test>.npz`. `command` is what a person typed, to stand beside the figures.

    Raises `UserError` where a network or the data set is missing, damaged or empty, or a network learnt from other data
    or is not trained to the end.
    """
    started = time.perf_counter()
    run_dir = Path(run_dir)
    for network in experiment.networks:
        check_finished(run_dir / network)
        check_origin(experiment, network, run_dir)
    if get_recorded(experiment):
        results, gathered, further, names = _evaluate_recorded(experiment, run_dir, data_dir)
    else:
        results, gathered, further, names = _evaluate_simulated(experiment, run_dir, data_dir)
    results = replace(
        results,
        ms_per_image=measure_ms_per_image(run_dir, experiment.networks),
        time_s=read_times(run_dir) | {"evaluate": time.perf_counter() - started},
        **read_training_facts(run_dir, experiment.networks),
        **describe_provenance(command),
    )
    results = round_values(results)
    if gathered is not None:
        write_bytes(run_dir / "scores.npz", encode_scores(gathered))
        if names:
            write_bytes(run_dir / "montage.npz", encode_montage(names, gathered))
    for name, found in further.items():
        write_bytes(run_dir / f"scores-{name}.npz", encode_scores(found))
    write_record(run_dir / "results.json", results)
    return results


def _evaluate_simulated(experiment: Experiment, run_dir: Path, data_dir: Path) -> ScoredRun:
    """On the test split of the simulated pairs, and on further tests."""
    paired, _ = require_simulated(experiment, "this")
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    pairs, targets = examples.reader, examples.targets
    total = pairs.length("test")
    if not total:
        raise UserError(
            f"the test split in {data_dir} is empty: nothing to evaluate; raise paired.poses"
        )
    over = uses_pins(experiment)
    taps = (
        None
        if over
        else collect_training_taps(
            pairs.split("train", BATCH, ("canonical", "stimulus", "pose_id"))
        )
    )
    run = load_run(run_dir, experiment.networks, taps, examples.pins if over else None)
    inputs = PINS if over else IMAGES
    lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
    readers = fit_estimators(experiment, data_dir, run_dir)
    reads = make_batch_estimators(
        {name: reader for name, reader in readers.items() if over or name == PIXELS}
    )
    gathered = collect_scores(
        run,
        pairs.split("test", BATCH, FIELDS),
        total,
        KEPT_CONTACTS,
        targets,
        inputs=inputs,
        readers=reads,
    )
    gathered = mark_smooth(gathered, paired)
    if PIN_PLACES in readers and not over:
        true = {
            name: value[gathered.kept_rows]
            for name, value in read_true_values(targets, gathered.labels).items()
        }
        gathered = gathered._replace(
            estimates=score_detected_pins(readers[PIN_PLACES], lattice, gathered.images, true)
        )
    further = {}
    for name, settings in list_further_tests(experiment).items():
        reader = open_set(settings, data_dir, experiment.sensor)
        count = sum(reader.length(split) for split in SPLITS)
        batches = chain.from_iterable(reader.split(split, BATCH, FIELDS) for split in SPLITS)
        tested = collect_scores(
            run, batches, count, 0, targets, f"evaluate {name}", inputs, readers=reads
        )
        further[name] = mark_smooth(tested, settings)
    found = detect_pairs(pairs, lattice, FIELDS) if over else None
    if found:
        count, title = len(found.pairs["pose"]), "evaluate found pins"
        tested = collect_scores(
            run, iterate_batches(found, BATCH), count, 0, targets, title, INPUTS, readers=reads
        )
        further[DETECTED] = mark_smooth(tested, paired)
    results = build_results(experiment, gathered, further)
    if found:
        tests = {
            **results.tests,
            DETECTED: replace(results.tests[DETECTED], followed=found.reported),
        }
        results = replace(results, tests=tests)
    stored = read_metadata(paired, experiment.sensor, data_dir)["counts"]
    counts = replace(
        results.counts,
        train=pairs.length("train"),
        validation=pairs.length("validation"),
        test=total,
        contacts=stored["contacts"],
        retried=stored["retried"],
        dropped=stored["dropped"],
        reader_taps={name: reader.taps for name, reader in readers.items()},
    )
    return replace(results, counts=counts), gathered, further, paired.names


def _evaluate_recorded(experiment: Experiment, run_dir: Path, data_dir: Path) -> ScoredRun:
    """On the test split of a recorded set."""
    stored = open_recorded_set(experiment, data_dir)
    targets = stored.make_targets(experiment.targets)
    test = recorded_evaluation.choose_test(experiment, stored, targets, run_dir, data_dir)
    readers = (
        fit_estimators(experiment, data_dir, run_dir)
        if stored.count_contacts("taps", "train")
        else {}
    )
    run = recorded_evaluation.load_recorded_run(experiment, run_dir, stored)
    slides, taps = recorded_evaluation.collect_recorded_scores(
        experiment, run, test, targets, make_batch_estimators(readers)
    )
    results = recorded_evaluation.build_results(experiment, stored, targets, slides, taps, test)
    known = recorded_evaluation.collect_recorded_scores(
        experiment, run, test, targets, split="validation"
    )
    widths = compute_half_widths(recorded_evaluation.list_pose_errors(*known))
    results = replace(
        results,
        half_width=widths,
        coverage=compute_coverage(widths, recorded_evaluation.list_pose_errors(slides, taps)),
        counts=replace(
            results.counts, reader_taps={name: reader.taps for name, reader in readers.items()}
        ),
    )
    if slides is None:
        return results, taps, {}, ()
    further = {} if taps is None else {"taps": taps}
    return (
        results,
        recorded_evaluation.convert_montage_labels(slides),
        further,
        ("recorded",) if test.paired else (),
    )


def encode_scores(gathered: CollectedScores) -> bytes:
    """An npz of all scores by name, `stimulus`, `pose_id`, and SMOOTH if it is known, (N,) each."""
    buffer = io.BytesIO()
    labels = {
        name: gathered.labels[name]
        for name in ("stimulus", "pose_id", SMOOTH)
        if name in gathered.labels
    }
    np.savez_compressed(buffer, **gathered.scores, **labels)  # type: ignore[arg-type]
    return buffer.getvalue()


def build_results(
    experiment: Experiment,
    gathered: CollectedScores,
    further: Mapping[str, CollectedScores] = MappingProxyType({}),
) -> Results:
    """All of the results that follow from the scores alone: the same scores give the same bits. `further`: tests of their own."""
    labels, (paired, pose) = gathered.labels, require_simulated(experiment, "this")
    names, size = paired.names, paired.preprocess.size
    scales = count_scales(size)
    targets = make_range_targets(experiment.targets, paired.ranges)
    true = read_true_values(targets, labels)
    tested = list_further_tests(experiment) | {DETECTED: paired}
    return Results(
        experiment=experiment.name,
        claim=experiment.claim,
        metric={
            "ms_ssim": format_ms_ssim_name(scales),
            "image_px": size,
            "scales": scales,
            "pose_mae": "mean absolute error of a PoseNet trained on taps (sheared_learnt: on slides)",
            "pose_smooth": SMOOTH_NOTE,
            "pose_ratio": "error over the error on sheared images",
            "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
            "difference": "disentangled less this network, contact by contact",
            "swap": f"mean squared error, SSIM and {format_ms_ssim_name(scales)} of a decoder's image with its target",
            "pins": "root mean square distance of pins, by identity, from the tap's; mean over slides",
            "followed": "of test images: share whose pins were identified for sure, and how far these were from the true ones",
            "pin_error": f"matched centroids of {len(gathered.kept_rows)} images against the tap's true pins",
            "readers": "mean absolute error of kernel ridges that learnt from PoseNet's training taps: pixels: their images; pins: "
            "their true pins, to read those found, and known by name, in the images that pin_error is of",
        },
        **vars(_tables(paired, gathered)),
        pin_error=measure_pin_errors(
            gathered.images,
            gathered.pins["canonical_pins"],
            gathered.pins["sheared_pins"],
            paired.camera.mm_across / size,
        ),
        tests={name: _further(tested[name], found) for name, found in further.items()},
        baselines={"pose_chance": compute_chance_errors(true, targets)},
        contact=summarise_contact_quality({name: labels[name] for name in CONTACT_FIELDS}),
        counts=Counts(
            test_poses=len(np.unique(number_poses(labels["stimulus"], labels["pose_id"]))),
            test_by_stimulus={
                name: int(np.sum(labels["stimulus"] == index)) for index, name in enumerate(names)
            },
            test_smooth=int(labels[SMOOTH].sum()) if SMOOTH in labels else None,
            pin_images=len(gathered.kept_rows),
        ),
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


def _further(settings: PairedData, gathered: CollectedScores) -> FurtherTest:
    """The tables of a test of its own, with what it was made of."""
    return FurtherTest(
        stimuli=settings.names,
        tap_depth_jitter_mm=settings.tap_depth_jitter_mm,
        ranges=dataclasses.asdict(settings.ranges),
        contacts=len(gathered.labels["stimulus"]),
        **vars(_tables(settings, gathered)),
    )


def _tables(settings: PairedData, gathered: CollectedScores) -> Tables:
    """All that is reported of the scores of one test."""
    labels, ranges = gathered.labels, settings.ranges
    poses = number_poses(labels["stimulus"], labels["pose_id"])
    read = [(gathered.scores, poses), (gathered.estimates, poses[gathered.kept_rows])]
    of_pins = {
        name.removeprefix("pins/"): s
        for name, s in gathered.scores.items()
        if name.startswith("pins/")
    }
    found = build_tables(gathered.scores, settings.names, labels["stimulus"], poses, BOOTSTRAP_SEED)
    return replace(
        add_estimators(found, read, BOOTSTRAP_SEED),
        pins={
            kind: {"rms_px": float(np.mean(score, dtype=np.float64))}
            for kind, score in of_pins.items()
        },
        pose_by_depth=tabulate_by_size(
            gathered.scores,
            labels["pose"][:, 3],
            ranges.depth_min_mm,
            ranges.depth_max_mm,
            poses,
            BOOTSTRAP_SEED,
        ),
        pose_smooth=score_edge_angles(gathered, poses, BOOTSTRAP_SEED),
    )


def encode_montage(names: tuple[str, ...], gathered: CollectedScores) -> bytes:
    """An npz of a few contacts: for every stimulus one of low, one of middling and one of high similarity unsheared.

    Images (M, S, S) uint8 by kind, `stimulus` (M,) names, `pose` (M, 4 or 6), `move` (M, 2 or 3), and `ms_ssim_<kind>` (M,).
    """
    stimulus = gathered.labels["stimulus"][gathered.kept_rows]
    judged = choose_main_kind(gathered.images)
    shown = select_typical(gathered.scores[f"ms_ssim/{judged}"][gathered.kept_rows], stimulus)
    contacts = gathered.kept_rows[shown]
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        stimulus=np.array(names)[stimulus[shown]],
        pose=gathered.labels["pose"][contacts],
        move=gathered.labels["move"][contacts],
        **{kind: images[shown] for kind, images in gathered.images.items()},
        **{
            f"ms_ssim_{kind}": gathered.scores[f"ms_ssim/{kind}"][contacts]
            for kind in gathered.images
            if kind != "tap"
        },
    )
    return buffer.getvalue()
