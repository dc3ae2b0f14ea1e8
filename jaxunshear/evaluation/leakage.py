"""Measure leakage: pose in the shear code and slide in the pose code, by probes on held-out poses.

    results = measure_leakage(experiment, Path("runs/demo"), Path("datasets"), command)

Each quantity is probed by itself, by every family of `probes`. The result is the largest R2 over
the families, which errs towards a leak. Its ceiling is the largest R2 that the same families reach
from the pins of the network's input, or from either code. Quantities that the input does not show
have no ceiling; they are named, and left out of means. A slide is given in the sensor's frame.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import DISENTANGLED
from jaxunshear.evaluation.bootstrap import INTERVALS_OVER, compute_interval, resample_means
from jaxunshear.evaluation.code_exchange import measure_exchange_errors
from jaxunshear.evaluation.codes import load_code_network
from jaxunshear.evaluation.independence import measure_independence
from jaxunshear.evaluation.probe_data import ProbeSplit, Quantity, read_splits
from jaxunshear.evaluation.probes import (
    FAMILIES,
    Whitening,
    compute_r2,
    fit_whitening,
    prepare_task,
)
from jaxunshear.evaluation.slide_estimation import CodedSlides, estimate_slides
from jaxunshear.files import Json, write_json
from jaxunshear.metrics.disentanglement import Blocks, score_dci, score_mig, score_sap
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.results.training_summaries import read_training_facts
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.examples import open_examples

MIN_CEILING = 0.1  # R2 from the input: below it the input does not show a quantity
SEED = 0
CODES = ("z_s", "z_p")
UNTRAINED = "untrained "  # prefix of the codes of an untrained network
METRIC = (
    "R2 on test poses of the family of probes that finds most; share: R2 over its ceiling, the "
    f"most that the input's pins or a code give; brackets: 95 % over {INTERVALS_OVER}"
)
LEAKS = (("pose", "z_s"), ("slide", "z_p"))  # what a code should not contain
OWNERS = {"pose": "z_p", "slide": "z_s"}  # the code that should contain each part of a contact


class Estimate(NamedTuple):
    """Errors of the family that estimates a quantity best."""

    family: str
    squares: np.ndarray  # (M,) squared error
    scatter: np.ndarray  # (M,) squared distance from the mean
    families: dict[str, float]  # R2 of every family

    @property
    def r2(self) -> float:
        return self.families[self.family]


def measure_leakage(
    experiment: Experiment, run_dir: Path, data_dir: Path, command: str, controls: bool = True
) -> Json:
    """Probe the disentangled network in `run_dir`, over images or pins; write leakage.json there.

    `controls` adds an untrained network and shuffled labels.

    Raises `UserError` if the network or the data set is missing or damaged, there is no shear code,
    or the network learnt from other data or is not trained to the end.
    """
    network = load_code_network(Path(run_dir) / DISENTANGLED)
    check_origin(experiment, DISENTANGLED, run_dir)
    networks = {"": network}
    if controls:
        networks[UNTRAINED] = network.draw_new_weights(SEED)
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    splits = read_splits(experiment, examples, data_dir, networks)
    train, test = splits["train"], splits["test"]
    rows = _probe_all(train, test)
    pairs = product(("pose", "slide"), CODES)
    results = {
        "experiment": experiment.name,
        "simulated": experiment.paired.is_simulated,
        "metric": METRIC,
        "rows": rows,
        "summary": [_summarise(rows, pair, test.poses) for pair in pairs],
        "independence": measure_independence(test, rows),
        "scores": _compute_standard_scores(train, test, rows),
        "exchanged": measure_exchange_errors(network, examples.reader),
        "slide": estimate_slides(
            {name: _join_codes(split) for name, split in splits.items()}, test.batch
        ),
        "slides": {"learnt": len(train.poses), "tested": len(test.poses)},
        "sizes": {code: int(test.features[code].shape[1]) for code in CODES},
        **read_training_facts(run_dir, experiment.networks),
        **describe_provenance(command),
    }
    for row in rows:
        del row["estimate"]
    write_json(Path(run_dir) / "leakage.json", results)
    return results


def probe_quantity(
    codes: Sequence[np.ndarray], quantity: np.ndarray, true: np.ndarray, groups: np.ndarray
) -> Estimate:
    """Estimate one quantity from a code by every family; return the errors of the best.

    `codes` are those of training slides (N, F) and test slides (M, F). `quantity` (N, K) and `true`
    (M, K) have two columns for an angle over the full circle. `groups` (N,) are training poses.
    """
    train_codes, test_codes = codes
    task = prepare_task(train_codes, quantity, test_codes, groups)
    scatter = np.sum(np.square(true - true.mean(axis=0)), axis=1)
    squares = {
        name: np.sum(np.square(task.unscale(fit(task)) - true), axis=1)
        for name, fit in FAMILIES.items()
    }
    families = {name: compute_r2(errors, scatter) for name, errors in squares.items()}
    best = max(families, key=families.__getitem__)
    return Estimate(best, squares[best], scatter, families)


def _probe_all(train: ProbeSplit, test: ProbeSplit) -> list[Json]:
    """Return a row for each quantity and code, with controls if there are untrained codes."""
    shuffled = np.random.default_rng(SEED).permutation(len(train.poses))
    rows = []
    for (what, quantity), labels in train.quantities.items():
        true = test.quantities[what, quantity]

        def probe(name: str, labels: np.ndarray = labels, true: np.ndarray = true) -> Estimate:
            codes = train.features[name], test.features[name]
            return probe_quantity(codes, labels, true, train.poses)

        estimates = {name: probe(name) for name in ("pins", *CODES)}
        # a code is a function of the input, so what a code shows the input shows, too
        ceiling = max(estimate.r2 for estimate in estimates.values())
        for code in CODES:
            row = _make_row((what, code), quantity, estimates[code], test.poses)
            row["ceiling"] = ceiling if ceiling >= MIN_CEILING else None
            if UNTRAINED + code in train.features:
                row["untrained"] = probe(UNTRAINED + code).r2
                row["shuffled"] = probe(code, labels[shuffled]).r2
            rows.append(row)
    return rows


def _make_row(pair: tuple[str, str], quantity: str, estimate: Estimate, poses: np.ndarray) -> Json:
    what, code = pair
    return {
        "name": f"{quantity} from {code}",
        "what": what,
        "code": code,
        "quantity": quantity,
        "leak": pair in LEAKS,
        "r2": estimate.r2,
        "r2 interval": _bootstrap_r2([estimate], poses),
        "family": estimate.family,
        "families": estimate.families,
        "estimate": estimate,
    }


def _summarise(rows: Sequence[Json], pair: tuple[str, str], poses: np.ndarray) -> Json:
    """Average the rows of one part of the contact, "pose" or "slide", and one code.

    Quantities without a ceiling are named, and left out.
    """
    what, code = pair
    probed = [row for row in rows if (row["what"], row["code"]) == pair]
    visible = [row for row in probed if row["ceiling"] is not None]
    summary = {
        "name": f"{what} from {code}",
        "leak": pair in LEAKS,
        "quantities": [row["quantity"] for row in visible],
        "without a ceiling": [row["quantity"] for row in probed if row["ceiling"] is None],
    }
    for name in ("r2", "ceiling", "untrained", "shuffled"):
        if visible and name in visible[0]:
            summary[name] = float(np.mean([row[name] for row in visible]))
    if visible:
        shares = [max(row["r2"], 0) / row["ceiling"] for row in visible]
        summary["r2 interval"] = _bootstrap_r2([row["estimate"] for row in visible], poses)
        summary["share"] = float(np.mean(shares))
        summary["largest share"] = max(shares)
    return summary


def _compute_standard_scores(
    train: ProbeSplit, test: ProbeSplit, rows: Sequence[Json]
) -> dict[str, float]:
    """Compute MIG, SAP and DCI by block over the quantities with a ceiling, on whitened codes."""
    visible = sorted({(row["what"], row["quantity"]) for row in rows if row["ceiling"] is not None})
    if {what for what, _ in visible} != set(OWNERS):
        return {}
    whitenings = {code: fit_whitening(train.features[code]) for code in OWNERS.values()}
    train_blocks = _make_blocks(whitenings, train, visible)
    test_blocks = _make_blocks(whitenings, test, visible)
    dci = score_dci(train_blocks, test_blocks)
    return {
        "MIG": score_mig(train_blocks),
        "SAP": score_sap(train_blocks, test_blocks),
        **{f"DCI {name}": value for name, value in dci.items()},
    }


def _make_blocks(
    whitenings: Mapping[str, Whitening], split: ProbeSplit, visible: Sequence[Quantity]
) -> Blocks:
    white = [whitening.apply(split.features[code]) for code, whitening in whitenings.items()]
    factors = [split.quantities[quantity] for quantity in visible]
    owners = [list(OWNERS).index(what) for what, _ in visible]
    return Blocks(
        np.concatenate(white, axis=1),
        np.repeat([0, 1], [code.shape[1] for code in white]),
        np.concatenate(factors, axis=1),
        np.repeat(owners, [factor.shape[1] for factor in factors]),
    )


def _join_codes(split: ProbeSplit) -> CodedSlides:
    codes = np.concatenate([split.features["z_p"], split.features["z_s"]], axis=1)
    return CodedSlides(codes, split.select_slides(), split.poses)


def _bootstrap_r2(estimates: Sequence[Estimate], poses: np.ndarray) -> list[float]:
    """Compute the 95 % interval of the mean R2 over resampled poses."""
    resampled = []
    for estimate in estimates:
        values = {"squares": estimate.squares, "scatter": estimate.scatter}
        means = resample_means(values, poses, SEED)
        resampled.append(1 - means["squares"] / means["scatter"])
    return compute_interval(np.mean(resampled, axis=0))
