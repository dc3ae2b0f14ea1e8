"""The page that says how things are added is run, and what it adds has an effect."""

import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxunshear.config import losses
from jaxunshear.config import registry as names
from jaxunshear.config.fields import override_fields
from jaxunshear.config.load import list_registering_files, load_experiment
from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.rules import validate
from jaxunshear.errors import UserError
from jaxunshear.evaluation.network_outputs import load_run
from jaxunshear.models import registry as networks
from jaxunshear.training import checkpoint, trainer
from jaxunshear.training.tasks import make_unshear_task
from tests.helpers.gradients import list_taught_parts
from tests.training import small

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "extending.md").read_text()
LOSS, NETWORK, STIMULUS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


TABLES = (losses.LOSSES, names.REGISTRY, networks._FUNCTIONS, *networks._NETS.values())
LISTS = (names.UNSHEARING,)


@pytest.fixture
def experiment_file(tmp_path):
    """Write a file beside tiny.py, and forget afterwards what it registers."""
    shutil.copy(ROOT / "experiments" / "tiny.py", tmp_path)
    tables, lists = [dict(table) for table in TABLES], [list(items) for items in LISTS]

    def write(text):
        path = tmp_path / "mine.py"
        path.write_text(text)
        return path

    yield write
    for table, before in zip(TABLES, tables, strict=True):
        table.clear()
        table.update(before)
    for items, before in zip(LISTS, lists, strict=True):
        items[:] = before


def test_a_loss_of_an_experiment_file_is_a_term_of_the_training(experiment_file):
    path = experiment_file(LOSS)
    experiment = load_experiment(path)
    validate(experiment)
    assert experiment.train.losses["smooth"] == 0.1
    assert list_registering_files() == [str(path)]
    training = replace(small.TRAINING, losses=experiment.train.losses)
    task = make_unshear_task(small.NET, training)
    variables = jax.jit(task.init)(jax.random.key(0))
    terms, _ = jax.jit(task.terms)(variables, small.pair(3, 4), jax.random.key(1))
    assert set(terms) == {"supervised", "patch", "reconstruction", "smooth"}
    assert terms["smooth"].shape == (4,) and np.all(np.asarray(terms["smooth"]) > 0)
    assert task.weights["smooth"] == 0.1

    def slope(name):
        def total(params):
            terms, _ = task.terms(
                variables | {"params": params}, small.pair(3, 4), jax.random.key(1)
            )
            return terms[name].sum()

        return list_taught_parts(jax.jit(jax.grad(total))(variables["params"]))

    assert slope("smooth") == slope("supervised")
    assert "smooth" in task.validate(variables, small.pair(3, 4))


def test_a_file_may_be_read_twice_and_a_name_is_taken_once(experiment_file):
    path = experiment_file(LOSS)
    load_experiment(path)
    assert "smooth" in load_experiment(path).train.losses
    with pytest.raises(UserError, match="loss 'supervised' is there already"):
        load_experiment(experiment_file(LOSS.replace('"smooth"', '"supervised"')))


def test_a_loss_that_no_file_has_registered_is_refused(experiment_file):
    experiment = load_experiment(experiment_file(LOSS))
    losses.LOSSES.pop("smooth")
    with pytest.raises(UserError, match="loss 'smooth' is unknown"):
        validate(experiment)


def test_a_loss_of_images_is_refused_over_pins(experiment_file):
    experiment = load_experiment(experiment_file(LOSS))
    words = [
        "--unshear.input",
        "pins",
        "--train_pins.batch",
        "8",
        "--train_pins.losses.smooth",
        "1",
    ]
    over_pins = override_fields(replace(experiment, networks=("disentangled",)), words)
    with pytest.raises(UserError, match="is for networks over images"):
        validate(over_pins)


def test_a_network_of_an_experiment_file_is_trained_and_evaluated(experiment_file, tmp_path):
    path = experiment_file(NETWORK)
    experiment = load_experiment(path)
    validate(experiment)
    assert "residual" in experiment.networks and list_registering_files() == [str(path)]
    smaller = replace(experiment, unshear=UnshearNet(size=32, widths=(4, 4)))
    net = networks.make_net(smaller, "residual")
    training = replace(small.TRAINING, epochs=1)
    task = make_unshear_task(net, training)

    def make_batch(step, count=4):
        return small.pair(step, count, 32)

    batches = partial(small.endless, make_batch)
    data = trainer.TrainingData(batches, lambda: iter([make_batch(1000)]), small.IMAGES)
    summary = trainer.train(task, training, data, 0, tmp_path / "run" / "residual")
    assert summary.kind == "residual" and summary.best_loss < 0.3
    assert checkpoint.read_net(tmp_path / "run" / "residual") == net
    pair = make_batch(1001, 2)
    run = load_run(tmp_path / "run", ("residual",))
    outputs, scores = run(pair["canonical"], pair["sheared"])
    assert outputs.images["residual"].shape == (2, 32, 32, 1)
    assert np.isfinite(scores["ms_ssim/residual"]).all()
    names.REGISTRY.pop("residual")
    with pytest.raises(UserError, match="residual is unknown"):
        validate(experiment)


def test_the_name_of_a_network_is_taken_once_and_says_what_it_reads(experiment_file):
    with pytest.raises(UserError, match="network 'unet' is there already"):
        load_experiment(experiment_file(NETWORK.replace('"residual",\n', '"unet",\n', 1)))
    experiment = load_experiment(experiment_file(NETWORK))
    over_pins = replace(experiment, unshear=replace(experiment.unshear, input="pins"))
    with pytest.raises(UserError, match="residual does not read pins"):
        validate(replace(over_pins, train_pins=replace(over_pins.train_pins, batch=8)))


def test_an_outline_of_an_experiment_file_is_a_stimulus(experiment_file):
    experiment = load_experiment(experiment_file(STIMULUS))
    validate(experiment)
    (kite,) = experiment.unseen
    assert kite.name == "kite" and kite.extent_mm == 25
