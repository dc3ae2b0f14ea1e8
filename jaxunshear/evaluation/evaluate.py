"""Evaluate the networks of a run on contacts that were kept out of training.

The way of the data: `network_outputs.load_run` runs the networks, `contact_scores.score_test`
computes one number per contact and metric, and `result_tables.build_tables` averages them.
Which contacts are tested, and what else is known of them, differs between simulated and recorded
ones: `simulated_evaluation` and `recorded_evaluation`.
"""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import POSENETS
from jaxunshear.data.sources import open_source
from jaxunshear.evaluation.result_tables import finish_results
from jaxunshear.evaluation.score_files import EvaluatedRun, write_score_files
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.registry import get_net_modality, predict, unshear
from jaxunshear.results.record_files import write_record
from jaxunshear.results.run import Results
from jaxunshear.results.times import read_times
from jaxunshear.training.checkpoint import check_finished
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.trained_network import load_network

CALLS = 40  # of each network that is timed
WARM_UP_CALLS = 3  # not counted: the first compiles


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
        check_finished(run_dir / network)
        check_origin(experiment, network, run_dir)
    evaluated: EvaluatedRun = open_source(experiment).evaluate(run_dir, data_dir)
    results = replace(
        evaluated.results,
        ms_per_image={name: _time_network(run_dir / name) for name in experiment.networks},
        time_s=read_times(run_dir) | {"evaluate": time.perf_counter() - started},
    )
    results = finish_results(results, experiment, run_dir, command)
    write_score_files(run_dir, evaluated)
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
