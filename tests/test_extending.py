"""The page that says how things are added is run, and what it adds has an effect."""

import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxunshear.config import layouts, losses, sensor
from jaxunshear.config import networks as names
from jaxunshear.config.configs import describe_set
from jaxunshear.config.data import SourceSettings
from jaxunshear.config.fields import override_fields
from jaxunshear.config.load import load_experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.rules import validate
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.types import REGISTERED, list_registering_files
from jaxunshear.errors import UserError
from jaxunshear.evaluation.network_outputs import load_run
from jaxunshear.models import registry as networks
from jaxunshear.models.modality import IMAGES
from jaxunshear.perception.lattice import compute_rings
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import simulate
from jaxunshear.sweep.grid import Row
from jaxunshear.sweep.plan import make_data_task
from jaxunshear.sweep.tasks import read_order
from jaxunshear.training import checkpoint, trainer
from jaxunshear.training.examples import open_examples
from jaxunshear.training.task_factory import make_task
from jaxunshear.training.tasks import make_unshear_task
from tests.helpers.gradients import list_taught_parts
from tests.training import small

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "extending.md").read_text()
LOSS, NETWORK, STIMULUS, FUNCTION, LAYOUT, SOURCE = re.findall(
    r"```python\n(.*?)```", PAGE, re.DOTALL
)
TABLES = (
    losses.LOSSES,
    names.REGISTRY,
    networks._FUNCTIONS,
    layouts.LAYOUTS,
    SourceSettings.registered,
    REGISTERED,
)
LISTS = (names.UNSHEARING,)


@pytest.fixture
def experiment_file(tmp_path, monkeypatch):
    """Write a file beside tiny.py, and forget afterwards what it registers."""
    shutil.copy(ROOT / "experiments" / "tiny.py", tmp_path)
    monkeypatch.setenv("JAXUNSHEAR_CACHE", str(tmp_path / "cache"))
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

    def add_up(params):
        pair = small.pair(3, 4)
        terms, _ = task.terms(variables | {"params": params}, pair, jax.random.key(1))
        return [terms[name].sum() for name in ("smooth", "supervised")]

    smooth, supervised = jax.jit(jax.jacrev(add_up))(variables["params"])
    assert list_taught_parts(smooth) == list_taught_parts(supervised)
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
    words = ["--unshear.input=pins", "--train_pins.batch=8", "--train_pins.losses.smooth=1"]
    over_pins = override_fields(replace(experiment, networks=("disentangled",)), words)
    with pytest.raises(UserError, match="is for networks over images"):
        validate(over_pins)


def test_a_network_of_an_experiment_file_is_trained_and_evaluated(experiment_file, tmp_path):
    path = experiment_file(NETWORK)
    experiment = load_experiment(path)
    validate(experiment)
    assert "residual" in experiment.networks and list_registering_files() == [str(path)]
    smaller = replace(experiment, unshear=UnshearNet(size=32, widths=(4, 4)))
    net = resolve_network(smaller, "residual").net
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
    run = load_run(tmp_path / "run", ("residual",), IMAGES)
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


def test_a_function_of_an_experiment_file_is_a_stimulus(experiment_file):
    experiment = load_experiment(experiment_file(FUNCTION))
    validate(experiment)
    (oval,) = experiment.unseen
    np.testing.assert_allclose(np.abs(oval.points).max(axis=0), [18, 12], atol=0.05)


def test_a_layout_of_an_experiment_file_is_simulated(experiment_file):
    path = experiment_file(LAYOUT)
    experiment = load_experiment(path)
    validate(experiment)
    assert list_registering_files() == [str(path)]
    tiny = load_experiment(path.with_name("tiny.py"))
    assert override_fields(tiny, ["--sensor.layout", "square"]).sensor.pins == 317
    small = replace(experiment.sensor, rings=3, dome_radius_mm=8.0)
    scene = Scenes(np.zeros(1, int), np.array([[-4, 0, 0, 1.0]]), np.zeros((1, 2)), np.ones(1))
    contacts = simulate(small, ("disk",), scene)
    assert contacts.converged.all() and contacts.pins.shape == (1, 29, 3) == (1, small.pins, 3)
    lift = (contacts.pins[0] - compute_pin_tips(small))[:, 2]
    assert (
        lift.argmax() == np.argmin(np.linalg.norm(small.place_pins(), axis=-1)) and lift.max() > 0
    )
    assert compute_rings(small).max() == 3
    assert describe_set(experiment.paired, small) != describe_set(tiny.paired, tiny.sensor)


def test_the_process_of_a_data_set_knows_the_layout(experiment_file, tmp_path):
    path = experiment_file(LAYOUT)
    row = Row("", "", load_experiment(path))
    task = make_data_task(tmp_path, [row], tmp_path)
    assert read_order(task.folder).files == [str(path)]


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ("return np.full((3, 2), np.nan)", r"layout = square: must place pins"),
        ("return np.array([[40.0, 0.0]])", "go past the rim"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(experiment_file, layout, message):
    body = LAYOUT.replace("    line = np.arange", f"    {layout}\n    line = np.arange")
    experiment = load_experiment(experiment_file(body))
    with pytest.raises(UserError, match=message):
        sensor.check_sensor(experiment.sensor)


def test_a_layout_that_no_file_has_registered_is_refused_and_a_name_is_taken_once(experiment_file):
    experiment = load_experiment(experiment_file(LAYOUT))
    load_experiment(experiment_file(LAYOUT))
    with pytest.raises(UserError, match="layout 'rings' is there already"):
        load_experiment(experiment_file(LAYOUT.replace('out("square")', 'out("rings")')))
    del layouts.LAYOUTS["square"]
    with pytest.raises(UserError, match=r"sensor\.layout square: is unknown: use one of rings"):
        validate(experiment)
    with pytest.raises(UserError, match="layout 'square' is unknown"):
        describe_set(experiment.paired, experiment.sensor)


def test_networks_learn_from_a_data_source_of_an_experiment_file(experiment_file, tmp_path):
    path, generator = experiment_file(SOURCE), np.random.default_rng(0)
    np.savez(
        tmp_path / "pairs.npz",
        split=np.repeat(["train", "validation", "test"], (12, 4, 4)),
        canonical=generator.choice(np.array([0, 255], np.uint8), (20, 128, 128)),
        sheared=generator.choice(np.array([0, 255], np.uint8), (20, 128, 128)),
        pose=generator.uniform(-5, 5, (20, 6)),
    )
    words = ["--paired.file", str(tmp_path / "pairs.npz")]
    experiment = override_fields(load_experiment(path), words)
    validate(experiment)
    assert from_json(to_json(experiment)) == experiment
    assert list_registering_files() == [str(path)]
    for network, images in (("disentangled", {"canonical", "sheared"}), ("posenet", {"image"})):
        examples = open_examples(experiment, network, tmp_path, tmp_path)
        _, fields = make_task(experiment, network, examples, tmp_path)
        batch = next(examples.reader.train_batches(6, 0, 0.015, fields)(0))
        assert images <= batch.keys() and len(examples.targets) == 6
        assert all(batch[name].shape == (6, 128, 128, 1) for name in images)
    over_pins = override_fields(experiment, ["--unshear.input", "pins"])
    with pytest.raises(UserError, match="has images alone"):
        open_examples(over_pins, "disentangled", tmp_path, tmp_path)
