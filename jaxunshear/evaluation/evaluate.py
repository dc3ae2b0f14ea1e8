"""Evaluate the networks of a run on contacts that were kept out of training.

The way of the data: `network_outputs.load_run` runs the networks, `contact_scores.score_test`
computes one number per contact and metric, and `result_tables.build_tables` averages them.
Which contacts are tested, and what else is known of them, differs between simulated and recorded
ones: `simulated_evaluation` and `recorded_evaluation`.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import POSENETS
from jaxunshear.data.sources import open_source
from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.result_tables import finish_results
from jaxunshear.evaluation.score import SMOOTH, choose_main_kind
from jaxunshear.files import write_npz
from jaxunshear.inference.forward import jit_for_inference
from jaxunshear.models.registry import get_net_modality, predict, unshear
from jaxunshear.results.record_files import read_times, write_record
from jaxunshear.results.run import Results
from jaxunshear.training.checkpoint import check_training, load_network
from jaxunshear.training.provenance import check_origin

CALLS = 40  # of each network that is timed
WARM_UP_CALLS = 3  # not counted: the first compiles
QUANTILES = (0.1, 0.5, 0.9)  # of the similarity of the contacts in a montage


class EvaluatedRun(NamedTuple):
    """The results of a run, and the scores that they come from."""

    results: Results
    scores: ContactScores | None
    further: Mapping[str, ContactScores]  # of further tests, by name
    montage_names: tuple[str, ...]  # names of the stimuli in the montage; none: no montage


def evaluate(experiment: Experiment, run_dir: Path, data_dir: Path, command: str) -> Results:
    """Score the networks in `run_dir` on the test split of the pairs, and on further tests.

    Writes and returns the results. Also writes `montage.npz`, and every score of every contact to
    `scores.npz` and `scores-<test>.npz`, so that runs can be compared contact by contact. `command`
    is what the user typed; the results keep it.

    Raises `UserError` if a network or the data set is missing, damaged or empty, or a network
    learnt from other data or is not trained to the end.
    """
    started = time.perf_counter()
    run_dir = Path(run_dir)
    for network in experiment.networks:
        check_training(run_dir / network)
        check_origin(experiment, network, run_dir)
    evaluated: EvaluatedRun = open_source(experiment).evaluate(run_dir, data_dir)
    results = replace(
        evaluated.results,
        ms_per_image={name: _time_network(run_dir / name) for name in experiment.networks},
        time_s=read_times(run_dir) | {"evaluate": time.perf_counter() - started},
    )
    results = finish_results(results, experiment, run_dir, command)
    if evaluated.scores is not None:
        write_npz(run_dir / "scores.npz", collect_scores(evaluated.scores), compressed=True)
        if evaluated.montage_names:
            montage = collect_montage(evaluated.montage_names, evaluated.scores)
            write_npz(run_dir / "montage.npz", montage, compressed=True)
    for name, scores in evaluated.further.items():
        write_npz(run_dir / f"scores-{name}.npz", collect_scores(scores), compressed=True)
    write_record(run_dir / "results.json", results)
    return results


def _time_network(folder: Path) -> dict[str, float]:
    """Time a network on one sheared input at a time, as a robot would ask: ms, host to host."""
    net, variables, _ = load_network(folder)
    function = predict if folder.name in POSENETS else unshear
    run = jit_for_inference(partial(function, net), variables)
    example = get_net_modality(net).make_example(net, variables)
    times_ms = []
    for _ in range(WARM_UP_CALLS + CALLS):
        started = time.perf_counter()
        np.asarray(run(example))
        times_ms.append(1e3 * (time.perf_counter() - started))
    counted = times_ms[WARM_UP_CALLS:]
    return {"median": float(np.median(counted)), "p95": float(np.percentile(counted, 95))}


def collect_scores(contacts: ContactScores) -> dict[str, np.ndarray]:
    """Collect all scores of scores.npz, with labels, among them poses.

    Labels are `stimulus`, `pose_id`, SMOOTH if known, the poses as `Scorer.label_poses` names them,
    and of slides `slide_mm` and `depth_mm`. All are (N,) by name.
    """
    labels, kept = contacts.labels, ("stimulus", "pose_id", SMOOTH)
    arrays = {
        name: value for name, value in labels.items() if name in kept or name.startswith("pose.")
    }
    if "move" in labels:
        arrays["slide_mm"] = np.hypot(*labels["move"][:, :2].T)
        arrays["depth_mm"] = labels["pose"][:, 3]
    return {**contacts.scores, **arrays}


def collect_montage(names: tuple[str, ...], contacts: ContactScores) -> dict[str, np.ndarray]:
    """Collect a few contacts of each stimulus: one of low, middling and high similarity.

    The similarity is that of the unsheared image. Images (M, S, S) uint8 are by kind, `stimulus`
    (M,) are names, `pose` is (M, 4 or 6), `move` (M, 2 or 3), and `ms_ssim_<kind>` (M,).
    """
    stimulus = contacts.labels["stimulus"][contacts.kept_rows]
    main_kind = choose_main_kind(contacts.images)
    similarity = contacts.scores[f"ms_ssim/{main_kind}"][contacts.kept_rows]
    shown = select_typical(similarity, stimulus)
    rows = contacts.kept_rows[shown]
    arrays = {
        "stimulus": np.array(names)[stimulus[shown]],
        "pose": contacts.labels["pose"][rows],
        "move": contacts.labels["move"][rows],
    }
    for kind, images in contacts.images.items():
        arrays[kind] = images[shown]
        if kind != "tap":
            arrays[f"ms_ssim_{kind}"] = contacts.scores[f"ms_ssim/{kind}"][rows]
    return arrays


def select_typical(scores: np.ndarray, stimulus: np.ndarray) -> np.ndarray:
    """Select contacts to show: for each stimulus those at QUANTILES of the score, worst first.

    Returns indices, none twice.
    """
    chosen: list[int] = []
    for index in np.unique(stimulus):
        inside = np.flatnonzero(stimulus == index)
        ranked = inside[np.argsort(scores[inside], kind="stable")]
        chosen += dict.fromkeys(int(ranked[round(q * (len(ranked) - 1))]) for q in QUANTILES)
    return np.array(chosen, np.int64)
