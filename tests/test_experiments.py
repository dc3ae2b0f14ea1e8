"""Experiments and sweeps of the repository are valid, and `paper.py` follows appendix B."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from jaxunshear.config.configs import CONFIGS, compute_config_name
from jaxunshear.config.data import Recorded
from jaxunshear.config.fields import override_fields
from jaxunshear.config.load import load_experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.rules import validate
from jaxunshear.config.sweep import check_sweep, load_sweep, override_base
from jaxunshear.errors import UserError
from jaxunshear.results.record_files import read_record
from jaxunshear.results.sweep import SweepResult
from jaxunshear.sweep.grid import find_reference, list_cells, list_rows

FOLDER = Path(__file__).resolve().parents[1] / "experiments"


FILES = sorted(FOLDER.rglob("*.py"))
# recordings that nobody opens
SOMEWHERE = ["--paired.tap_folder=somewhere", "--paired.slide_folder=somewhere"]


def is_recorded(experiment):
    return isinstance(experiment.paired, Recorded)


SWEEPS = [path for path in FILES if "\nsweep = " in path.read_text()]


@pytest.mark.parametrize(
    "path", [path for path in FILES if path not in SWEEPS], ids=lambda path: path.stem
)
def test_valid_and_self_describing(path):
    experiment = load_experiment(path)
    if is_recorded(experiment):
        with pytest.raises(UserError, match="add --recordings DIR"):
            validate(experiment)
        validate(override_fields(experiment, SOMEWHERE))
    else:
        validate(experiment)
        assert compute_config_name(experiment.paired, experiment.sensor) == path.stem
        assert compute_config_name(experiment.pose, experiment.sensor) == path.stem
    assert experiment.name == path.stem
    text = path.read_text()
    assert text.startswith('"""Claim: ')
    assert f"jaxunshear run {path.relative_to(FOLDER.parent)}" in text
    assert "Expected" in text


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_sweeps_are_valid_and_self_describing(path):
    sweep = load_sweep(path)
    if is_recorded(sweep.base):
        sweep = override_base(sweep, SOMEWHERE)
    check_sweep(sweep, path.name)
    cells = list_cells(sweep)
    assert sweep.name == path.stem and find_reference(sweep, cells) is not None
    for data in () if is_recorded(sweep.base) else (sweep.base.paired, sweep.base.pose):
        assert (
            compute_config_name(data, sweep.base.sensor) in CONFIGS[data.set_name]
        )  # a set that an experiment has, too
    text = path.read_text()
    assert text.startswith('"""Claim: ') and "Expected" in text
    assert f"jaxunshear sweep {path.relative_to(FOLDER.parent)}" in text


ROWS_TOOK = re.compile(r"Its rows\s+took\s+(\d+)\s+minutes")
TIMED = [path for path in FILES if ROWS_TOOK.search(path.read_text())]


@pytest.mark.parametrize("path", TIMED, ids=lambda path: path.stem)
def test_run_times_are_those_of_the_results(path):
    results = FOLDER.parent / "docs" / "results" / f"{path.stem}.json"
    cells = read_record(results, SweepResult, "make it again").cells
    seconds = sum(costs.wall_seconds for cell in cells for costs in cell.costs.values())
    (minutes,) = ROWS_TOOK.findall(path.read_text())
    assert abs(seconds / 60 - int(minutes)) <= 1


def test_lambda_split_is_five_by_five_by_three():
    sweep = load_sweep(FOLDER / "ablations" / "lambda_split.py")
    cells = list_cells(sweep)
    assert len(cells) == 25 and sweep.seeds == (0, 1, 2) and sweep.ablation
    assert len({row.digest for row in list_rows(sweep, cells).values()}) == 75
    assert all(
        cell.experiment.unshear.pose_channels + cell.experiment.unshear.shear_channels == 128
        for cell in cells
    )


def test_rivals_are_of_one_make_and_read_by_one_posenet():
    sweep = override_base(load_sweep(FOLDER / "rivals.py"), SOMEWHERE)
    cells = list_cells(sweep)
    for name in ("posenet", "renderer"):
        assert len({resolve_network(cell.experiment, name).digest for cell in cells}) == 1
    for cell in cells:
        pins = cell.experiment.pins
        assert pins.conv_channels == pins.direct_conv_channels
        assert bool(pins.conv_channels) == cell.label.startswith("convolving")
    assert sweep.seeds == (0, 1, 2) and sweep.base.train_pins.epochs == 100


def test_the_commands_that_rivals_gives_make_its_rows():
    text = (FOLDER / "rivals.py").read_text()
    options = {
        "dense": "dense ",
        "convolving": "convolving ",
        "dense, direct from rendered taps, too": "direct from rendered taps ",
        "convolving, no pose labels in the loss": "no pose labels ",
    }
    recorded = load_experiment(FOLDER / "recorded.py")
    cells = {
        cell.label: cell
        for cell in list_cells(override_base(load_sweep(FOLDER / "rivals.py"), SOMEWHERE))
    }
    given = {
        label: next(line for line in text.splitlines() if line.startswith(f"    {start}")).split(
            "--", 1
        )[1]
        for label, start in options.items()
    }
    given["dense, direct from rendered taps, too"] += f" --{given['dense']}"
    given["convolving, no pose labels in the loss"] += f" --{given['convolving']}"
    lines = [line.split() for line in text.splitlines()]
    shared = [word for line in lines if line[:1] in (["all"], ["and"]) for word in line]
    trained = shared[shared.index("--train_pins.optimiser") :]
    trained = [word for word in trained if word != "and"]
    for label, words in given.items():
        asked = ["--unshear.input", "pins", *SOMEWHERE, *trained, *f"--{words}".split()]
        made, row = override_fields(recorded, asked), cells[label].experiment
        assert replace(made, name="", claim="") == replace(row, name="", claim=""), label


def test_paper_is_appendix_b():
    paper = load_experiment(FOLDER / "paper.py")
    for training, batch, epochs, drops in (
        (paper.train, 32, 100, ((40, 0.2), (80, 0.1))),
        (paper.train_posenet, 256, 250, ((100, 0.5), (200, 0.1))),
    ):
        assert (training.learning_rate, training.beta1) == (1e-4, 0.5)
        assert (training.batch, training.epochs) == (batch, epochs)
        assert training.drops == drops
        assert (training.l1, training.l2, training.kernels) == (1e-3, 1e-3, "mean")
        assert training.ema_decay == 0
        assert 0.01 <= training.shift <= 0.02
    assert (paper.train.losses["patch"], paper.train.crops, paper.train.crop_px) == (0.1, 100, 20)
    assert (paper.paired.poses, paper.paired.taps, paper.paired.slides) == (200, 50, 150)
    assert paper.paired.tap_depth_jitter_mm == 1
    assert paper.pose.poses * len(paper.pose.stimuli) == 30_000
    users = (paper.paired.preprocess, paper.pose.preprocess, paper.unshear, paper.posenet)
    assert [user.size for user in users] == [256] * 4
    assert len(paper.unshear.widths) == 5
    assert (paper.unshear.pose_channels, paper.unshear.shear_channels) == (64, 64)


def test_a_tenth_of_the_paper_is_the_paper_but_for_the_amount():
    paper, tenth = (load_experiment(FOLDER / f"{name}.py") for name in ("paper", "paper_tenth"))
    for name in ("unshear", "posenet", "train_posenet"):
        assert getattr(tenth, name) == getattr(paper, name)
    amounts = {name: getattr(paper.train, name) for name in ("validate_every", "validation_images")}
    assert replace(tenth.train, **amounts) == paper.train
    assert paper.paired.taps == 10 * tenth.paired.taps
    assert paper.paired.slides == 10 * tenth.paired.slides
    assert 10 * tenth.pose.poses == paper.pose.poses and tenth.paired.poses == paper.paired.poses
    assert tenth.paired.tap_depth_jitter_mm == paper.paired.tap_depth_jitter_mm


def test_the_small_version_of_paper_that_its_docstring_gives_is_valid():
    text = (FOLDER / "paper.py").read_text()
    words = text[text.index("`--paired.poses") + 1 : text.index("32`") + 2].split()
    validate(override_fields(load_experiment(FOLDER / "paper.py"), words))
