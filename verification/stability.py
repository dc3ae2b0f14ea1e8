"""Contacts and networks at their extremes: solved, refused or given up, never wrong.

    rows = run_stability()
    select_failed(rows)

Each contact is solved as a user would (`auto`, again at a stronger level where that does not
converge), and twice more, in float32 and in float64, to a tolerance so small that how the solver
stops is no part of the difference. Networks are judged in `stability_networks.py`.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.progress import Progress
from jaxunshear.simulator.contacts import Contacts
from jaxunshear.simulator.level import LEVELS
from jaxunshear.text_table import format_text_table
from verification import stability_networks
from verification.contact_case import Case
from verification.contact_cases import list_cases
from verification.network_trainings import list_training_cases
from verification.network_values import list_value_cases
from verification.pin_distance import PinError, compute_pin_error
from verification.selection import select_names
from verification.stability_networks import NetworkCase, NetworkRow

PRECISION_PX = 0.05  # by which float32 and float64, or two ways to the same contact, may differ
# a solution that calls itself converged and is further (rms) from the tight one is wrong
SILENT_PX = 1.0
# the first at which both precisions converge is used
TIGHT = tuple(
    replace(LEVELS["auto"], tolerance=tolerance, limit=3000)
    for tolerance in (0.005, 0.015, 0.02, 0.03)
)
SOLVED, RETRIED, REFUSED = "solved", "solved at a stronger level", "refused"
UNSOLVED = "given up: not converged"  # and it says so: whoever uses contacts drops and counts it
UNCOMPARED = "solved, with no tight solution to compare with"
PROMISED = (SOLVED, RETRIED, REFUSED, UNSOLVED, UNCOMPARED)


@dataclass(frozen=True)
class StabilityRow:
    """The outcome of one case; NaN where nothing was measured."""

    case: str
    outcome: str
    # finite, or refused by name; in float32 as in float64; and not converged only if it says so
    holds: bool
    finite: bool | None = None
    converged: bool | None = None
    residual_mm: float = np.nan
    float_px: float = np.nan  # tight float32 against tight float64: largest of any pin
    twin_px: float = np.nan  # tight, against the other way to the same contact: largest
    # auto against tight float64, or the reference where that does not converge: rms over the pins
    tight_px: float = np.nan
    iterations: int = 0
    nodes: int = 0
    ms: float = np.nan  # of auto, once compiled
    said: str = ""  # the complaint of what was refused


AnyCase = Case | NetworkCase
AnyRow = StabilityRow | NetworkRow


def run_stability(
    only: Sequence[str] = (), cases: Sequence[AnyCase] | None = None
) -> Sequence[AnyRow]:
    """Run all cases, or those whose name contains one of the words `only`.

    Raises `UserError` for a word that no name contains.
    """
    if cases is None:
        cases = [*list_cases(), *list_training_cases(), *list_value_cases()]
    selected = set(select_names([case.name for case in cases], only))
    rows = []
    with Progress("stability", len(selected), unit="cases") as progress:
        for case in cases:
            if case.name in selected:
                rows.append(examine_case(case))
                progress.advance(1)
    return rows


def select_failed(rows: Sequence[AnyRow]) -> Sequence[AnyRow]:
    """Select the rows that break the promise."""
    return [row for row in rows if not row.holds]


def examine_case(case: AnyCase) -> AnyRow:
    """Run and judge one case; an exception is a judgement too, and the other cases still run."""
    if isinstance(case, NetworkCase):
        return stability_networks.examine(case)
    try:
        return _examine(case)
    except Exception as error:
        return StabilityRow(case.name, "crashed", False, said=f"{type(error).__name__}: {error}")


def _examine(case: Case) -> StabilityRow:
    try:
        contacts = case.solve("auto", True)
    except UserError as error:
        return _judge_refusal(case, str(error))
    if case.refused is not None:
        return StabilityRow(case.name, f"not refused: {case.refused} is senseless", False)
    start = time.perf_counter()
    case.solve("auto", True)
    row = StabilityRow(
        case.name,
        SOLVED,
        True,
        bool(np.isfinite(contacts.pins).all()),
        bool(contacts.converged.all()),
        float(np.max(contacts.residual_mm)),
        iterations=int(np.max(contacts.iterations)),
        nodes=int(np.max(contacts.nodes)),
        ms=1e3 * (time.perf_counter() - start),
    )
    if not row.finite or not row.converged:
        outcome = UNSOLVED if row.finite else "not finite"
        return replace(row, outcome=outcome, holds=outcome in PROMISED)
    for level in TIGHT:
        narrow = case.solve(replace(level, precision="float32"), False)
        wide = case.solve(replace(level, precision="float64"), False)
        if narrow.converged.all() and wide.converged.all():
            break
    row = replace(row, float_px=_compare(case, narrow, wide).max_px)
    if not wide.converged.all():
        wide = case.solve("reference", False)
    row = replace(row, tight_px=_compare(case, contacts, wide).rms_px)
    if case.twin is not None:
        row = replace(row, twin_px=_compare(case, case.twin(level, False), narrow).max_px)
    outcome = _judge_solution(row, bool(contacts.retried.any()), case.twin is not None)
    return replace(row, outcome=outcome, holds=outcome in PROMISED)


def _compare(case: Case, some: Contacts, others: Contacts) -> PinError:
    """Compare pins; the error is NaN if either solution has not converged."""
    if not (some.converged.all() and others.converged.all()):
        return PinError(*(np.nan,) * 5)
    return compute_pin_error(case.sensor, some.pins, others.pins)


def _judge_solution(row: StabilityRow, retried: bool, twin: bool) -> str:
    if row.tight_px > SILENT_PX:
        return "converged to something else"
    if row.float_px > PRECISION_PX:
        return "float32 is too coarse"
    if row.twin_px > PRECISION_PX:
        return "differs from its twin"
    if np.isnan(row.float_px) or np.isnan(row.tight_px) or (twin and np.isnan(row.twin_px)):
        return UNCOMPARED
    return RETRIED if retried else SOLVED


def _judge_refusal(case: Case, said: str) -> StabilityRow:
    outcome, holds = REFUSED, True
    if case.refused is None:
        outcome, holds = "refused, though it can be solved", False
    elif case.refused not in said or "\n" in said:
        outcome, holds = f"refused by a line that does not name '{case.refused}'", False
    return StabilityRow(case.name, outcome, holds, said=said)


def as_dicts(rows: Sequence[AnyRow]) -> list[Json]:
    return [asdict(row) for row in rows]


def format_table(rows: Sequence[AnyRow]) -> str:
    """Format a line per case, then what went wrong and how to run it again.

    Contacts come first, then networks.
    """
    parts = []
    kinds = (
        (StabilityRow, "contacts", PROMISED),
        (NetworkRow, "networks", stability_networks.PROMISED),
    )
    for kind, title, promised in kinds:
        selected = [row for row in rows if isinstance(row, kind)]
        if not selected:
            continue
        columns = [field.name for field in fields(kind) if field.name not in ("outcome", "holds")]
        measured = [
            {name: value for name, value in asdict(row).items() if value == value}  # not NaN
            for row in selected
        ]
        parts.append(format_text_table(measured, [*columns, "outcome"]))
        for row in selected:
            if not row.holds or row.outcome == UNSOLVED:
                again = f"python -m verification stability --only {row.case!r}"
                verdict = "GIVEN UP" if row.holds else "FAILED"
                parts.append(f"{verdict}: {row.case}: {row.outcome}\n  again: {again}")
        outcomes = Counter(row.outcome for row in selected)
        counted = ", ".join(f"{outcomes[outcome]} {outcome}" for outcome in promised)
        broken = len(select_failed(selected))
        parts.append(f"{len(selected)} cases of {title}: {counted}; {broken} break the promise")
    return "\n\n".join(parts)
