"""Cells, rows and shared trainings: equal ones are one, and different ones are not."""

from dataclasses import fields, replace
from functools import reduce

import numpy as np
import pytest

from jaxunshear import run
from jaxunshear.config.experiment import Experiment, list_required_networks, list_trained_networks
from jaxunshear.config.fields import list_field_types, replace_field
from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.registry import ALL_NETWORKS, RENDERER, TEACHER, TRAINABLE
from jaxunshear.config.rules import validate
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.sweep import Sweep, check_sweep
from jaxunshear.errors import UserError
from jaxunshear.fit import BASE_EXPERIMENT as RECORDED
from jaxunshear.sweep.grid import (
    compute_row_digest,
    find_reference,
    list_cells,
    list_rows,
    select_training_part,
)
from jaxunshear.training.data_origin import describe_origin

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
        assert (
            row.experiment.seed == seed
            and row.label == label
            and row.experiment.name.endswith(f"-{row.digest}")
        )


def test_short_names_are_dotted_where_two_would_be_the_same():
    sweep = replace(
        PLAIN, grid=(("train.batch", (4,)), ("train_posenet.batch", (8,)), ("train.l1", (0.0,)))
    )
    assert list_cells(sweep)[0].label == "train.batch=4, train_posenet.batch=8, l1=0.0"


def test_a_long_label_still_makes_a_folder():
    names = tuple(
        f"paired.nuisance.{name}"
        for name in ("blur_px", "noise", "brightness", "drift_px", "drift_brightness")
    )
    sweep = replace(
        PLAIN, rows=(((names, (0.5, 0.125, 0.125, 0.125, 0.125)),),), seeds=(2**31 - 1,)
    )
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
    assert [cell.label for cell in cells] == [
        "patch=0.1",
        "patch=1",
        "patch=1.0",
        "batch=16",
    ]
    digests = [row.digest for row in list_rows(sweep, cells).values()]
    assert digests[0] == digests[3] and digests[1] == digests[2] and len(set(digests)) == 2


def test_rows_can_be_given_labels():
    rows = ((("train.batch", 4),), ())
    sweep = replace(PLAIN, rows=rows, labels=("small batch", "as it is"))
    cells = list_cells(sweep)
    assert [cell.label for cell in cells] == ["small batch", "as it is"]
    assert cells[0].experiment.train.batch == 4
    assert find_reference(sweep, cells) == "as it is"
    for labels, line in (
        (("one",), "one for each of the 2 rows"),
        (("a", "a"), "twice"),
        (("a", 1), "texts"),
    ):
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
    assert digest == compute_row_digest(
        replace(base, name="x", claim="y", networks=base.networks[::-1]), False
    )
    assert digest != compute_row_digest(base, True)
    assert _value(base, other) is None
    for name, kind in list_field_types():
        value = _value(base, name)
        if name in ("name", "claim", "sensor") or value is None:  # None: of the other kind of data
            continue
        changing = {
            bool: lambda v: not v,
            int: lambda v: v + 1,
            float: lambda v: v + 0.5,
            str: lambda v: v + "x",
        }.get(kind)
        changed = changing(value) if changing else ("x",)
        assert compute_row_digest(replace_field(base, name, changed), False) != digest, name


def test_the_reference_is_the_cell_of_the_bases_own_values():
    sweep = replace(PLAIN, grid=(("train.losses.patch", (0.0, 0.1, 1.0)),))
    assert find_reference(sweep, list_cells(sweep)) == "patch=0.1"
    off = replace(PLAIN, grid=(("train.losses.patch", (0.0, 1.0)),))
    assert find_reference(off, list_cells(off)) is None
    named = replace(off, reference="patch=1.0")
    assert find_reference(named, list_cells(named)) == "patch=1.0"
    assert find_reference(PLAIN, list_cells(PLAIN)) is None


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """What `run_stages` asks of a training: its arguments, but for the folder."""
    from jaxunshear.training import examples, trainer

    def asked_of(experiment: Experiment, network: str) -> dict:
        calls = []

        class Reader:
            def __init__(self, *opened):
                self.opened = opened

            def train_batches(self, *words):
                calls.append(words)
                return lambda start: iter(())

            def split(self, *words):
                return iter([{name: np.zeros((1, 1)) for name in words[2]}])

            def length(self, split):
                return 10

        def train(task, training, data, seed, folder, provenance):
            list(data.batches(0))
            learnt = (task.kind, task.net, task.targets, task.weights)
            fields = [sorted(batch) for batch in data.validation()]
            calls.append((learnt, training, seed, fields, data.epoch_images, provenance))
            return trainer.TrainingSummary(
                steps=1,
                parameters=1,
                best_step=1,
                best_loss=1.0,
                train_seconds=1.0,
                images_per_second=1.0,
            )

        monkeypatch.setattr(examples, "open_set", lambda *words: calls.append(words) or Reader())
        monkeypatch.setattr(trainer, "train", train)
        run.run_stages(
            experiment, (network,), tmp_path / str(len(list(tmp_path.iterdir()))), tmp_path, "none"
        )
        return {"calls": calls}

    return asked_of


@pytest.mark.parametrize("network", [network for network in TRAINABLE if network != RENDERER])
def test_equal_parts_are_equal_trainings(asked, network):
    """A part needs the same training as its experiment, so rows with one part may share it."""
    full = Experiment(
        name="full",
        claim="none",
        seed=5,
        networks=ALL_NETWORKS,
        unseen=("flower",),
        targets=("yaw_deg", "y_mm"),
        sensor=replace(TACTIP_331, rings=8),
        paired=replace(BASE.paired, poses=50),
        pose=replace(BASE.pose, poses=60),
        unshear=replace(BASE.unshear, pose_channels=7, widths=(16, 16)),
        posenet=replace(BASE.posenet, hidden=7),
        train=replace(BASE.train, epochs=7.0),
        train_posenet=replace(BASE.train_posenet, epochs=9.0),
        train_teacher=replace(BASE.train_teacher, epochs=11.0),
    )
    part = select_training_part(full, network)
    assert asked(part, network) == asked(full, network)
    changed = {
        field.name: getattr(full, field.name) != getattr(part, field.name)
        for field in fields(Experiment)
    }
    assert changed["unseen"] and changed["networks"]
    assert sum(not changed[name] for name in ("train", "train_posenet", "train_teacher")) == 1
    assert select_training_part(replace(full, seed=6), network).name != part.name


def test_a_teacher_is_trained_where_a_network_is_taught():
    plain = replace(BASE, networks=("unet", "posenet"))
    taught = replace(
        plain, train=replace(plain.train, losses={**plain.train.losses, "pose_tap": 1.0})
    )
    assert (list_trained_networks(plain), list_trained_networks(taught)) == (
        ("unet", "posenet"),
        (TEACHER, "unet", "posenet"),
    )
    assert list_trained_networks(replace(taught, networks=("posenet",))) == ("posenet",)


def test_a_taught_network_depends_on_its_teacher():
    plain = replace(BASE, networks=("disentangled", "posenet"))
    taught = replace(
        plain, train=replace(plain.train, losses={**plain.train.losses, "pose_tap": 1.0})
    )

    def names(experiment, network):
        wider = replace(experiment, posenet=replace(experiment.posenet, hidden=7))
        return select_training_part(experiment, network).name, select_training_part(
            wider, network
        ).name

    assert len(set(names(plain, "disentangled"))) == 1
    assert len(set(names(taught, "disentangled"))) == 2
    assert names(plain, TEACHER) == names(taught, TEACHER)
    assert list_required_networks(taught, "disentangled") == (TEACHER, "disentangled")


def test_a_teacher_has_a_training_of_its_own():
    plain = replace(BASE, networks=("disentangled", "posenet"))
    taught = replace(
        plain, train=replace(plain.train, losses={**plain.train.losses, "pose_tap": 1.0})
    )

    def those_that_change(experiment, field):
        other = replace(experiment, **{field: replace(getattr(experiment, field), epochs=9.0)})
        names = ("disentangled", "posenet", TEACHER)
        return {
            name
            for name in names
            if select_training_part(experiment, name) != select_training_part(other, name)
        }

    assert those_that_change(taught, "train_teacher") == {"disentangled", TEACHER}
    assert those_that_change(taught, "train_posenet") == {"posenet"}
    assert those_that_change(plain, "train_posenet") == {"posenet"}
    assert list_required_networks(plain, "disentangled") == ("disentangled",)
    assert list_required_networks(taught, "posenet") == ("posenet",)


@pytest.mark.parametrize("network", ["entangled", "unet"])
def test_networks_without_codes_are_shared_by_rows_of_other_codes(asked, network):
    other = replace(BASE, unshear=replace(BASE.unshear, pose_channels=8, shear_channels=120))
    assert select_training_part(BASE, network) == select_training_part(other, network)
    assert asked(BASE, network) == asked(other, network)
    assert select_training_part(BASE, "disentangled") != select_training_part(other, "disentangled")


CHANGES = {  # of recordings: which trainings each concerns
    "labelled": ({"labelled": 0.1}, {"posenet_sheared", "disentangled"}),
    "unlabelled": ({"unlabelled": "read"}, {"disentangled"}),
    "pairing": ({"pairing": "nearest"}, {"disentangled"}),
    "direct_taps": ({"direct_taps": "recorded"}, {"posenet_sheared"}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_recorded_taps_teach_the_same_whatever_is_made_of_slides(change):
    changed, concerned = CHANGES[change]
    base = replace(RECORDED, unshear=replace(RECORDED.unshear, input="pins"))
    other = replace(base, paired=replace(base.paired, **changed))
    for network in (RENDERER, TEACHER, "posenet", "posenet_sheared", "disentangled"):
        same = network not in concerned
        assert (
            select_training_part(base, network) == select_training_part(other, network)
        ) == same, network
        assert (describe_origin(base, network) == describe_origin(other, network)) == same, network


@pytest.mark.parametrize(
    ("unlabelled", "concerned"), [("left_out", set()), ("read", {"disentangled"})]
)
def test_what_the_direct_posenet_is_concerns_it_and_who_learns_from_it(unlabelled, concerned):
    recorded = replace(RECORDED.paired, unlabelled=unlabelled)
    base = replace(RECORDED, unshear=replace(RECORDED.unshear, input="pins"), paired=recorded)
    pins, paired = (
        replace(base.pins, direct_convolved=(8,)),
        replace(recorded, direct_taps="rendered"),
    )
    names = (RENDERER, TEACHER, "posenet", "posenet_sheared", "disentangled")
    for other in (replace(base, pins=pins), replace(base, paired=paired)):
        changed = {
            n for n in names if select_training_part(base, n) != select_training_part(other, n)
        }
        assert changed == {"posenet_sheared"} | concerned


def test_turned_pins_concern_those_that_read_slides():
    base = replace(RECORDED, unshear=replace(RECORDED.unshear, input="pins"))
    other = replace(base, pins=replace(base.pins, turned=0.5))
    names = (RENDERER, TEACHER, "posenet", "posenet_sheared")
    assert {
        name
        for name in names
        if select_training_part(base, name) != select_training_part(other, name)
    } == {"posenet_sheared"}


def test_a_posenet_of_simulated_taps_is_shared_whatever_the_slides_are():
    base = Experiment(
        name="x", claim="", networks=("disentangled", "posenet"), unshear=UnshearNet(input="pins")
    )
    ranges = replace(base.paired.ranges, twist_deg=5.0)
    other = replace(base, paired=replace(base.paired, ranges=ranges), other_twists_deg=(5.0,))
    assert select_training_part(base, "posenet") == select_training_part(other, "posenet")
    assert select_training_part(base, "disentangled") != select_training_part(other, "disentangled")
    leaning = replace(base, pose=replace(base.pose, ranges=replace(base.pose.ranges, tilt_deg=5.0)))
    assert select_training_part(base, "posenet") != select_training_part(leaning, "posenet")
