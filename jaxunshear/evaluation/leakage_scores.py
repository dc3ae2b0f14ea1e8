"""Tests of independence and standard scores of the codes, beside the probes."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxunshear.evaluation.probe_data import ProbeSplit
from jaxunshear.evaluation.probes import fit_whitening
from jaxunshear.files import Json
from jaxunshear.metrics.disentanglement import Blocks, score_dci, score_mig, score_sap
from jaxunshear.metrics.independence import compute_hsic
from jaxunshear.selection import select_evenly

SEED = 0
MOST_COMPARED = 500  # poses, in the criterion of independence
PLANTED = 0.01  # deviation of a planted leak, in shares of the code's widest direction


def measure_independence(
    codes: Mapping[str, np.ndarray], test: ProbeSplit, rows: Sequence[Json]
) -> list[Json]:
    """Test each leak for independence, one slide at each pose: rows are independent draws.

    The planted leak shows the test's power: codes of other contacts, which know nothing, with the
    quantity hidden in a direction of PLANTED of the code's spread. A test that does not find it says
    nothing by a large p.
    """
    first = np.unique(test.poses, return_index=True)[1]
    chosen = first[select_evenly(len(first), MOST_COMPARED)]
    shuffled = np.random.default_rng(SEED).permutation(chosen)
    found = []
    for row in rows:
        if not row["leak"] or row["ceiling"] is None:
            continue
        code, quantity = codes[row["code"]], test.quantities[row["what"]][row["quantity"]][chosen]
        statistic, p = compute_hsic(fit_whitening(code).apply(code[chosen]), quantity, SEED)
        hidden = PLANTED * code.std(axis=0).max() * quantity / max(quantity.std(), 1e-12)
        planted = np.concatenate([code[shuffled], hidden], axis=1)
        _, power = compute_hsic(fit_whitening(planted).apply(planted), quantity, SEED)
        name = f"{row['quantity']} and {row['code']}"
        found.append(
            {"name": name, "hsic": statistic, "p": p, "planted p": power, "poses": len(chosen)}
        )
    return found


def compute_standard_scores(
    codes: Sequence[Mapping[str, np.ndarray]],
    train: ProbeSplit,
    test: ProbeSplit,
    rows: Sequence[Json],
) -> dict[str, float]:
    """Return MIG, SAP and DCI by block over the quantities with a ceiling, on whitened codes."""
    asked = {(row["what"], row["quantity"]) for row in rows if row["ceiling"] is not None}
    if {what for what, _ in asked} != {"pose", "slide"}:
        return {}
    whitenings = {name: fit_whitening(codes[0][name]) for name in ("z_p", "z_s")}
    sizes = [whitening.directions.shape[1] for whitening in whitenings.values()]
    blocks = []
    for split, encoded in zip((train, test), codes, strict=True):
        factors = [(int(w == "slide"), split.quantities[w][q]) for w, q in sorted(asked)]
        blocks.append(
            Blocks(
                np.concatenate(
                    [whitenings[name].apply(encoded[name]) for name in whitenings], axis=1
                ),
                np.repeat([0, 1], sizes),
                np.concatenate([values for _, values in factors], axis=1),
                np.concatenate([np.full(values.shape[1], owner) for owner, values in factors]),
            )
        )
    dci = {f"DCI {name}": value for name, value in score_dci(*blocks).items()}
    return {"MIG": score_mig(blocks[0]), "SAP": score_sap(*blocks), **dci}
