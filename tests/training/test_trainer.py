"""Training: it learns, continues bit for bit after any stop, and stops with one line where it must."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
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

sys.path.insert(0, str(Path(__file__).parent))
import small


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


def unshear(folder, batches=None, validation=None, net=small.NET, training=small.TRAINING):
    data = trainer.TrainingData(
        batches or (lambda start: small.endless(small.pair, start)),
        validation or (lambda: iter([small.pair(1000, 4), small.pair(1001, 3)])),
        small.IMAGES,
    )
    return trainer.train(make_unshear_task(net, training), training, data, 0, folder)


def test_summary_log_and_settings(straight):
    folder, summary = straight
    assert (summary.steps, summary.images) == (12, 48)
    assert summary.parameters == sum(
        x.size for x in jax.tree.leaves(checkpoint.load_best(folder)["params"])
    )
    log = lines(folder)
    assert [line["step"] for line in log] == [4, 8, 12]
    assert log[-1]["epoch"] == 3
    assert log[0]["train_seconds"] < log[-1]["train_seconds"] == summary.train_seconds
    assert set(log[0]["train"]) == {
        "supervised",
        "patch",
        "reconstruction",
        "regularisation",
        "gradient",
    }
    assert set(log[0]["validation"]) == {"supervised", "reconstruction"}
    kernels = list_kernels(checkpoint.load_best(folder)["params"])
    assert set(log[0]["kernels"]) == set(kernels)
    assert all(size > 0 for size in log[0]["kernels"].values())
    best = min(log, key=lambda line: line["validation"]["supervised"])
    assert (summary.best_step, summary.best_loss) == (
        best["step"],
        best["validation"]["supervised"],
    )
    assert checkpoint.read_net(folder) == small.NET


def test_a_finished_training_returns_at_once(straight):
    folder, summary = straight

    def none(start):
        raise AssertionError("no data are needed")

    assert unshear(folder, none) == summary


@pytest.mark.parametrize("at", [pytest.param(2, marks=pytest.mark.long), 7])
def test_stopped_and_resumed_gives_the_same_bits(straight, tmp_path, at):
    """Stopped before the first checkpoint, and between two."""
    with pytest.raises(Stop):
        unshear(tmp_path, lambda start: stopped(small.pair, start, at))
    resumed_from = []
    unshear(tmp_path, lambda start: resumed_from.append(start) or small.endless(small.pair, start))
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
        process.send_signal(signal.SIGKILL)
        process.wait()
    small.train(tmp_path)
    assert bits(tmp_path) == bits(straight[0])
    assert losses_of(tmp_path) == losses_of(straight[0])


def test_half_written_and_superfluous_checkpoints_are_swept_away(tmp_path):
    half = tmp_path / "checkpoints" / "00000004.part"
    half.mkdir(parents=True)
    (half / "record.json").write_text("{")
    unshear(tmp_path)
    kept = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    record = json.loads((tmp_path / "checkpoints" / "00000012" / "record.json").read_text())
    assert kept == {"00000012", f"{record['best_step']:08d}"}


def broken_from(step):
    def batches(start):
        for at, batch in enumerate(small.endless(small.pair, start), start):
            floats = {name: value / np.float32(255) for name, value in batch.items()}
            if at >= step:
                floats["canonical"][0, 3, 3] = np.nan
            yield floats

    return batches


def test_nan_in_a_batch_stops_with_step_and_term_and_keeps_the_last_good_checkpoint(tmp_path):
    with pytest.raises(UserError, match=r"patch, supervised not finite at step 7.*step 4 is kept"):
        unshear(tmp_path, broken_from(6))
    assert checkpoint.find_latest_step(tmp_path) == 4
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(checkpoint.load_best(tmp_path)))
    unshear(tmp_path, broken_from(10**9))  # with the data repaired it goes on
    assert (tmp_path / "summary.json").exists()


DIVERGING = dataclasses.replace(
    small.TRAINING, schedule="steps", drops=((1.5, 1e30),)
)  # from step 7 on


def test_a_diverging_training_leaves_the_checkpoint_of_an_undisturbed_one(tmp_path):
    """The batch is sound and the line says so; what is kept is, bit for bit, what a training that was stopped there holds."""
    with pytest.raises(UserError) as stop:
        unshear(tmp_path / "diverged", training=DIVERGING)
    line = str(stop.value)
    assert "step 4 is kept" in line
    assert "whose numbers are 0 to 255" in line
    assert "lower learning_rate" in line
    with pytest.raises(Stop):
        unshear(tmp_path / "sound", lambda start: stopped(small.pair, start, 6), training=DIVERGING)
    assert (
        checkpoint.find_latest_step(tmp_path / "diverged")
        == checkpoint.find_latest_step(tmp_path / "sound")
        == 4
    )
    assert bits(tmp_path / "diverged") == bits(tmp_path / "sound")
    variables = checkpoint.load_best(tmp_path / "diverged")
    images = jnp.asarray(small.dots(0, 2) / 255, jnp.float32)
    assert np.isfinite(unshearnet.unshear(small.NET, variables, images)).all()
    assert losses_of(tmp_path / "diverged") == losses_of(tmp_path / "sound")


def test_weights_thrown_away_by_the_step_before_a_checkpoint_are_not_kept(tmp_path):
    """The terms of that step come from before its update, and are finite."""
    overflowing = dataclasses.replace(
        small.TRAINING, schedule="steps", drops=((1.75, math.inf),)
    )  # from step 8 on
    with pytest.raises(
        UserError, match=r"stopped: params\S+ not finite at step 8, of batch 7 .*step 4 is kept"
    ):
        unshear(tmp_path, training=overflowing)
    assert checkpoint.find_latest_step(tmp_path) == 4
    assert [line["step"] for line in lines(tmp_path)] == [4]


def test_a_validation_that_is_never_finite_is_no_result(tmp_path):
    def validation():
        broken = {name: value / np.float32(255) for name, value in small.pair(1000, 4).items()}
        broken["canonical"][0] = np.nan
        return iter([broken])

    for _ in range(2):  # also when the same command is given again
        with pytest.raises(UserError, match=r"validation loss \(supervised\) was never finite"):
            unshear(tmp_path, validation=validation)
        assert not (tmp_path / "summary.json").exists()


def test_nan_in_validation_ranks_last(tmp_path):
    calls = []

    def validation():
        calls.append(1)
        broken = {name: value / np.float32(255) for name, value in small.pair(1000, 4).items()}
        if len(calls) != 2:
            broken["canonical"][:] = np.nan
        return iter([broken])

    assert unshear(tmp_path, validation=validation).best_step == 8
    assert lines(tmp_path)[0]["validation"]["supervised"] is None


def test_an_empty_validation_split_is_refused(tmp_path):
    with pytest.raises(UserError, match="validation split is empty"):
        unshear(tmp_path, validation=lambda: iter(()))


def test_other_settings_in_the_same_folder_are_refused(straight):
    other = dataclasses.replace(small.TRAINING, learning_rate=0.5)
    with pytest.raises(UserError, match=r"training.learning_rate = 0.001, now 0.5"):
        unshear(straight[0], training=other)


@pytest.mark.parametrize(
    ("net", "training", "word"),
    [
        (dataclasses.replace(small.NET, size=18), small.TRAINING, "size"),
        (dataclasses.replace(small.NET, pose_channels=0), small.TRAINING, "pose_channels = 0"),
        (dataclasses.replace(small.NET, shear_channels=-1), small.TRAINING, "shear_channels = -1"),
        (small.NET, dataclasses.replace(small.TRAINING, crop_px=40), "crop_px"),
        (small.NET, dataclasses.replace(small.TRAINING, crops=0), "crops: 0"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(tmp_path, net, training, word):
    with pytest.raises(UserError, match=word):
        unshear(tmp_path, net=net, training=training)


def test_posenet_trains_and_reports_errors_in_units(tmp_path):
    task = make_posenet_task(small.POSENET, small.POSENET_TRAINING, small.TARGETS)
    data = trainer.TrainingData(
        lambda start: small.endless(small.pose, start),
        lambda: iter([small.pose(1000, 4), small.pose(1001, 2)]),
        small.IMAGES,
    )
    summary = trainer.train(task, small.TRAINING, data, 0, tmp_path)
    assert summary.kind == "posenet"
    assert set(lines(tmp_path)[0]["validation"]) == {
        "pose",
        "x_mm",
        "yaw_deg",
        "edge_mm",
        "edge_deg",
    }
    assert checkpoint.read_net(tmp_path) == small.POSENET
    assert checkpoint.read_targets(tmp_path) == small.TARGETS


def test_schedules():
    cosine = make_schedule(Training(learning_rate=1.0), 100, 10)
    np.testing.assert_allclose([cosine(0), cosine(50), cosine(100)], [1, 0.5, 0], atol=1e-6)
    paper = Training(learning_rate=1e-4, schedule="steps", drops=((40, 0.2), (80, 0.1)))
    steps = make_schedule(paper, 1000, 10)
    np.testing.assert_allclose(
        [steps(399), steps(400), steps(799), steps(800)], [1e-4, 2e-5, 2e-5, 1e-5], rtol=1e-6
    )


@pytest.mark.long
def test_overfits_four_images(tmp_path):
    """Both images come back from the sheared one, also with averaged weights and running statistics."""
    net = UnshearNet(size=32, widths=(8, 16, 16), pose_channels=16, shear_channels=16)
    four = small.pair(7, 4, 32)
    training = Training(
        epochs=450,
        batch=4,
        learning_rate=5e-3,
        crops=10,
        crop_px=8,
        averaging=0.9,
        validate_every=225,
    )

    def same(start):
        while True:
            yield four

    data = trainer.TrainingData(same, lambda: iter([four]), epoch_images=4)
    trainer.train(make_unshear_task(net, training), training, data, 0, tmp_path)
    variables = checkpoint.load_best(tmp_path)
    sheared, canonical = (
        jnp.asarray(four[name] / 255, jnp.float32) for name in ("sheared", "canonical")
    )
    assert (
        float(jnp.mean((unshearnet.unshear(net, variables, sheared) - canonical) ** 2)) < 0.01
    )  # mean image: 0.12
    again = jax.nn.sigmoid(
        unshearnet.decode_sheared(net, variables, *unshearnet.encode(net, variables, sheared))
    )
    assert float(jnp.mean((again - sheared) ** 2)) < 0.01
