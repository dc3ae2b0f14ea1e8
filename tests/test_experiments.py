"""The experiments of the repository are valid, and `paper.py` is appendix B to the letter."""

from pathlib import Path

import pytest

from jaxunshear.config import load_experiment, override, validate
from jaxunshear.dataset.configs import config_name

FOLDER = Path(__file__).resolve().parents[1] / "experiments"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_valid_and_self_describing(path):
    experiment = load_experiment(path)
    validate(experiment)
    assert experiment.name == path.stem
    assert config_name(experiment.paired, experiment.sensor) == path.stem
    assert config_name(experiment.pose, experiment.sensor) == path.stem
    text = path.read_text()
    assert text.startswith('"""Claim: ')
    assert f"jaxunshear run experiments/{path.name}" in text
    assert "Expected" in text


def test_paper_is_appendix_b():
    paper = load_experiment(FOLDER / "paper.py")
    for training, batch, epochs, drops in (
        (paper.train, 32, 100, ((40, 0.2), (80, 0.1))),
        (paper.train_posenet, 256, 250, ((100, 0.5), (200, 0.1))),
    ):
        assert (training.learning_rate, training.beta1, training.beta2) == (1e-4, 0.5, 0.999)
        assert (training.batch, training.epochs, training.schedule, training.drops) == (batch, epochs, "steps", drops)
        assert (training.l1, training.l2, training.averaging) == (1e-3, 1e-3, 0.0)
        assert 0.01 <= training.shift <= 0.02
    assert (paper.train.patch_weight, paper.train.crops, paper.train.crop_px) == (0.1, 100, 20)
    assert (paper.paired.poses, paper.paired.taps, paper.paired.slides, paper.paired.tap_depth_jitter_mm) == (
        200,
        50,
        150,
        1.0,
    )
    assert paper.pose.poses * len(paper.pose.stimuli) == 30_000
    assert paper.paired.preprocess.size == paper.pose.preprocess.size == paper.unshear.size == paper.posenet.size == 256
    assert len(paper.unshear.widths) == 5
    assert (paper.unshear.size // 2**5, paper.unshear.pose_channels, paper.unshear.shear_channels) == (8, 64, 64)


def test_the_small_version_of_paper_that_its_docstring_gives_is_valid():
    text = (FOLDER / "paper.py").read_text()
    words = text[text.index("`--paired.poses") + 1 : text.index("32`") + 2].split()
    validate(override(load_experiment(FOLDER / "paper.py"), words))
