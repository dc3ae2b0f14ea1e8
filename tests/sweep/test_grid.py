"""Cells, rows and shared trainings: equal ones are one, and different ones are not."""

from dataclasses import replace
from functools import reduce

import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import list_field_types, replace_field
from jaxunshear.config.rules import validate
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.sweep import Sweep, check_sweep
from jaxunshear.errors import UserError
from jaxunshear.fit import BASE_EXPERIMENT as RECORDED
from jaxunshear.sweep.grid import compute_row_digest, find_reference, list_cells, list_rows

BASE = Experiment(name="plain", claim="none")
PLAIN = Sweep(name="plain", claim="none", base=BASE)
SPLIT = (("unshear.pose_channels", "unshear.shear_channels"), ((8, 120), (64, 64)))


def test_a_grid_has_every_value_with_every_other():
    sweep = replace(PLAIN, grid=(("train.losses.patch", (0.0, 0.1, 1.0)), SPLIT), seeds=(0, 3))
    cells = list_cells(sweep)
    assert [cell.label for cell in cells[:3]] == [
        "patch=0.0, pose_channels:shear_channels=8:120",
        "patch=0.0, pose_channels:shear_channels=64:64",
        "patch=0.1, pose_channels:shear_channels=8:120",
    ]
    assert cells[2].point == ("0.1", "8:120")
    assert cells[2].experiment == replace(
        BASE,
        train=replace(BASE.train, losses={**BASE.train.losses, "patch": 0.1}),
        unshear=replace(BASE.unshear, pose_channels=8, shear_channels=120),
    )
    rows = list_rows(sweep, cells)
    assert len(rows) == len({row.digest for row in rows.values()}) == 12
    for (label, seed), row in rows.items():
        validate(row.experiment)  # its name can be that of a folder
        assert (row.label, row.experiment.seed) == (label, seed)
        assert row.experiment.name.endswith(f"-{row.digest}")


def test_short_names_are_dotted_where_two_would_be_the_same():
    sweep = replace(
        PLAIN, grid=(("train.batch", (4,)), ("train_posenet.batch", (8,)), ("train.l1", (0.0,)))
    )
    assert list_cells(sweep)[0].label == "train.batch=4, train_posenet.batch=8, l1=0.0"


def test_a_long_label_still_makes_a_folder():
    fields = ("blur_px", "noise", "brightness", "drift_px", "drift_brightness")
    names = tuple(f"paired.nuisance.{name}" for name in fields)
    row = ((names, (0.5, 0.125, 0.125, 0.125, 0.125)),)
    sweep = replace(PLAIN, rows=(row,), seeds=(2**31 - 1,))
    (row,) = list_rows(sweep, list_cells(sweep)).values()
    assert row.experiment.name.endswith(f"_seed-2147483647-{row.digest}") and len(row.label) > 75
    validate(row.experiment)


def test_equal_rows_are_one():
    sweep = replace(
        PLAIN,
        grid=(("train.losses.patch", (0.1, 1, 1.0)),),
        rows=((("train.batch", 16),), (("train.batch", 16),), (("train.losses.patch", 1.0),)),
    )
    assert BASE.train.batch == 16 and BASE.train.losses["patch"] == 0.1
    cells = list_cells(sweep)
    labels = ["patch=0.1", "patch=1", "patch=1.0", "batch=16"]
    assert [cell.label for cell in cells] == labels
    digests = [row.digest for row in list_rows(sweep, cells).values()]
    assert digests[0] == digests[3] and digests[1] == digests[2] and len(set(digests)) == 2


def test_rows_can_be_given_labels():
    rows = ((("train.batch", 4),), ())
    sweep = replace(PLAIN, rows=rows, labels=("small batch", "as it is"))
    cells = list_cells(sweep)
    assert [cell.label for cell in cells] == ["small batch", "as it is"]
    assert cells[0].experiment.train.batch == 4
    assert find_reference(sweep, cells) == "as it is"
    refused = {("one",): "one for each of the 2 rows", ("a", "a"): "twice", ("a", 1): "texts"}
    for labels, line in refused.items():
        with pytest.raises(UserError, match=line):
            check_sweep(replace(sweep, labels=labels), "file.py")


def test_different_cells_of_one_label_are_refused():
    sensors = (TACTIP_331, replace(TACTIP_331, rings=8))
    with pytest.raises(UserError, match="both called 'sensor=tactip331'"):
        list_cells(replace(PLAIN, grid=(("sensor", sensors),)))


def _value(base: Experiment, name: str) -> object:
    return reduce(lambda value, part: getattr(value, part, None), name.split("."), base)


@pytest.mark.parametrize(
    ("base", "other"), [(BASE, "paired.tap_folder"), (RECORDED, "paired.stimuli")]
)
def test_every_setting_decides_the_digest_but_names_and_order(base, other):
    digest = compute_row_digest(base, False)
    renamed = replace(base, name="x", claim="y", networks=base.networks[::-1])
    assert digest == compute_row_digest(renamed, False)
    assert digest != compute_row_digest(base, True)
    assert _value(base, other) is None
    change = {bool: lambda v: not v, int: lambda v: v + 1, float: lambda v: v + 0.5}
    change[str] = lambda v: v + "x"
    for name, kind in list_field_types().items():
        value = _value(base, name)
        if name in ("name", "claim", "sensor") or value is None:  # None: of the other kind of data
            continue
        changed = change[kind](value) if kind in change else ("x",)
        assert compute_row_digest(replace_field(base, name, changed), False) != digest, name


def test_the_reference_is_the_cell_of_the_bases_own_values():
    sweep = replace(PLAIN, grid=(("train.losses.patch", (0.0, 0.1, 1.0)),))
    assert find_reference(sweep, list_cells(sweep)) == "patch=0.1"
    off = replace(PLAIN, grid=(("train.losses.patch", (0.0, 1.0)),))
    assert find_reference(off, list_cells(off)) is None
    named = replace(off, reference="patch=1.0")
    assert find_reference(named, list_cells(named)) == "patch=1.0"
    assert find_reference(PLAIN, list_cells(PLAIN)) is None
