"""Tests of independence and standard scores of the codes, in addition to the probes."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxunshear.evaluation.probe_data import ProbeSplit
from jaxunshear.evaluation.probes import Whitening, fit_whitening
from jaxunshear.files import Json
from jaxunshear.metrics.disentanglement import Blocks, score_dci, score_mig, score_sap
from jaxunshear.metrics.independence import compute_hsic
from jaxunshear.selection import select_evenly

SEED = 0
MAX_COMPARED = 500  # poses, in the criterion of independence
PLANTED = 0.01  # deviation of a planted leak, in shares of the code's widest direction


def measure_independence(
    codes: Mapping[str, np.ndarray], test: ProbeSplit, rows: Sequence[Json]
) -> list[Json]:
    """Test each leak for independence, on one slide at each pose: rows are independent draws.

    The planted leak shows the test's power: codes of other contacts, which know nothing, with the
    quantity hidden in a direction of PLANTED of the code's spread. If the test does not find it, a
    large p means nothing.
    """
    first = np.unique(test.poses, return_index=True)[1]
    chosen = first[select_evenly(len(first), MAX_COMPARED)]
    shuffled = np.random.default_rng(SEED).permutation(chosen)
    results = []
    for row in rows:
        if not row["leak"] or row["ceiling"] is None:
            continue
        code, quantity = codes[row["code"]], test.quantities[row["what"]][row["quantity"]][chosen]
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


def compute_standard_scores(
    codes: Sequence[Mapping[str, np.ndarray]],
    train: ProbeSplit,
    test: ProbeSplit,
    rows: Sequence[Json],
) -> dict[str, float]:
    """Compute MIG, SAP and DCI by block over the quantities with a ceiling, on whitened codes.

    `codes` are those of training slides and of test slides, by name.
    """
    visible = sorted({(row["what"], row["quantity"]) for row in rows if row["ceiling"] is not None})
    if {what for what, _ in visible} != {"pose", "slide"}:
        return {}
    train_codes, test_codes = codes
    whitenings = {name: fit_whitening(train_codes[name]) for name in ("z_p", "z_s")}
    train_blocks = _make_blocks(whitenings, train_codes, train, visible)
    test_blocks = _make_blocks(whitenings, test_codes, test, visible)
    dci = score_dci(train_blocks, test_blocks)
    return {
        "MIG": score_mig(train_blocks),
        "SAP": score_sap(train_blocks, test_blocks),
        **{f"DCI {name}": value for name, value in dci.items()},
    }


def _make_blocks(
    whitenings: Mapping[str, Whitening],
    codes: Mapping[str, np.ndarray],
    split: ProbeSplit,
    visible: Sequence[tuple[str, str]],
) -> Blocks:
    """Make blocks of z_p, which should hold the pose, and z_s, which should hold the slide."""
    white = [whitening.apply(codes[name]) for name, whitening in whitenings.items()]
    factors = [split.quantities[what][quantity] for what, quantity in visible]
    owners = [int(what == "slide") for what, _ in visible]
    return Blocks(
        np.concatenate(white, axis=1),
        np.repeat([0, 1], [code.shape[1] for code in white]),
        np.concatenate(factors, axis=1),
        np.repeat(owners, [factor.shape[1] for factor in factors]),
    )
