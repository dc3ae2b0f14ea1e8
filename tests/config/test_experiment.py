"""Experiments are read, changed by name, checked and kept without loss."""

import dataclasses
import math
import sys
from typing import get_args

import pytest

from jaxunshear.config.data import Recorded, RecordedTaps
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import list_field_types, override_fields, replace_field
from jaxunshear.config.load import load_experiment
from jaxunshear.config.rules import find_experiment_problems, validate
from jaxunshear.config.sensor import GEL_PAD
from jaxunshear.config.stimuli import StimulusName
from jaxunshear.config.training import Training
from jaxunshear.config.types import list_hints
from jaxunshear.errors import UserError

PLAIN = Experiment(name="plain", claim="none")
MISSING = object()
IMPORT = "from jaxunshear.config.experiment import Experiment\n"


def changed(*argv: str) -> Experiment:
    return override_fields(PLAIN, argv)


def test_each_kind_of_value_is_overridden_by_name():
    words = (
        "--seed 7 --train.epochs=2.5 --train.drops 40:0.2,80:.1 --paired.stimuli disk "
        "--paired.nuisance.housing_ring false --sensor tactip127"
    )
    experiment = changed(*words.split(), "--unshear.widths", "8, 16,32", "--claim", "a b")
    assert experiment.seed == 7
    assert experiment.train == Training(epochs=2.5, drops=((40.0, 0.2), (80.0, 0.1)))
    assert experiment.unshear.widths == (8, 16, 32)
    assert experiment.paired.stimuli == ("disk",)
    assert not experiment.paired.nuisance.housing_ring
    assert experiment.claim == "a b"
    assert experiment.sensor.pins == 127
    assert experiment.train_posenet == PLAIN.train_posenet
    assert changed("--train.drops=").train.drops == ()
    assert changed("--train.batch", "4", "--train.batch", "8").train.batch == 8
    assert changed("--paired.preprocess.offset", "-1e-2").paired.preprocess.offset == -0.01


def test_every_field_can_be_overridden_by_what_it_is_shown_as():
    from jaxunshear.config.fields import format_value

    recorded = dataclasses.replace(PLAIN, paired=Recorded(), pose=RecordedTaps())
    on_pad = dataclasses.replace(PLAIN, sensor=GEL_PAD)
    shown = set()
    for name in list_field_types():
        # some fields are of simulated sets alone, of domes or of pads
        for experiment in (PLAIN, recorded, on_pad):
            value = experiment
            for part in name.split("."):
                names = list_hints(type(value)) if dataclasses.is_dataclass(value) else ()
                value = getattr(value, part) if part in names else MISSING
            if value is not MISSING:
                shown.add(name)
                text = format_value(value).strip("'")
                assert override_fields(experiment, [f"--{name}={text}"]) == experiment, name
            else:
                with pytest.raises(UserError, match="has other fields"):
                    replace_field(experiment, name, None)
    assert shown == set(list_field_types())


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["--train.epoch", "5"], "there is no field --train.epoch: did you mean --train.epochs?"),
        (
            ["--epochs", "5"],
            "there is no field --epochs: did you mean --train.epochs or --train_posenet.epochs "
            "or --train_teacher.epochs?",
        ),
        (["--train", "5"], "--train: it is a group"),
        (["--train.epochs"], "--train.epochs needs a value: a number"),
        (["--train.epochs", "--seed"], "--train.epochs needs a value"),
        (["--train.epochs", "many"], "--train.epochs takes a number, not 'many'"),
        (["--train.batch", "1.5"], "--train.batch takes an integer, not '1.5'"),
        (["--train.drops", "40"], "--train.drops takes pairs a:b separated by commas, not '40'"),
        (["--unshear.widths", "8,,8"], "--unshear.widths takes integers separated by commas"),
        (["--unshear.disentangled", "1"], "--unshear.disentangled takes true or false, not '1'"),
        (["--sensor", "gelsight"], "sensor 'gelsight' is unknown"),
        (["stray"], "argument 'stray' is not understood"),
    ],
)
def test_refusals_name_the_field(argv, line):
    with pytest.raises(UserError) as refusal:
        changed(*argv)
    assert line in str(refusal.value)


def test_wrong_types_and_nan_in_a_file_are_refused_by_name():
    for value in ("many", math.nan, True):
        with pytest.raises(UserError, match=r"--train\.epochs"):
            validate(dataclasses.replace(PLAIN, train=Training(epochs=value)))
    with pytest.raises(UserError, match="train is of type dict, not Training"):
        validate(dataclasses.replace(PLAIN, train={}))
    for epochs in (math.inf, 10**400):
        with pytest.raises(UserError, match=r"--train\.drops takes"):
            validate(replace_field(PLAIN, "train.drops", ((epochs, 0.5),)))


def test_the_names_of_the_stimuli_are_those_of_the_scene():
    from jaxunshear.simulator.stimuli import STIMULI

    assert tuple(STIMULI) == get_args(StimulusName)


def test_depths_beyond_the_contact_model_are_refused():
    from jaxunshear.config.contact_rings import compute_max_depth_mm

    for excess, refused in ((-0.01, False), (0.01, True)):
        depth_mm = compute_max_depth_mm(PLAIN.sensor) + excess
        deep = replace_field(PLAIN, "pose.ranges.depth_max_mm", depth_mm)
        wrong = [field for field, _ in find_experiment_problems(deep)]
        assert ("pose.ranges.depth_max_mm" in wrong) == refused


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("import jaxunshear\nexperiment = (", "syntax error in line 2"),
        ("\n1 / 0", "fails in line 2: ZeroDivisionError"),
        ("import sys; sys.exit(3)", "SystemExit"),
        (f"{IMPORT}experiment = Experiment(nam='x')", "unexpected keyword argument 'nam'"),
        (f"{IMPORT}experiment = Experiment(name='x')", "missing 1 required"),
        ("setup = 1", "defines no variable `experiment`"),
        ("sweep = 1", "defines a sweep: run it with `jaxunshear sweep"),
        ("experiment = {'name': 'x'}", "of type dict, not Experiment"),
        ("\0", "is not text"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, line):
    path = tmp_path / "bad.py"
    path.write_text(text)
    with pytest.raises(UserError) as refusal:
        load_experiment(path)
    assert line in str(refusal.value)
    assert "bad.py" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_file_builds_on_its_own_neighbour_or_one_of_the_folder_above(tmp_path):
    """As those of experiments/ablations do; a neighbour of the same name comes first."""
    before = list(sys.path)
    (tmp_path / "base.py").write_text("seed = 5")
    for folder, own in (("one", "seed = 1"), ("two", "seed = 2"), ("ablations", "")):
        (tmp_path / folder).mkdir()
        if own:
            (tmp_path / folder / "base.py").write_text(own)
        (tmp_path / folder / "built.py").write_text(
            f"{IMPORT}import base\nexperiment = Experiment('built', '', seed=base.seed)"
        )
    folders = ("one", "ablations", "two")
    assert [load_experiment(tmp_path / each / "built.py").seed for each in folders] == [1, 5, 2]
    assert sys.path == before and "base" not in sys.modules


def test_a_fault_of_a_neighbour_is_refused_in_one_line(tmp_path):
    (tmp_path / "base.py").write_text("1 / 0")
    (tmp_path / "built.py").write_text("import base")
    with pytest.raises(UserError, match=r"built\.py fails in line 1: ZeroDivisionError"):
        load_experiment(tmp_path / "built.py")
