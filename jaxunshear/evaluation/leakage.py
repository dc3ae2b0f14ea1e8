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

import jax
import numpy as np

from jaxunshear.config.experiment import Experiment, get_recorded
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.errors import UserError
from jaxunshear.evaluation.bootstrap import INTERVALS_OVER, compute_interval, resample_means
from jaxunshear.evaluation.code_exchange import measure_exchange_errors
from jaxunshear.evaluation.codes import Encode, make_encoder
from jaxunshear.evaluation.leakage_scores import compute_standard_scores, measure_independence
from jaxunshear.evaluation.probe_data import (
    MAX_TESTED,
    ProbeSplit,
    read_labelled_slides,
    read_slides,
    read_splits,
)
from jaxunshear.evaluation.probes import FAMILIES
from jaxunshear.evaluation.slide_estimation import estimate_slides, is_slipping
from jaxunshear.files import Json, write_json
from jaxunshear.metrics.independence import compute_r2
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.models.modality import get_modality
from jaxunshear.models.registry import init_like
from jaxunshear.results.training_summaries import read_training_facts
from jaxunshear.training.checkpoint import check_finished, load_best, read_net
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.examples import Examples, open_examples

MIN_CEILING = 0.1  # R2 from the input: below it the input does not show a quantity
SEED = 0
CODES = ("z_s", "z_p")
METRIC = (
    "R2 on test poses of the family of probes that finds most; share: R2 over its ceiling, the "
    f"most that the input's pins or a code give; brackets: 95 % over {INTERVALS_OVER}"
)
LEAKS = (("pose", "z_s"), ("slide", "z_p"))  # what a code should not contain


class Estimate(NamedTuple):
    """Errors of the family that estimates a quantity best."""

    family: str
    squares: np.ndarray  # (M,) squared error
    scatter: np.ndarray  # (M,) squared distance from the mean
    families: dict[str, float]  # R2 of every family

    @property
    def r2(self) -> float:
        return self.families[self.family]


class _SplitCodes(NamedTuple):
    """Codes (N, F) by name of training slides and of test slides."""

    train: Mapping[str, np.ndarray]
    test: Mapping[str, np.ndarray]

    def get_pair(self, code: str) -> tuple[np.ndarray, np.ndarray]:
        return self.train[code], self.test[code]


def measure_leakage(
    experiment: Experiment, run_dir: Path, data_dir: Path, command: str, controls: bool = True
) -> Json:
    """Probe the disentangled network in `run_dir`, over images or pins; write leakage.json there.

    `controls` adds an untrained network and shuffled labels.

    Raises `UserError` if the network or the data set is missing or damaged, there is no shear code,
    or the network learnt from other data or is not trained to the end.
    """
    folder = Path(run_dir) / DISENTANGLED
    check_finished(folder)
    net, variables = read_net(folder), load_best(folder)
    check_origin(experiment, DISENTANGLED, run_dir)
    encode = make_encoder(net, variables)
    if encode is None:
        raise UserError(
            f"{folder} holds no network with a shear code: there is nothing to leak from"
        )
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    train, test = read_splits(experiment, examples, data_dir)
    codes = _SplitCodes(encode(train.inputs), encode(test.inputs))
    untrained = None
    if controls:
        encode_untrained = make_encoder(net, init_like(net, variables, jax.random.key(SEED)))
        assert encode_untrained is not None
        untrained = _SplitCodes(encode_untrained(train.inputs), encode_untrained(test.inputs))
    rows = _probe_all(codes, untrained, train, test)
    results = {
        "experiment": experiment.name,
        "simulated": get_recorded(experiment) is None,
        "metric": METRIC,
        "rows": rows,
        "summary": [
            _summarise(rows, pair, test.poses) for pair in product(("pose", "slide"), CODES)
        ],
        "independence": measure_independence(codes.test, test, rows),
        "scores": compute_standard_scores(codes, train, test, rows),
        "exchanged": measure_exchange_errors(net, variables, examples.reader),
        "slide": _estimate_slides(experiment, examples, encode, train, test),
        "slides": {"learnt": len(train.poses), "tested": len(test.poses)},
        "sizes": {code: int(codes.test[code].shape[1]) for code in CODES},
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
    scatter = np.sum(np.square(true - true.mean(axis=0)), axis=1)
    squares = {
        name: np.sum(np.square(probe(codes[0], quantity, codes[1], groups) - true), axis=1)
        for name, probe in FAMILIES.items()
    }
    families = {name: compute_r2(errors, scatter) for name, errors in squares.items()}
    best = max(families, key=families.__getitem__)
    return Estimate(best, squares[best], scatter, families)


def _probe_all(
    codes: _SplitCodes, untrained: _SplitCodes | None, train: ProbeSplit, test: ProbeSplit
) -> list[Json]:
    """Return a row for each quantity and code, with controls if there are `untrained` codes."""
    shuffled = np.random.default_rng(SEED).permutation(len(train.poses))
    rows = []
    for what in ("pose", "slide"):
        for quantity, labels in train.quantities[what].items():
            true = test.quantities[what][quantity]
            inputs = {"pins": (train.pins, test.pins)}
            inputs |= {code: codes.get_pair(code) for code in CODES}
            estimates = {
                name: probe_quantity(pair, labels, true, train.poses)
                for name, pair in inputs.items()
            }
            # a code is a function of the input, so what a code shows the input shows, too
            ceiling = max(estimate.r2 for estimate in estimates.values())
            for code in CODES:
                row = _make_row(what, code, quantity, estimates[code], test.poses)
                row["ceiling"] = ceiling if ceiling >= MIN_CEILING else None
                if untrained is not None:
                    pair = untrained.get_pair(code)
                    row["untrained"] = probe_quantity(pair, labels, true, train.poses).r2
                    pair = inputs[code]
                    row["shuffled"] = probe_quantity(pair, labels[shuffled], true, train.poses).r2
                rows.append(row)
    return rows


def _make_row(what: str, code: str, quantity: str, estimate: Estimate, poses: np.ndarray) -> Json:
    return {
        "name": f"{quantity} from {code}",
        "what": what,
        "code": code,
        "quantity": quantity,
        "leak": (what, code) in LEAKS,
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


def _estimate_slides(
    experiment: Experiment,
    examples: Examples,
    encode: Encode,
    train: ProbeSplit,
    test: ProbeSplit,
) -> list[Json]:
    """Estimate the slide from both codes together, in mm and deg, with intervals."""
    validation = read_labelled_slides(experiment, examples.reader, "validation", MAX_TESTED)
    inputs = (train.inputs, validation[get_modality(experiment).sheared], test.inputs)
    codes = [np.concatenate(list(encode(each).values()), axis=1) for each in inputs]
    slides = [
        train.quantities["slide"],
        read_slides(examples.slides, validation),
        test.quantities["slide"],
    ]
    slipped = None
    if "stuck" in test.batch:
        slipped = is_slipping(test.batch["stuck"], test.batch["slipping"])
    return estimate_slides(codes, slides, train.poses, test.poses, slipped)


def _bootstrap_r2(estimates: Sequence[Estimate], poses: np.ndarray) -> list[float]:
    """Compute the 95 % interval of the mean R2 over resampled poses."""
    resampled = []
    for estimate in estimates:
        values = {"squares": estimate.squares, "scatter": estimate.scatter}
        means = resample_means(values, poses, SEED)
        resampled.append(1 - means["squares"] / means["scatter"])
    return compute_interval(np.mean(resampled, axis=0))
