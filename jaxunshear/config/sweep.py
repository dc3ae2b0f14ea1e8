"""What a sweep file holds: a base experiment, what is varied in it, and over which seeds.

>>> sweep = load_sweep("experiments/ablations/lambda_split.py")
>>> check_sweep(override_base(sweep, ["--train.epochs", "1"]), "experiments/ablations/lambda_split.py")
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxunshear.config.data import MAX_SEED
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields, parse_overrides, replace_field
from jaxunshear.config.load import load_variable
from jaxunshear.config.registry import Network
from jaxunshear.config.rules import validate
from jaxunshear.config.types import Rule, Value, check_types
from jaxunshear.errors import UserError

Fields = str | tuple[str, ...]  # dotted names; several vary together
Axis = tuple[Fields, tuple[Value, ...]]
Change = tuple[Fields, Value]


@dataclass(frozen=True)
class Sweep:
    """`jaxunshear sweep FILE` reads the variable `sweep` of FILE. Results go to <out>/<name>/.

    An axis is ("train.losses.patch", (0.0, 0.1)) or, of fields that vary together,
    (("unshear.pose_channels", "unshear.shear_channels"), ((8, 120), (64, 64))). A row is a tuple of such pairs with one
    value each: (("train.batch", 4), ("train.epochs", 2.0)). Without either, the base alone is run with every seed.
    """

    name: str
    claim: str
    base: Experiment
    grid: tuple[Axis, ...] = ()  # every value of each axis with every value of the others
    rows: tuple[tuple[Change, ...], ...] = ()  # beside the grid
    labels: tuple[str, ...] = ()  # of the rows; without them each is called by its changes
    seeds: tuple[int, ...] = (0,)
    networks: tuple[Network, ...] | None = None  # trained in each row; None: those of the base
    ablation: bool = False  # whether the decoders are fed spoilt codes, too
    # label of the cell to compare with; None: that of the base's own values
    reference: str | None = None


def load_sweep(path: str | Path) -> Sweep:
    """The sweep that a Python file defines; of an ordinary experiment file, that experiment, to be run with several seeds.

    Its form and its types are checked, its values are not yet. Raises `UserError`.
    """
    found = load_variable(path, sweep=Sweep, experiment=Experiment)
    if isinstance(found, Sweep):
        _check_form(found, str(path))
        check_types(found.base)
        return found
    check_types(found)
    return Sweep(name=found.name, claim=found.claim, base=found, seeds=(found.seed,))


def override_base(sweep: Sweep, argv: Sequence[str]) -> Sweep:
    """`sweep` with fields of its base replaced by `--name value`; `--name` itself names the sweep.

    Raises `UserError` for a field that an axis varies; one that some rows change is theirs in those rows.
    """
    varied = [field for fields, _ in sweep.grid for field in list_fields(fields)]
    for name, value in parse_overrides(argv):
        taken = next(
            (
                field
                for field in varied
                if f"{field}.".startswith(f"{name}.") or name.startswith(f"{field}.")
            ),
            None,
        )
        if taken:
            raise UserError(
                f"--{name}: sweep {sweep.name} varies {taken}; change its values in the file instead"
            )
        if name == "seed":
            raise UserError("--seed: a sweep has several; use --seeds 0,1,2")
        if name in ("name", "claim", "networks"):
            sweep = dataclasses.replace(sweep, **{name: value})
    return dataclasses.replace(sweep, base=override_fields(sweep.base, argv))


def parse_seeds(text: str) -> tuple[int, ...]:
    """`0,1,2` as numbers. Raises `UserError`."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--seeds takes integers separated by commas, not '{text}'") from None


def get_base(sweep: Sweep) -> Experiment:
    """The base with the networks of the sweep."""
    return (
        sweep.base
        if sweep.networks is None
        else dataclasses.replace(sweep.base, networks=sweep.networks)
    )


def list_fields(fields: Fields) -> tuple[str, ...]:
    """The fields that an axis or a change sets."""
    return (fields,) if isinstance(fields, str) else fields


def check_sweep(sweep: Sweep, source: str) -> None:
    """Refuses, naming the file `source` and the field, a sweep that cannot be laid out. Its rows are checked one by one."""
    _check_form(sweep, source)
    validate(dataclasses.replace(get_base(sweep), name=sweep.name))
    for fields in (
        *(fields for fields, _ in sweep.grid),
        *(fields for row in sweep.rows for fields, _ in row),
    ):
        for field in list_fields(fields):
            replace_field(sweep.base, field, None)  # refuses unknown names


def _check_form(sweep: Sweep, source: str) -> None:
    for ok, name, complaint in _rules(sweep):
        if not ok:
            raise UserError(f"{source}: sweep.{name} {complaint}")


def _rules(sweep: Sweep) -> Iterator[Rule]:
    yield Rule(isinstance(sweep.name, str), "name", "is no text")
    yield Rule(isinstance(sweep.claim, str), "claim", "is no text")
    yield Rule(
        isinstance(sweep.base, Experiment),
        "base",
        f"is of type {type(sweep.base).__name__}, not Experiment",
    )
    yield Rule(
        isinstance(sweep.grid, tuple) and all(_is_change(axis) for axis in sweep.grid),
        "grid",
        'is no tuple of axes ("field", (value, value)) or (("field", "field"), ((value, value), (value, value)))',
    )
    for fields, values in sweep.grid:
        yield Rule(
            isinstance(values, tuple) and len(values) > 0,
            "grid",
            f"lists no values for {fields}: give a tuple of some",
        )
        yield Rule(
            all(_suits(fields, value) for value in values),
            "grid",
            f"needs tuples of a value each for {fields}",
        )
    yield Rule(
        isinstance(sweep.rows, tuple)
        and all(isinstance(row, tuple) and all(map(_is_change, row)) for row in sweep.rows),
        "rows",
        'is no tuple of rows (("field", value), ("field", value))',
    )
    yield Rule(
        isinstance(sweep.labels, tuple)
        and all(isinstance(label, str) and label for label in sweep.labels),
        "labels",
        "is no tuple of texts",
    )
    yield Rule(
        len(sweep.labels) in (0, len(sweep.rows)),
        "labels",
        f"needs one for each of the {len(sweep.rows)} rows, or none",
    )
    yield Rule(len(set(sweep.labels)) == len(sweep.labels), "labels", "lists one twice")
    for fields, value in (change for row in sweep.rows for change in row):
        yield Rule(_suits(fields, value), "rows", f"needs a tuple of a value each for {fields}")
    varied = [field for fields, _ in sweep.grid for field in list_fields(fields)]
    twice = next((field for field in varied if varied.count(field) > 1), None)
    yield Rule(twice is None, "grid", f"varies {twice} on two axes")
    changed = [field for row in sweep.rows for fields, _ in row for field in list_fields(fields)]
    for place, field in (
        *(("grid", field) for field in varied),
        *(("rows", field) for field in changed),
    ):
        yield Rule(field not in ("name", "claim"), place, f"varies {field}, which decides nothing")
        yield Rule(
            field != "seed", place, "varies seed: list the seeds in sweep.seeds, or with --seeds"
        )
    seeds = sweep.seeds
    yield Rule(
        isinstance(seeds, tuple)
        and len(seeds) > 0
        and all(
            isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed <= MAX_SEED
            for seed in seeds
        ),
        "seeds",
        f"(or --seeds) is no tuple of integers from 0 to {MAX_SEED}",
    )
    yield Rule(len(set(seeds)) == len(seeds), "seeds", "(or --seeds) lists a seed twice")
    yield Rule(isinstance(sweep.ablation, bool), "ablation", "is neither True nor False")
    yield Rule(
        sweep.reference is None or isinstance(sweep.reference, str),
        "reference",
        "is no label of a cell",
    )


def _is_change(pair: object) -> bool:
    if not isinstance(pair, tuple) or len(pair) != 2:
        return False
    fields = pair[0]
    several = (
        isinstance(fields, tuple)
        and len(fields) > 0
        and all(isinstance(field, str) for field in fields)
    )
    return isinstance(fields, str) or several


def _suits(fields: Fields, value: Value) -> bool:
    return isinstance(fields, str) or (isinstance(value, tuple) and len(value) == len(fields))
