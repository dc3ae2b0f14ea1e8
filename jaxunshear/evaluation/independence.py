"""Test leaks of the codes for independence, in addition to the probes."""

from collections.abc import Sequence

import numpy as np

from jaxunshear.evaluation.probe_data import ProbeSplit
from jaxunshear.evaluation.probes import fit_whitening
from jaxunshear.files import Json
from jaxunshear.metrics.independence import compute_hsic
from jaxunshear.selection import select_evenly

SEED = 0
MAX_COMPARED = 500  # poses, in the criterion of independence
PLANTED = 0.01  # deviation of a planted leak, in shares of the code's widest direction


def measure_independence(test: ProbeSplit, rows: Sequence[Json]) -> list[Json]:
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
