"""What a sweep file may say; what it may not is refused in one line that names file and field."""

from dataclasses import replace
from pathlib import Path

import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.sweep import (
    Sweep,
    check_sweep,
    get_base,
    load_sweep,
    override_base,
    parse_seeds,
)
from jaxunshear.errors import UserError
from jaxunshear.sweep.grid import find_reference, list_cells

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
PLAIN = Sweep(name="plain", claim="none", base=Experiment(name="plain", claim="none"))
LAMBDA = replace(PLAIN, grid=(("train.losses.patch", (0.0, 1.0)),))

IMPORTS = (
    "from jaxunshear.config.experiment import Experiment\n"
    "from jaxunshear.config.sweep import Sweep\n"
)
BAD = [
    ({"name": 5}, "bad.py: sweep.name"),
    ({"name": "a/b"}, "--name a/b"),
    ({"base": None}, "sweep.base is no Experiment"),
    ({"base": Experiment(name="x", claim=5)}, "--claim takes text"),
    ({"grid": ("train.batch", (1, 2))}, "sweep.grid is no tuple of axes"),
    ({"grid": (("train.batch", ()),)}, "sweep.grid lists no values for train.batch"),
    ({"grid": (("train.batch", [4]),)}, "sweep.grid is no tuple of axes"),
    ({"grid": (((), (4,)),)}, "sweep.grid is no tuple of axes"),
    ({"grid": ((("train.batch", "seed"), ((4,),)),)}, "sweep.grid needs tuples of a value each"),
    (
        {"grid": (("train.batch", (4,)), (("train.batch", "train.l1"), ((4, 0.0),)))},
        "varies train.batch on two axes",
    ),
    ({"grid": (("train.bach", (4,)),)}, "did you mean --train.batch"),
    ({"grid": (("train", (4,)),)}, "it is a group"),
    ({"grid": (("seed", (0, 1)),)}, "sweep.grid varies seed: list the seeds"),
    ({"grid": (("name", ("a", "b")),)}, "varies name, which decides nothing"),
    ({"rows": (("train.batch", 4),)}, "sweep.rows is no tuple of rows"),
    ({"rows": (((("train.batch", "train.l1"), 4),),)}, "sweep.rows needs tuples of a value each"),
    ({"rows": ((("seed", 1),),)}, "sweep.rows varies seed: list the seeds"),
    ({"rows": ((("train.bach", 4),),)}, "did you mean --train.batch"),
    ({"seeds": ()}, "sweep.seeds (or --seeds) is no tuple"),
    ({"seeds": (0, -1)}, "integers from 0"),
    ({"seeds": (0, True)}, "integers from 0"),
    ({"seeds": (2, 2)}, "lists a seed twice"),
    ({"networks": ("resnet",)}, "resnet is unknown: use one of entangled, disentangled"),
    ({"networks": ()}, "name at least one"),
    ({"ablation": 1}, "sweep.ablation is neither True nor False"),
    ({"reference": 1}, "sweep.reference is no text"),
]


@pytest.mark.parametrize(("changes", "line"), BAD, ids=[line for _, line in BAD])
def test_a_bad_sweep_is_refused_in_one_line(changes, line):
    with pytest.raises(UserError) as refusal:
        check_sweep(replace(PLAIN, **changes), "bad.py")
    assert line in str(refusal.value) and "\n" not in str(refusal.value)


BAD_CELLS = [
    ({"grid": (("train.batch", (4, 0)),)}, "cell batch=0: --train.batch 0: must be at least 1"),
    ({"grid": (("train.batch", (4, "many")),)}, "cell batch=many: --train.batch takes an integer"),
    ({"rows": ((("train.l1", -1.0),),)}, "cell l1=-1.0: --train.l1 -1.0"),
    ({"ablation": True, "networks": ("posenet",)}, "needs the network 'disentangled'"),
    (
        {"grid": (("train.batch", (4, 8)),), "reference": "batch=5"},
        "use one of 'batch=4'; 'batch=8'",
    ),
]


@pytest.mark.parametrize(("changes", "line"), BAD_CELLS, ids=[line for _, line in BAD_CELLS])
def test_a_bad_cell_is_refused_by_its_label(changes, line):
    sweep = replace(PLAIN, **changes)
    check_sweep(sweep, "bad.py")
    with pytest.raises(UserError) as refusal:
        find_reference(sweep, list_cells(sweep))
    assert line in str(refusal.value) and "\n" not in str(refusal.value)


def test_fields_of_the_base_are_overridden_but_not_those_of_an_axis():
    changed = override_base(
        LAMBDA, ["--train.epochs", "2", "--name", "other", "--networks", "disentangled"]
    )
    assert (changed.base.train.epochs, changed.name, get_base(changed).networks) == (
        2.0,
        "other",
        ("disentangled",),
    )
    for words, line in (
        ("--train.losses.patch 1", "sweep plain varies train.losses.patch"),
        ("--seed 3", "use --seeds"),
        ("--train.epoch 3", "did you mean --train.epochs"),
    ):
        with pytest.raises(UserError, match=line):
            override_base(LAMBDA, words.split())
    for axis, words in (
        (("sensor.rings", (8, 10)), "--sensor tactip127"),
        (("sensor", (TACTIP_331,)), "--sensor tactip127"),
        (("sensor", (TACTIP_331,)), "--sensor.skin_mm 2"),
    ):
        with pytest.raises(UserError, match=rf"--sensor.* varies {axis[0]};"):
            override_base(replace(PLAIN, grid=(axis,)), words.split())


def test_an_ordinary_experiment_is_a_sweep_of_seeds_alone():
    sweep = load_sweep(EXPERIMENTS / "tiny.py")
    assert (sweep.name, sweep.grid, sweep.rows, sweep.seeds) == ("tiny", (), (), (0,))
    assert [cell.label for cell in list_cells(sweep)] == ["base"]
    assert parse_seeds("0,1, 5") == (0, 1, 5)
    with pytest.raises(UserError, match="separated by commas, not '0;1'"):
        parse_seeds("0;1")


def test_a_file_without_sweep_or_experiment_is_refused(tmp_path):
    path = tmp_path / "bad.py"
    for text, line in (
        ("a = 1", "bad.py defines no variable `sweep`"),
        ("sweep = {}", "bad.py: `sweep` is of type dict, not Sweep"),
        (
            f"{IMPORTS}base = Experiment(name='x', claim='y')\n"
            "sweep = Sweep(name='x', claim='y', base=base, grid=('train.batch', (1, 2)))\n",
            r"bad\.py: sweep\.grid is no tuple of axes",
        ),
        (f'{IMPORTS}experiment = Experiment(name="a", claim="b", train=None)', "train is of type"),
        (
            f'{IMPORTS}base = Experiment(name="a", claim="b", train=3)\n'
            'sweep = Sweep(name="a", claim="b", base=base)',
            "train is of type",
        ),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=line):
            load_sweep(path)
