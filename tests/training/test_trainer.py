"""Training: it learns, continues bit for bit after any stop, and stops with one line where it must."""

import dataclasses
import itertools
import json
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.training import Training
from jaxunshear.errors import UserError
from jaxunshear.models import unshearnet
from jaxunshear.report.training_sections import read_lines
from jaxunshear.training import checkpoint, trainer
from jaxunshear.training.step import list_kernels, make_schedule
from jaxunshear.training.tasks import make_posenet_task, make_unshear_task
from tests.training import small


class Stop(Exception):
    """A kill, as far as the loop can see."""


def stopped(make, start, at):
    for step, batch in enumerate(small.endless(make, start), start):
        if step == at:
            raise Stop
        yield batch


def bits(folder):
    variables = checkpoint.load_best(folder)
    return {
        jax.tree_util.keystr(path): np.asarray(leaf).tobytes()
        for path, leaf in jax.tree_util.tree_leaves_with_path(variables)
    }


def lines(folder):
    return read_lines(folder / "log.jsonl")


def losses_of(folder):
    return [(line["step"], line["train"], line["validation"]) for line in lines(folder)]


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """An undisturbed training."""
    folder = tmp_path_factory.mktemp("straight")
    return folder, small.train(folder)


def test_summary_log_and_settings(straight):
    folder, summary = straight
    params, log = checkpoint.load_best(folder)["params"], lines(folder)
    assert (summary.steps, summary.images) == (12, 48)
    assert summary.parameters == sum(x.size for x in jax.tree.leaves(params))
    assert [line["step"] for line in log] == [4, 8, 12] and log[-1]["epoch"] == 3
    assert log[0]["train_seconds"] < log[-1]["train_seconds"] == summary.train_seconds
    assert set(log[0]["train"]) == {*small.TRAINING.losses, "regularisation", "gradient"}
    assert set(log[0]["validation"]) == {"supervised", "reconstruction"}
    assert log[0]["kernels"].keys() == set(list_kernels(params))
    assert min(log[0]["kernels"].values()) > 0
    best = min(log, key=lambda line: line["validation"]["supervised"])
    assert summary.best_step == best["step"]
    assert summary.best_loss == best["validation"]["supervised"]
    assert checkpoint.read_net(folder) == small.NET


def test_a_step_compiles_while_the_first_state_is_made(tmp_path, monkeypatch):
    both_at_work = threading.Barrier(2, timeout=60)
    jit_first_state, compile_step = trainer.jit_first_state, trainer._compile_step

    class Meeting:
        def __init__(self, *args):
            self.made = jit_first_state(*args)
            self.trace = self.made.trace

        def __call__(self, *args):
            both_at_work.wait()
            return self.made(*args)

    def meet_and_compile(*args):
        both_at_work.wait()
        return compile_step(*args)

    monkeypatch.setattr(trainer, "jit_first_state", Meeting)
    monkeypatch.setattr(trainer, "_compile_step", meet_and_compile)
    assert small.train(tmp_path).compile_seconds > 0


def test_few_examples_are_repeated_up_to_the_least_number_of_steps(straight, tmp_path):
    folder, summary = straight
    longer = small.train(
        tmp_path / "longer", training=dataclasses.replace(small.TRAINING, min_steps=16)
    )
    assert (longer.steps, longer.images) == (16, 64) and lines(tmp_path / "longer")[-1][
        "epoch"
    ] == 4
    same = small.train(
        tmp_path / "same", training=dataclasses.replace(small.TRAINING, min_steps=summary.steps)
    )
    assert same.steps == summary.steps and bits(tmp_path / "same") == bits(folder)


def test_a_finished_training_returns_at_once(straight):
    folder, summary = straight
    assert small.train(folder, lambda start: pytest.fail("no data are needed")) == summary


@pytest.mark.parametrize("at", [pytest.param(2, marks=pytest.mark.long), 7])
def test_stopped_and_resumed_gives_the_same_bits(straight, tmp_path, at):
    """Stopped before the first checkpoint, and between two."""
    with pytest.raises(Stop):
        small.train(tmp_path, lambda start: stopped(small.pair, start, at))
    resumed_from = []
    small.train(
        tmp_path, lambda start: resumed_from.append(start) or small.endless(small.pair, start)
    )
    assert resumed_from == [at // 4 * 4]
    assert bits(tmp_path) == bits(straight[0])
    assert losses_of(tmp_path) == losses_of(straight[0])


def test_killed_processes_end_as_an_undisturbed_one(straight, tmp_path):
    """kill -9 at several moments, from the first checkpoint's writing on, then to the end."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(Path(__file__).with_name("small.py")), str(tmp_path), "0.05"]
    for sight, wait in (("checkpoints/*", 0.0), ("checkpoints/00000008*", 0.02)):
        process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
        while not list(tmp_path.glob(sight)) and process.poll() is None:
            time.sleep(0.002)
        time.sleep(wait)
        process.kill()
        process.wait()
    small.train(tmp_path)
    assert bits(tmp_path) == bits(straight[0])
    assert losses_of(tmp_path) == losses_of(straight[0])


def test_half_written_and_superfluous_checkpoints_are_swept_away(tmp_path):
    half = tmp_path / "checkpoints" / "00000004.part"
    half.mkdir(parents=True)
    (half / "record.json").write_text("{")
    small.train(tmp_path)
    kept = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    record = json.loads((tmp_path / "checkpoints" / "00000012" / "record.json").read_text())
    assert kept == {"00000012", f"{record['best_step']:08d}"}


def convert_to_floats(batch):
    return {name: value / np.float32(255) for name, value in batch.items()}


def broken_from(step):
    def batches(start):
        for at, batch in enumerate(small.endless(small.pair, start), start):
            floats = convert_to_floats(batch)
            if at >= step:
                floats["canonical"][0, 3, 3] = np.nan
            yield floats

    return batches


def test_nan_in_a_batch_stops_with_step_and_term_and_keeps_the_last_good_checkpoint(tmp_path):
    with pytest.raises(UserError, match=r"patch, supervised not finite at step 7.*step 4 is kept"):
        small.train(tmp_path, broken_from(6))
    assert checkpoint.find_latest_step(tmp_path) == 4
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(checkpoint.load_best(tmp_path)))
    small.train(tmp_path, broken_from(10**9))  # with the data repaired it goes on
    assert (tmp_path / "summary.json").exists()


def scale_rate(epoch, factor):
    return dataclasses.replace(small.TRAINING, drops=((epoch, factor),))


def test_a_diverging_training_leaves_the_checkpoint_of_an_undisturbed_one(tmp_path):
    """The batch is sound and the line says so; what is kept is, bit for bit, what a training that was stopped there holds."""
    diverging = scale_rate(1.5, 1e30)  # from step 7 on
    folders = tmp_path / "diverged", tmp_path / "sound"
    said = "whose numbers are 0 to 255;.*step 4 is kept;.*lower learning_rate"
    with pytest.raises(UserError, match=said):
        small.train(folders[0], training=diverging)
    with pytest.raises(Stop):
        small.train(folders[1], lambda start: stopped(small.pair, start, 6), training=diverging)
    assert [checkpoint.find_latest_step(folder) for folder in folders] == [4, 4]
    assert bits(folders[0]) == bits(folders[1])
    assert losses_of(folders[0]) == losses_of(folders[1])
    images = jnp.asarray(small.dots(0, 2) / 255, jnp.float32)
    variables = checkpoint.load_best(folders[0])
    assert np.isfinite(unshearnet.unshear(small.NET, variables, images)).all()


def test_weights_thrown_away_by_the_step_before_a_checkpoint_are_not_kept(tmp_path):
    """The terms of that step come from before its update, and are finite."""
    said = r"stopped: params\S+ not finite at step 8, of batch 7 .*step 4 is kept"
    with pytest.raises(UserError, match=said):
        small.train(tmp_path, training=scale_rate(1.75, math.inf))  # from step 8 on
    assert checkpoint.find_latest_step(tmp_path) == 4
    assert [line["step"] for line in lines(tmp_path)] == [4]


def validate_once(is_broken):
    """Return one batch, perhaps of NaN."""
    batch = convert_to_floats(small.pair(1000, 4))
    if is_broken:
        batch["canonical"][:] = np.nan
    return iter([batch])


def test_a_validation_that_is_never_finite_is_no_result(tmp_path):
    for _ in range(2):  # also when the same command is given again
        with pytest.raises(UserError, match=r"validation loss \(supervised\) was never finite"):
            small.train(tmp_path, validation=lambda: validate_once(True))
        assert not (tmp_path / "summary.json").exists()


def test_nan_in_validation_ranks_last(tmp_path):
    broken = iter((True, False, True))
    summary = small.train(tmp_path, validation=lambda: validate_once(next(broken)))
    assert summary.best_step == 8
    assert lines(tmp_path)[0]["validation"]["supervised"] is None


def test_an_empty_validation_split_is_refused(tmp_path):
    with pytest.raises(UserError, match="validation split is empty"):
        small.train(tmp_path, validation=lambda: iter(()))


def test_other_settings_in_the_same_folder_are_refused(straight):
    other = dataclasses.replace(small.TRAINING, learning_rate=0.5)
    with pytest.raises(UserError, match=r"training.learning_rate = 0.001, now 0.5"):
        small.train(straight[0], training=other)


@pytest.mark.parametrize(
    ("group", "changes", "word"),
    [
        ("net", {"size": 18}, "size"),
        ("net", {"pose_channels": 0}, "pose_channels = 0"),
        ("net", {"shear_channels": -1}, "shear_channels = -1"),
        ("training", {"crop_px": 40}, "crop_px"),
        ("training", {"crops": 0}, "crops: 0"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(tmp_path, group, changes, word):
    default = small.NET if group == "net" else small.TRAINING
    with pytest.raises(UserError, match=word):
        small.train(tmp_path, **{group: dataclasses.replace(default, **changes)})


def test_posenet_trains_and_reports_errors_in_units(tmp_path):
    task = make_posenet_task(small.POSENET, small.POSENET_TRAINING, small.TARGETS)
    data = trainer.TrainingData(
        lambda start: small.endless(small.pose, start),
        lambda: iter([small.pose(1000, 4), small.pose(1001, 2)]),
        small.IMAGES,
    )
    assert trainer.train(task, small.TRAINING, data, 0, tmp_path).kind == "posenet"
    assert lines(tmp_path)[0]["validation"].keys() == {"pose", *(t.name for t in small.TARGETS)}
    assert checkpoint.read_net(tmp_path) == small.POSENET
    assert checkpoint.read_targets(tmp_path) == small.TARGETS


@pytest.mark.parametrize(
    ("flags", "level"), [("", 1), ("--xla_backend_optimization_level=0", None)]
)
def test_a_level_of_xla_flags_is_kept(monkeypatch, flags, level):
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    options = trainer.get_compile_options()
    assert options == (None if level is None else {"xla_backend_optimization_level": level})


def test_schedules():
    cosine = make_schedule(Training(learning_rate=1.0), 100, 10)
    np.testing.assert_allclose([cosine(0), cosine(50), cosine(100)], [1, 0.5, 0], atol=1e-6)
    paper = Training(learning_rate=1e-4, drops=((40, 0.2), (80, 0.1)))
    steps = make_schedule(paper, 1000, 10)
    np.testing.assert_allclose(
        [steps(399), steps(400), steps(799), steps(800)], [1e-4, 2e-5, 2e-5, 1e-5], rtol=1e-6
    )


@pytest.mark.long
def test_overfits_four_images(tmp_path):
    """Both images come back from the sheared one, also with averaged weights and running statistics."""
    net = UnshearNet(size=32, widths=(8, 16, 16), pose_channels=16, shear_channels=16)
    four = small.pair(7, 4, 32)
    steps = {"epochs": 450, "batch": 4, "learning_rate": 5e-3, "validate_every": 225}
    training = Training(**steps, crops=10, crop_px=8, ema_decay=0.9)
    data = trainer.TrainingData(lambda start: itertools.repeat(four), lambda: iter([four]), 4)
    trainer.train(make_unshear_task(net, training), training, data, 0, tmp_path)
    variables = checkpoint.load_best(tmp_path)
    sheared, canonical = (
        jnp.asarray(four[name] / 255, jnp.float32) for name in ("sheared", "canonical")
    )
    unsheared = unshearnet.unshear(net, variables, sheared)
    assert float(jnp.mean((unsheared - canonical) ** 2)) < 0.01  # mean image: 0.12
    codes = unshearnet.encode(net, variables, sheared)
    again = jax.nn.sigmoid(unshearnet.decode_sheared(net, variables, *codes))
    assert float(jnp.mean((again - sheared) ** 2)) < 0.01
