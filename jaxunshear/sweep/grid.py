"""The cells of a sweep (points of its grid) and its rows (cells with a seed).

A digest of all that decides its numbers identifies a row, so equal rows are one, in the grid and on
disk. Trainings, which several rows may share, have such a digest too. Imports no JAX.
"""

import dataclasses
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass

from jaxunshear.config.configs import compute_digest
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import format_value, replace_field
from jaxunshear.config.network_config import NetworkConfig
from jaxunshear.config.networks import DISENTANGLED, list_networks
from jaxunshear.config.rules import validate
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import (
    Change,
    Fields,
    Sweep,
    Value,
    get_base,
    list_changed_fields,
    list_fields,
    list_varied_fields,
)
from jaxunshear.errors import UserError

MAX_NAME_LENGTH = 90  # of a folder, before its digest
Changes = tuple[Change, ...]


@dataclass(frozen=True)
class Cell:
    """One point of the grid, or one explicit row, over all seeds."""

    label: str  # "patch=0.1, pose_channels:shear_channels=8:120"; "base" if nothing changes
    point: tuple[str, ...] | None  # printed values along the axes; None outside the grid
    changes: Changes
    experiment: Experiment  # with the base's seed


@dataclass(frozen=True)
class Row:
    """One experiment to be run: `experiment.name` is the row's folder."""

    label: str  # of the first of its cells
    digest: str
    experiment: Experiment


def list_cells(sweep: Sweep) -> list[Cell]:
    """List the grid, the last axis fastest, then the explicit rows; each cell once.

    Raises `UserError` if a cell cannot be run, or two different cells have the same label.
    """
    cells: dict[str, Cell] = {}

    def add_cell(label: str | None, point: tuple[str, ...] | None, changes: Changes) -> None:
        changed = ", ".join(
            f"{format_field_name(fields, sweep)}={format_value_label(fields, value)}"
            for fields, value in changes
        )
        label = label or changed or "base"
        cell = Cell(label, point, changes, _apply_changes(sweep, changes, label))
        if cells.setdefault(label, cell).experiment != cell.experiment:
            raise UserError(
                f"sweep {sweep.name}: two different cells are both called '{label}': name their "
                "sensors and outlines apart"
            )

    names = [fields for fields, _ in sweep.grid]
    if sweep.grid or not sweep.rows:
        for values in itertools.product(*(values for _, values in sweep.grid)):
            changes = tuple(zip(names, values, strict=True))
            add_cell(None, tuple(itertools.starmap(format_value_label, changes)), changes)
    for given, row in itertools.zip_longest(sweep.labels, sweep.rows):
        add_cell(given, None, row)
    return list(cells.values())


def list_rows(sweep: Sweep, cells: list[Cell]) -> dict[tuple[str, int], Row]:
    """List the row of each (cell's label, seed); cells of equal settings share their rows."""
    rows: dict[tuple[str, int], Row] = {}
    by_digest: dict[str, Row] = {}
    for cell, seed in itertools.product(cells, sweep.seeds):
        networks = tuple(
            network for network in list_networks() if network in cell.experiment.networks
        )
        experiment = dataclasses.replace(cell.experiment, seed=seed, networks=networks)
        digest = compute_row_digest(experiment, sweep.ablation)
        words = re.sub(r"[^A-Za-z0-9._]+", "-", cell.label.replace(", ", "_"))
        name = f"{words[: MAX_NAME_LENGTH - len(f'_seed-{seed}')]}_seed-{seed}-{digest}"
        row = Row(cell.label, digest, dataclasses.replace(experiment, name=name))
        rows[cell.label, seed] = by_digest.setdefault(digest, row)
    return rows


def compute_row_digest(experiment: Experiment, ablation: bool) -> str:
    """Compute the digest of what decides a row's numbers; names and claims do not."""
    networks = tuple(sorted(experiment.networks))
    anonymous = dataclasses.replace(experiment, name="", claim="", networks=networks)
    version = experiment.paired.version
    settings = {"experiment": to_json(anonymous), "ablation": ablation, "data": version}
    return compute_digest(settings)


def format_training_name(config: NetworkConfig) -> str:
    return f"{config.name}_seed-{config.seed}-{config.digest}"


def find_reference(sweep: Sweep, cells: list[Cell]) -> str | None:
    """Find the label of the cell that others are compared with.

    Without `sweep.reference` it is the cell with the base's own values; None if there is none.
    """
    if sweep.reference is not None:
        if all(cell.label != sweep.reference for cell in cells):
            labels = "; ".join(f"'{cell.label}'" for cell in cells[:4])
            raise UserError(
                f"sweep {sweep.name}: there is no cell '{sweep.reference}' for sweep.reference: "
                f"use one of {labels}{'; ...' if len(cells) > 4 else ''}"
            )
        return sweep.reference
    if len(cells) < 2:
        return None
    digest = compute_row_digest(get_base(sweep), sweep.ablation)
    for cell in cells:
        if compute_row_digest(cell.experiment, sweep.ablation) == digest:
            return cell.label
    return None


def format_field_name(fields: Fields, sweep: Sweep) -> str:
    """Format `batch`, `train.batch` if a sweep varies another batch, or `batch:epochs`."""
    varied = {*list_varied_fields(sweep), *list_changed_fields(sweep)}
    shorts = [name.rpartition(".")[2] for name in varied]
    names = [(name, name.rpartition(".")[2]) for name in list_fields(fields)]
    return ":".join(short if shorts.count(short) == 1 else name for name, short in names)


def format_value_label(fields: Fields, value: Value) -> str:
    """Format a value, such as `8:120` for fields that vary together."""
    return ":".join(format_value(part) for _, part in split_change(fields, value))


def split_change(fields: Fields, value: Value) -> Iterator[tuple[str, Value]]:
    """Yield each field that a change sets, with its own value."""
    return zip(list_fields(fields), (value,) if isinstance(fields, str) else value, strict=True)


def _apply_changes(sweep: Sweep, changes: Changes, label: str) -> Experiment:
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
            f"cell {label}: sweep.ablation needs the network 'disentangled': only its codes can be "
            "swapped"
        )
    return experiment
