"""The paper's tables for one run, on its held-out poses: networks and data in, `results.json` and `montage.npz` out.

The way through: `networks.load` (what the networks say) -> `gather` (one number an image) -> `results_of` (tables).
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

from jaxunshear.dataset.generation import read_metadata
from jaxunshear.dataset.reader import open_set
from jaxunshear.errors import UserError
from jaxunshear.evaluation import recorded
from jaxunshear.evaluation.baselines import training_taps
from jaxunshear.evaluation.found import FOUND, INPUTS, batches_of, found_pairs
from jaxunshear.evaluation.gather import BATCH, FIELDS, IMAGES, PINS, Gathered, gather
from jaxunshear.evaluation.measurements import BARS, rounded
from jaxunshear.evaluation.networks import load
from jaxunshear.evaluation.paper import PAPER
from jaxunshear.evaluation.pins import pin_errors
from jaxunshear.evaluation.readers import PIN_PLACES, PIXELS, of_batches, read_pins, readers_of
from jaxunshear.evaluation.score import chance, shown_kind
from jaxunshear.evaluation.smooth import SMOOTH, WHAT, edge_angles, marked
from jaxunshear.evaluation.speed import ms_per_image
from jaxunshear.evaluation.spread import numbered_poses
from jaxunshear.evaluation.summary import (
    CONTACT_FIELDS,
    contact_quality,
    pose_by_size,
    tables,
    typical,
    with_readers,
)
from jaxunshear.evaluation.within import coverage, half_widths
from jaxunshear.image.rest_positions import compute_rest_lattice
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.results.run import Bar, Counts, Further, Results, Tables
from jaxunshear.results.stored import write
from jaxunshear.results.times import read_times
from jaxunshear.results.trained import read_trained
from jaxunshear.settings.data import PairedData
from jaxunshear.settings.experiment import (
    Experiment,
    further_tests,
    over_pins,
    recorded_of,
    simulated_of,
)
from jaxunshear.settings.registry import DISENTANGLED
from jaxunshear.settings.splits import SPLITS
from jaxunshear.settings.targets import of_ranges, true_values
from jaxunshear.storage import write_bytes
from jaxunshear.training.checkpoint import check_finished
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.examples import open_examples, open_recorded_set

KEPT = 72  # contacts whose pins are found (50 ms an image), and from which the montage is chosen
BOOTSTRAP_SEED = 0
Scored = tuple[
    Results, Gathered | None, dict[str, Gathered], tuple[str, ...]
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
    if recorded_of(experiment):
        results, gathered, further, names = _recorded(experiment, run_dir, data_dir)
    else:
        results, gathered, further, names = _simulated(experiment, run_dir, data_dir)
    results = replace(
        results,
        ms_per_image=ms_per_image(run_dir, experiment.networks),
        time_s=read_times(run_dir) | {"evaluate": time.perf_counter() - started},
        **read_trained(run_dir, experiment.networks),
        **describe_provenance(command),
    )
    results = rounded(results)
    if gathered is not None:
        write_bytes(run_dir / "scores.npz", every_score(gathered))
        if names:
            write_bytes(run_dir / "montage.npz", montage(names, gathered))
    for name, found in further.items():
        write_bytes(run_dir / f"scores-{name}.npz", every_score(found))
    write(run_dir / "results.json", results)
    return results


def _simulated(experiment: Experiment, run_dir: Path, data_dir: Path) -> Scored:
    """On the test split of the simulated pairs, and on further tests."""
    paired, _ = simulated_of(experiment, "this")
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    pairs, targets = examples.reader, examples.targets
    total = pairs.length("test")
    if not total:
        raise UserError(
            f"the test split in {data_dir} is empty: nothing to evaluate; raise paired.poses"
        )
    over = over_pins(experiment)
    taps = (
        None
        if over
        else training_taps(pairs.split("train", BATCH, ("canonical", "stimulus", "pose_id")))
    )
    run = load(run_dir, experiment.networks, taps, examples.pins if over else None)
    inputs = PINS if over else IMAGES
    lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
    readers = readers_of(experiment, data_dir, run_dir)
    reads = of_batches({name: reader for name, reader in readers.items() if over or name == PIXELS})
    gathered = gather(
        run, pairs.split("test", BATCH, FIELDS), total, KEPT, targets, inputs=inputs, readers=reads
    )
    gathered = marked(gathered, paired)
    if PIN_PLACES in readers and not over:
        true = {
            name: value[gathered.kept]
            for name, value in true_values(targets, gathered.labels).items()
        }
        gathered = gathered._replace(
            read=read_pins(readers[PIN_PLACES], lattice, gathered.images, true)
        )
    further = {}
    for name, settings in further_tests(experiment).items():
        reader = open_set(settings, data_dir, experiment.sensor)
        count = sum(reader.length(split) for split in SPLITS)
        batches = chain.from_iterable(reader.split(split, BATCH, FIELDS) for split in SPLITS)
        tested = gather(run, batches, count, 0, targets, f"evaluate {name}", inputs, readers=reads)
        further[name] = marked(tested, settings)
    found = found_pairs(pairs, lattice, FIELDS) if over else None
    if found:
        count, title = len(found.pairs["pose"]), "evaluate found pins"
        tested = gather(
            run, batches_of(found, BATCH), count, 0, targets, title, INPUTS, readers=reads
        )
        further[FOUND] = marked(tested, paired)
    results = results_of(experiment, gathered, further)
    if found:
        tests = {**results.tests, FOUND: replace(results.tests[FOUND], followed=found.reported)}
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


def _recorded(experiment: Experiment, run_dir: Path, data_dir: Path) -> Scored:
    """On the test split of a recorded set."""
    stored = open_recorded_set(experiment, data_dir)
    targets = stored.targets(experiment.targets)
    test = recorded.what_to_test(experiment, stored, targets, run_dir, data_dir)
    readers = readers_of(experiment, data_dir, run_dir) if stored.count("taps", "train") else {}
    run = recorded.networks_of(experiment, run_dir, stored)
    slides, taps = recorded.gathered_of(experiment, run, test, targets, of_batches(readers))
    results = recorded.results_of(experiment, stored, targets, slides, taps, test)
    known = recorded.gathered_of(experiment, run, test, targets, split="validation")
    widths = half_widths(recorded.errors_of(*known))
    results = replace(
        results,
        half_width=widths,
        coverage=coverage(widths, recorded.errors_of(slides, taps)),
        counts=replace(
            results.counts, reader_taps={name: reader.taps for name, reader in readers.items()}
        ),
    )
    if slides is None:
        return results, taps, {}, ()
    further = {} if taps is None else {"taps": taps}
    return results, recorded.as_montage(slides), further, ("recorded",) if test.paired else ()


def every_score(gathered: Gathered) -> bytes:
    """An npz of all scores by name, `stimulus`, `pose_id`, and SMOOTH if it is known, (N,) each."""
    buffer = io.BytesIO()
    labels = {
        name: gathered.labels[name]
        for name in ("stimulus", "pose_id", SMOOTH)
        if name in gathered.labels
    }
    np.savez_compressed(buffer, **gathered.scores, **labels)  # type: ignore[arg-type]
    return buffer.getvalue()


def results_of(
    experiment: Experiment,
    gathered: Gathered,
    further: Mapping[str, Gathered] = MappingProxyType({}),
) -> Results:
    """All of the results that follow from the scores alone: the same scores give the same bits. `further`: tests of their own."""
    labels, (paired, pose) = gathered.labels, simulated_of(experiment, "this")
    names, size = paired.names, paired.preprocess.size
    scales = count_scales(size)
    targets = of_ranges(experiment.targets, paired.ranges)
    true = true_values(targets, labels)
    tested = further_tests(experiment) | {FOUND: paired}
    return Results(
        experiment=experiment.name,
        claim=experiment.claim,
        metric={
            "ms_ssim": format_ms_ssim_name(scales),
            "image_px": size,
            "scales": scales,
            "pose_mae": "mean absolute error of a PoseNet trained on taps (sheared_learnt: on slides)",
            "pose_smooth": WHAT,
            "pose_ratio": "error over the error on sheared images",
            "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
            "difference": "disentangled less this network, contact by contact",
            "swap": f"mean squared error, SSIM and {format_ms_ssim_name(scales)} of a decoder's image with its target",
            "pins": "root mean square distance of pins, by identity, from the tap's; mean over slides",
            "followed": "of test images: share whose pins were identified for sure, and how far these were from the true ones",
            "pin_error": f"matched centroids of {len(gathered.kept)} images against the tap's true pins",
            "readers": "mean absolute error of kernel ridges that learnt from PoseNet's training taps: pixels: their images; pins: "
            "their true pins, to read those found, and known by name, in the images that pin_error is of",
        },
        **vars(_tables(paired, gathered)),
        pin_error=pin_errors(
            gathered.images,
            gathered.pins["canonical_pins"],
            gathered.pins["sheared_pins"],
            paired.camera.mm_across / size,
        ),
        tests={name: _further(tested[name], found) for name, found in further.items()},
        baselines={"pose_chance": chance(true, targets)},
        contact=contact_quality({name: labels[name] for name in CONTACT_FIELDS}),
        counts=Counts(
            test_poses=len(np.unique(numbered_poses(labels["stimulus"], labels["pose_id"]))),
            test_by_stimulus={
                name: int(np.sum(labels["stimulus"] == index)) for index, name in enumerate(names)
            },
            test_smooth=int(labels[SMOOTH].sum()) if SMOOTH in labels else None,
            pin_images=len(gathered.kept),
        ),
        bars={name: Bar(*bar) for name, bar in BARS.items()},
        paper=PAPER,
        seeds={
            "experiment": experiment.seed,
            "paired": paired.seed,
            "pose": pose.seed,
            "bootstrap": BOOTSTRAP_SEED,
        },
        settings=dataclasses.asdict(experiment),
    )


def _further(settings: PairedData, gathered: Gathered) -> Further:
    """The tables of a test of its own, with what it was made of."""
    return Further(
        stimuli=settings.names,
        tap_depth_jitter_mm=settings.tap_depth_jitter_mm,
        ranges=dataclasses.asdict(settings.ranges),
        contacts=len(gathered.labels["stimulus"]),
        **vars(_tables(settings, gathered)),
    )


def _tables(settings: PairedData, gathered: Gathered) -> Tables:
    """All that is reported of the scores of one test."""
    labels, ranges = gathered.labels, settings.ranges
    poses = numbered_poses(labels["stimulus"], labels["pose_id"])
    read = [(gathered.scores, poses), (gathered.read, poses[gathered.kept])]
    of_pins = {
        name.removeprefix("pins/"): s
        for name, s in gathered.scores.items()
        if name.startswith("pins/")
    }
    found = tables(gathered.scores, settings.names, labels["stimulus"], poses, BOOTSTRAP_SEED)
    return replace(
        with_readers(found, read, BOOTSTRAP_SEED),
        pins={
            kind: {"rms_px": float(np.mean(score, dtype=np.float64))}
            for kind, score in of_pins.items()
        },
        pose_by_depth=pose_by_size(
            gathered.scores,
            labels["pose"][:, 3],
            ranges.depth_min_mm,
            ranges.depth_max_mm,
            poses,
            BOOTSTRAP_SEED,
        ),
        pose_smooth=edge_angles(gathered, poses, BOOTSTRAP_SEED),
    )


def montage(names: tuple[str, ...], gathered: Gathered) -> bytes:
    """An npz of a few contacts: for every stimulus one of low, one of middling and one of high similarity unsheared.

    Images (M, S, S) uint8 by kind, `stimulus` (M,) names, `pose` (M, 4 or 6), `move` (M, 2 or 3), and `ms_ssim_<kind>` (M,).
    """
    stimulus = gathered.labels["stimulus"][gathered.kept]
    judged = shown_kind(gathered.images)
    shown = typical(gathered.scores[f"ms_ssim/{judged}"][gathered.kept], stimulus)
    contacts = gathered.kept[shown]
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
