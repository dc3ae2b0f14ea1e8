"""Measure leakage: pose in the shear code and slide in the pose code, by probes on held-out poses.

    results = measure_leakage(experiment, Path("runs/demo"), Path("datasets"), command)

Each quantity is probed by itself, by every family of `probes`. The result is the largest R2 over
the families, which errs towards a leak. Its ceiling is the largest R2 that the same families reach
from the pins of the network's input, or from either code. Quantities that the input does not show
have no ceiling; they are named, and left out of means. A slide is given in the sensor's frame.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import DISENTANGLED
from jaxunshear.evaluation.codes import load_code_network, measure_exchange_errors
from jaxunshear.evaluation.intervals import INTERVALS_OVER, compute_interval, resample_means
from jaxunshear.evaluation.probe_data import ProbeSplit, Quantity, estimate_slides, read_splits
from jaxunshear.evaluation.probes import (
    FAMILIES,
    Whitening,
    compute_r2,
    fit_whitening,
    prepare_task,
)
from jaxunshear.files import Json, write_json
from jaxunshear.metrics.disentanglement import Blocks, compute_hsic, score_dci, score_mig, score_sap
from jaxunshear.results.provenance import describe_provenance, read_training_facts
from jaxunshear.selection import select_evenly
from jaxunshear.text_table import format_text_table
from jaxunshear.training.examples import open_examples
from jaxunshear.training.provenance import check_origin

MIN_CEILING = 0.1  # R2 from the input: below it the input does not show a quantity
SEED = 0
MAX_COMPARED = 500  # poses, in the criterion of independence
PLANTED = 0.01  # deviation of a planted leak, in shares of the code's widest direction
DECODED_UNITS = {"rms_grey": "of 1 in grey", "rms_px": "px"}  # of images and pins
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
        "slide": estimate_slides(splits),
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
    rows: list[Json] = []
    for (what, quantity), labels in train.quantities.items():
        true = test.quantities[what, quantity]

        def probe(name: str, labels: np.ndarray = labels, true: np.ndarray = true) -> Estimate:
            codes = train.features[name], test.features[name]
            return probe_quantity(codes, labels, true, train.poses)

        estimates = {name: probe(name) for name in ("pins", *CODES)}
        # a code is a function of the input, so what a code shows the input shows, too
        ceiling = max(estimate.r2 for estimate in estimates.values())
        for code in CODES:
            estimate = estimates[code]
            row = {
                "name": f"{quantity} from {code}",
                "what": what,
                "code": code,
                "quantity": quantity,
                "leak": (what, code) in LEAKS,
                "r2": estimate.r2,
                "r2 interval": _bootstrap_r2([estimate], test.poses),
                "family": estimate.family,
                "families": estimate.families,
                "estimate": estimate,
                "ceiling": ceiling if ceiling >= MIN_CEILING else None,
            }
            if UNTRAINED + code in train.features:
                row["untrained"] = probe(UNTRAINED + code).r2
                row["shuffled"] = probe(code, labels[shuffled]).r2
            rows.append(row)
    return rows


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


def _bootstrap_r2(estimates: Sequence[Estimate], poses: np.ndarray) -> list[float]:
    resampled = []
    for estimate in estimates:
        values = {"squares": estimate.squares, "scatter": estimate.scatter}
        means = resample_means(values, poses, SEED)
        resampled.append(1 - means["squares"] / means["scatter"])
    return compute_interval(np.mean(resampled, axis=0))


def measure_independence(test: ProbeSplit, rows: Sequence[Json]) -> list[Json]:
    """Test each leak for independence, on one slide at each pose: rows are independent draws.

    The planted leak shows the test's power: codes of other contacts, which know nothing, with the
    quantity hidden in a direction of PLANTED of the code's spread. If the test does not find it, a
    large p means nothing.
    """
    first = np.unique(test.poses, return_index=True)[1]
    chosen = first[select_evenly(len(first), MAX_COMPARED)]
    shuffled = np.random.default_rng(SEED).permutation(chosen)
    results: list[Json] = []
    for row in [row for row in rows if row["leak"] and row["ceiling"] is not None]:
        code = test.features[row["code"]]
        quantity = test.quantities[row["what"], row["quantity"]][chosen]
        statistic, p = compute_hsic(fit_whitening(code).apply(code[chosen]), quantity, SEED)
        hidden = PLANTED * code.std(axis=0).max() * quantity / max(quantity.std(), 1e-12)
        planted = np.concatenate([code[shuffled], hidden], axis=1)
        _, planted_p = compute_hsic(fit_whitening(planted).apply(planted), quantity, SEED)
        results.append(
            {
                "name": f"{row['quantity']} and {row['code']}",
                "hsic": statistic,
                "p": p,
                "planted p": planted_p,
                "poses": len(chosen),
            }
        )
    return results


def build_sweep_rows(results: Json) -> list[Json]:
    """Build the rows of a sweep's ablation."""
    rows = [_select(row, DECODED_UNITS) for row in _list_exchange_rows(results)]
    for row in results["summary"]:
        if row["quantities"]:
            rows.append(_select(row, ("r2", "ceiling", "share", "largest share")))
    rows += [{"name": row["name"], "r2": row["r2"]} for row in results["rows"]]
    rows.append({"name": "standard scores", **results["scores"]})
    for row in results["slide"]:
        rows.append(
            _select(row, ("mae", "rmse", "coverage")) | {"name": f"{row['name']}, {row['part']}"}
        )
    return rows


def _select(row: Json, names: Iterable[str]) -> Json:
    return {name: row[name] for name in ("name", *names) if name in row}


def format_table(results: Json) -> str:
    """Format the results for people."""
    rows = []
    for row in results["rows"]:
        figures = {name: row.get(name) for name in ("ceiling", "untrained", "shuffled")}
        head = {"R2 of": row["name"], "code [95 %]": _format_with_interval(row, "r2")}
        kind = "a leak" if row["leak"] else ""
        rows.append(head | {"strongest": row["family"], **figures, "kind": kind})
    lines = [format_text_table(rows, tuple(rows[0]))]
    for row in results["summary"]:
        if row["quantities"]:
            share, largest = row["share"], row["largest share"]
            lines.append(
                f"{row['name']}: {share:.0%} of the ceiling on average, {largest:.0%} at most"
            )
        if row["without a ceiling"]:
            hidden = ", ".join(row["without a ceiling"])
            lines.append(f"{row['name']}: the input does not show {hidden}: left out")
    for row in results["independence"]:
        lines.append(
            f"{row['name']}: HSIC {row['hsic']:.4f} of 1, p = {row['p']:.3f} of independence, "
            f"{row['planted p']:.3f} of a planted leak; {row['poses']} poses"
        )
    for name, value in results["scores"].items():
        lines.append(f"{name} by block: {value:.3f}")
    for row in _list_exchange_rows(results):
        name = next(name for name in DECODED_UNITS if name in row)
        error = _format_with_interval(row | {f"{name} interval": row["interval"]}, name)
        lines.append(
            f"{row['name']}: {error} {DECODED_UNITS[name]} "
            "from the contact of that pose and that slide"
        )
    for row in results["slide"]:
        mae, coverage = _format_with_interval(row, "mae"), _format_with_interval(row, "coverage")
        lines.append(
            f"{row['name']} from both codes, {row['part']} ({row['slides']}): error {mae}; "
            f"95 % intervals hold {coverage}"
        )
    return "\n".join([*lines, results["metric"]])


def _format_with_interval(row: Json, name: str) -> str:
    return "{:.3g} [{:.3g}, {:.3g}]".format(row[name], *row[f"{name} interval"])


def _list_exchange_rows(results: Json) -> list[Json]:
    errors = results["exchanged"]
    if not errors:
        return []
    rows = []
    for part in (errors, *errors["by slip"]):
        end = f", {part['part']}" if "part" in part else ""
        for name, row in part["drawn"].items():
            rows.append({"name": f"DS, codes {name}{end}", **row})
    return rows
