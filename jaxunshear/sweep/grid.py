"""From a sweep to its cells (points of the grid) and rows (a cell with a seed), each a valid experiment of its own.

A row is known by a digest of all that decides its numbers, so equal rows are one, in the grid and on disk; so is a training,
which several rows may share. Imports no JAX.
"""

import dataclasses
import hashlib
import itertools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest

from jaxunshear.config.configs import VERSION, convert_to_floats
from jaxunshear.config.data import PairingMethod, PoseData, Recorded
from jaxunshear.config.experiment import (
    Experiment,
    drop_pair_losses,
    get_recorded,
    list_required_networks,
    uses_pins,
)
from jaxunshear.config.fields import format_value, replace_field
from jaxunshear.config.networks import (
    drop_codes,
    drop_direct,
    drop_pin_codes,
    drop_rotation,
)
from jaxunshear.config.registry import (
    ALL_NETWORKS,
    DISENTANGLED,
    POSENET_SHEARED,
    POSENETS,
    REGISTRY,
    RENDERER,
    TAP_NETWORKS,
)
from jaxunshear.config.rules import validate
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import Axis, Change, Fields, Sweep, Value, get_base, list_fields
from jaxunshear.errors import UserError
from jaxunshear.files import Json

MAX_NAME_LENGTH = 90  # of a folder, before its digest
# what is trained and tested beside a training is not for it
TEST_SETTINGS = ("networks", "unseen", "other_jitters_mm", "other_twists_deg", "other_tilts_deg")
UNUSED_WITH_TEACHER = ("train_posenet",)


@dataclass(frozen=True)
class Cell:
    """One point of the grid, or one explicit row, over all seeds."""

    label: str  # "patch=0.1, pose_channels:shear_channels=8:120"; "base" where nothing is changed
    point: tuple[str, ...] | None  # printed values along the axes; None beside the grid
    changes: tuple[Change, ...]
    experiment: Experiment  # with the base's seed


@dataclass(frozen=True)
class Row:
    """One experiment to be run: `experiment.name` is the row's folder."""

    label: str  # of the first of its cells
    digest: str
    experiment: Experiment


def list_cells(sweep: Sweep) -> list[Cell]:
    """The grid in the order of its axes, the last one fastest, then the explicit rows; repeated ones once.

    Raises `UserError` for a cell that no run could work with, and for two different ones of the same label.
    """
    cells: dict[str, Cell] = {}
    for given, point, changes in _changes(sweep):
        reported = ", ".join(
            f"{format_field_name(fields, sweep)}={format_value_label(fields, value)}"
            for fields, value in changes
        )
        label = given or reported or "base"
        cell = Cell(label, point, changes, _apply_changes(sweep, changes, label))
        if label in cells and cells[label].experiment != cell.experiment:
            raise UserError(
                f"sweep {sweep.name}: two different cells are both called '{label}': name their sensors and outlines apart"
            )
        cells.setdefault(label, cell)
    return list(cells.values())


def list_rows(sweep: Sweep, cells: list[Cell]) -> dict[tuple[str, int], Row]:
    """The row of each (cell's label, seed). Cells of equal settings share their rows."""
    rows: dict[tuple[str, int], Row] = {}
    made: dict[str, Row] = {}
    for cell, seed in itertools.product(cells, sweep.seeds):
        networks = tuple(network for network in ALL_NETWORKS if network in cell.experiment.networks)
        experiment = dataclasses.replace(cell.experiment, seed=seed, networks=networks)
        own = compute_row_digest(experiment, sweep.ablation)
        words = re.sub(r"[^A-Za-z0-9._]+", "-", cell.label.replace(", ", "_"))
        name = f"{words[: MAX_NAME_LENGTH - len(f'_seed-{seed}')]}_seed-{seed}-{own}"
        made.setdefault(own, Row(cell.label, own, dataclasses.replace(experiment, name=name)))
        rows[cell.label, seed] = made[own]
    return rows


def compute_row_digest(experiment: Experiment, ablation: bool) -> str:
    """Eight hexadecimal digits of all that decides a row's numbers; names, claims and the networks' order do not."""
    networks = tuple(sorted(experiment.networks))
    full = dataclasses.replace(experiment, name="", claim="", networks=networks)
    return _digest({"experiment": to_json(full), "ablation": ablation})


def select_training_part(experiment: Experiment, network: str) -> Experiment:
    """`experiment` with all that the training of `network` does not depend on set to a default, its name to that of the part.

    Rows with equal parts share that training.
    """
    plain = Experiment(name="", claim="")
    unused: tuple[str, ...] = ("name", "claim", *TEST_SETTINGS)
    # recordings: one set for taps and slides; pins: one training for all networks
    if not get_recorded(experiment) and not uses_pins(experiment):
        taught = len(list_required_networks(experiment, network)) > 1
        unused += UNUSED_WITH_TEACHER if taught else REGISTRY[network].unused_groups
    part = dataclasses.replace(experiment, **{field: getattr(plain, field) for field in unused})
    if uses_pins(experiment) and network in (*POSENETS, RENDERER):
        part = dataclasses.replace(
            part,
            train_pins=drop_pair_losses(part.train_pins, supervised=1.0),
            pins=drop_pin_codes(part.pins),
        )
    if isinstance(part.pose, PoseData) and network in TAP_NETWORKS:  # these learn from taps alone
        part = dataclasses.replace(part, paired=plain.paired)
    if isinstance(part.paired, Recorded) and network in TAP_NETWORKS:
        part = dataclasses.replace(part, paired=dataclasses.replace(part.paired, labelled=1.0))
    if isinstance(part.paired, Recorded) and network in (
        *POSENETS,
        RENDERER,
    ):  # and none of these from pairs
        dragged = (
            network == POSENET_SHEARED and part.paired.pairing == "simulated"
        )  # it learns from simulated slides
        way: PairingMethod = "simulated" if dragged else "rendered"
        alone = dataclasses.replace(part.paired, pairing=way, pairs="", unlabelled="left_out")
        part = dataclasses.replace(part, paired=alone)
    if network in TAP_NETWORKS:
        part = dataclasses.replace(part, pins=drop_rotation(part.pins))
    if POSENET_SHEARED not in list_required_networks(experiment, network):
        part = _without_direct(part)
    if REGISTRY[network].role == "unshears" and not REGISTRY[network].has_codes:
        part = dataclasses.replace(part, unshear=drop_codes(part.unshear))
    own = _digest({"experiment": to_json(part), "network": network})
    return dataclasses.replace(part, name=f"{network}_seed-{experiment.seed}-{own}")


def _without_direct(part: Experiment) -> Experiment:
    """Return `part` with what only posenet_sheared reads at its default."""
    part = dataclasses.replace(part, pins=drop_direct(part.pins))
    if isinstance(part.paired, Recorded):
        part = dataclasses.replace(
            part, paired=dataclasses.replace(part.paired, direct_taps="none")
        )
    return part


def find_reference(sweep: Sweep, cells: list[Cell]) -> str | None:
    """Label of the cell that others are compared with: the one named, else that of the base's own values, else None."""
    if sweep.reference is not None:
        if all(cell.label != sweep.reference for cell in cells):
            raise UserError(
                f"sweep {sweep.name}: there is no cell '{sweep.reference}' for sweep.reference: {_some(cells)}"
            )
        return sweep.reference
    own = compute_row_digest(get_base(sweep), sweep.ablation)
    equal = (
        cell.label for cell in cells if compute_row_digest(cell.experiment, sweep.ablation) == own
    )
    return next(equal, None) if len(cells) > 1 else None


def list_axis_values(axis: Axis) -> tuple[str, ...]:
    """The printed values along an axis, repeated ones once."""
    fields, values = axis
    return tuple(dict.fromkeys(format_value_label(fields, value) for value in values))


def format_field_name(fields: Fields, sweep: Sweep) -> str:
    """`patch`, or `pose_channels:shear_channels`; dotted where the sweep varies two fields of one name."""
    varied = {name for fields, _ in sweep.grid for name in list_fields(fields)}
    varied |= {name for row in sweep.rows for fields, _ in row for name in list_fields(fields)}
    shorts = [name.rpartition(".")[2] for name in varied]
    parts = ((name, name.rpartition(".")[2]) for name in list_fields(fields))
    return ":".join(short if shorts.count(short) == 1 else name for name, short in parts)


def format_value_label(fields: Fields, value: Value) -> str:
    """`8:120` for fields that vary together."""
    return ":".join(format_value(part) for _, part in split_change(fields, value))


def split_change(fields: Fields, value: Value) -> Iterator[tuple[str, Value]]:
    """Each field that a change sets, with its own value."""
    return zip(list_fields(fields), (value,) if isinstance(fields, str) else value, strict=True)


def _changes(
    sweep: Sweep,
) -> Iterator[tuple[str | None, tuple[str, ...] | None, tuple[Change, ...]]]:
    """The label that was given, if one was; the point on the grid, if it lies there; what is changed."""
    names = [fields for fields, _ in sweep.grid]
    if sweep.grid or not sweep.rows:
        for values in itertools.product(*(values for _, values in sweep.grid)):
            changes = tuple(zip(names, values, strict=True))
            yield (
                None,
                tuple(format_value_label(fields, value) for fields, value in changes),
                changes,
            )
    for label, row in zip_longest(sweep.labels, sweep.rows):
        yield label, None, row


def _apply_changes(sweep: Sweep, changes: tuple[Change, ...], label: str) -> Experiment:
    experiment = get_base(sweep)
    for fields, value in changes:
        for name, part in split_change(fields, value):
            experiment = replace_field(experiment, name, part)
    try:
        validate(experiment)
    except UserError as error:
        raise UserError(f"cell {label}: {error}") from error
    if sweep.ablation and DISENTANGLED not in experiment.networks:
        raise UserError(
            f"cell {label}: sweep.ablation needs the network 'disentangled': only its codes can be swapped"
        )
    return experiment


def _digest(thing: Json) -> str:
    text = json.dumps(convert_to_floats(thing) | {"data": VERSION}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _some(cells: list[Cell]) -> str:
    labels = [f"'{cell.label}'" for cell in cells]
    return "use one of " + "; ".join(labels[:4]) + ("; ..." if len(labels) > 4 else "")
