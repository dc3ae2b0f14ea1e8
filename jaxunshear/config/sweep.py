"""What a sweep file holds: a base experiment, what is varied in it, and over which seeds.

>>> file = "experiments/ablations/lambda_split.py"
>>> check_sweep(override_base(load_sweep(file), ["--train.epochs", "1"]), file)
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from jaxunshear.config.data import MAX_SEED
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields, parse_overrides, replace_field
from jaxunshear.config.load import load_variable
from jaxunshear.config.rules import validate
from jaxunshear.config.types import Problem, Value, check_types, is_of_type, list_hints
from jaxunshear.errors import UserError

Fields = str | tuple[str, ...]  # a dotted name, or several of fields that vary together
Axis = tuple[Fields, tuple[Value, ...]]
Change = tuple[Fields, Value]
FORMS = {  # what is said of fields of another type
    "name": "is no text",
    "claim": "is no text",
    "base": "is no Experiment",
    "grid": 'is no tuple of axes ("field", (value, value)) '
    'or (("field", "field"), ((value, value), (value, value)))',
    "rows": 'is no tuple of rows (("field", value), ("field", value))',
    "labels": "is no tuple of texts",
    "seeds": f"(or --seeds) is no tuple of integers from 0 to {MAX_SEED}",
    "ablation": "is neither True nor False",
    "reference": "is no text",
}


@dataclass(frozen=True)
class Sweep:
    """A sweep: `jaxunshear sweep FILE` reads the variable `sweep` of FILE.

    An axis is ("train.losses.patch", (0.0, 0.1)) or, for fields that vary together,
    (("unshear.pose_channels", "unshear.shear_channels"), ((8, 120), (64, 64))). A row is a tuple of
    such pairs with one value each: (("train.batch", 4), ("train.epochs", 2.0)). Without axes and
    rows, the base alone is run with every seed. Results go to <out>/<name>/.
    """

    name: str
    claim: str
    base: Experiment
    grid: tuple[Axis, ...] = ()  # every value of each axis with every value of the others
    rows: tuple[tuple[Change, ...], ...] = ()  # in addition to the grid
    labels: tuple[str, ...] = ()  # of the rows; empty: each is labelled by its changes
    seeds: tuple[int, ...] = (0,)
    networks: tuple[str, ...] | None = None  # trained in each row; None: those of the base
    ablation: bool = False  # whether decoders are also tested with corrupted codes
    # label of the cell to compare with; None: that with the values of the base
    reference: str | None = None


def load_sweep(path: str | Path) -> Sweep:
    """Load the sweep that a Python file defines; an ordinary experiment becomes a sweep of seeds.

    Its form and its types are checked, its values are not yet. Raises UserError.
    """
    loaded = load_variable(path, sweep=Sweep, experiment=Experiment)
    if isinstance(loaded, Sweep):
        _check_form(loaded, str(path))
        check_types(loaded.base)
        return loaded
    check_types(loaded)
    return Sweep(name=loaded.name, claim=loaded.claim, base=loaded, seeds=(loaded.seed,))


def override_base(sweep: Sweep, argv: Sequence[str]) -> Sweep:
    """Replace fields of the base by `--name value`; `--name` itself names the sweep.

    A field that rows change keeps their values in those rows. Raises UserError for a field that an
    axis varies.
    """
    for name, value in parse_overrides(argv):
        for field in list_varied_fields(sweep):
            if f"{field}.".startswith(f"{name}.") or name.startswith(f"{field}."):
                raise UserError(
                    f"--{name}: sweep {sweep.name} varies {field}; "
                    "change its values in the file instead"
                )
        if name == "seed":
            raise UserError("--seed: a sweep has several; use --seeds 0,1,2")
        if name in ("name", "claim", "networks"):
            sweep = dataclasses.replace(sweep, **{name: value})
    return dataclasses.replace(sweep, base=override_fields(sweep.base, argv))


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse `0,1,2`. Raises UserError."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--seeds takes integers separated by commas, not '{text}'") from None


def get_base(sweep: Sweep) -> Experiment:
    """Return the base with the networks of the sweep."""
    if sweep.networks is None:
        return sweep.base
    return dataclasses.replace(sweep.base, networks=sweep.networks)


def list_fields(fields: Fields) -> tuple[str, ...]:
    return (fields,) if isinstance(fields, str) else fields


def list_varied_fields(sweep: Sweep) -> list[str]:
    return [field for fields, _ in sweep.grid for field in list_fields(fields)]


def list_changed_fields(sweep: Sweep) -> list[str]:
    changes = [change for row in sweep.rows for change in row]
    return [field for fields, _ in changes for field in list_fields(fields)]


def check_sweep(sweep: Sweep, source: str) -> None:
    """Raise UserError, naming `source` and field, for a bad sweep; rows are checked later."""
    _check_form(sweep, source)
    if sweep.base.paired.has_parts:
        raise UserError(f"{source} is about several tasks: a sweep takes one")
    validate(dataclasses.replace(get_base(sweep), name=sweep.name))
    for field in (*list_varied_fields(sweep), *list_changed_fields(sweep)):
        replace_field(sweep.base, field, None)  # raises UserError for an unknown name


def _check_form(sweep: Sweep, source: str) -> None:
    problems = chain(_find_type_problems(sweep), _find_axis_problems(sweep), _find_doubles(sweep))
    for field, remedy in problems:
        raise UserError(f"{source}: sweep.{field} {remedy}")


def _find_type_problems(sweep: Sweep) -> Iterator[Problem]:
    hints = list_hints(Sweep)
    for field, remedy in FORMS.items():
        if not is_of_type(getattr(sweep, field), hints[field]):
            yield field, remedy
    if not all(sweep.labels):
        yield "labels", FORMS["labels"]
    if not sweep.seeds or not all(0 <= seed <= MAX_SEED for seed in sweep.seeds):
        yield "seeds", FORMS["seeds"]


def _find_axis_problems(sweep: Sweep) -> Iterator[Problem]:
    for fields, values in sweep.grid:
        if not values:
            yield "grid", f"lists no values for {fields}: give a tuple of some"
    changes = [("grid", fields, value) for fields, values in sweep.grid for value in values]
    changes += [("rows", fields, value) for row in sweep.rows for fields, value in row]
    for place, fields, value in changes:
        if not fields:
            yield place, FORMS[place]
        has_each = isinstance(value, tuple) and len(value) == len(fields)
        if not (isinstance(fields, str) or has_each):
            yield place, f"needs tuples of a value each for {fields}"
        for field in list_fields(fields):
            if field == "seed":
                yield place, "varies seed: list the seeds in sweep.seeds, or with --seeds"
            if field in ("name", "claim"):
                yield place, f"varies {field}, which decides nothing"


def _find_doubles(sweep: Sweep) -> Iterator[Problem]:
    varied = list_varied_fields(sweep)
    if repeated := [field for field in varied if varied.count(field) > 1]:
        yield "grid", f"varies {repeated[0]} on two axes"
    if len(sweep.labels) not in (0, len(sweep.rows)):
        yield "labels", f"needs one for each of the {len(sweep.rows)} rows, or none"
    if len(set(sweep.labels)) < len(sweep.labels):
        yield "labels", "lists one twice"
    if len(set(sweep.seeds)) < len(sweep.seeds):
        yield "seeds", "(or --seeds) lists a seed twice"
