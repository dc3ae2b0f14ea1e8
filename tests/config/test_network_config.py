"""The config of a network holds what decides its weights, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear import run
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import replace_field
from jaxunshear.config.network_config import (
    list_required_networks,
    list_trained_networks,
    resolve_network,
)
from jaxunshear.config.networks import ALL_NETWORKS, RENDERER, TEACHER, TRAINABLE, UnshearNet
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.data.sources import open_source
from jaxunshear.fit import BASE_EXPERIMENT as RECORDED

BASE = Experiment(name="plain", claim="none", networks=("disentangled", "posenet"))
TAUGHT = replace_field(BASE, "train.losses.pose_tap", 1.0)
PINS = replace(BASE, unshear=UnshearNet(input="pins"))
RECORDED_PINS = replace_field(RECORDED, "unshear.input", "pins")
READ = replace_field(RECORDED_PINS, "paired.unlabelled", "pseudo_label")
RECORDED_NETWORKS = (RENDERER, TEACHER, "posenet", "posenet_sheared", "disentangled")


def change(experiment, **fields):
    for name, value in fields.items():
        experiment = replace_field(experiment, name.replace("__", "."), value)
    return experiment


@pytest.mark.parametrize(
    ("base", "fields", "concerned"),
    [
        (BASE, {"unseen": ("flower",), "networks": ("posenet",), "other_twists_deg": (5.0,)}, ""),
        (BASE, {"name": "other", "claim": "other", "train_pins__epochs": 9.0}, ""),
        (BASE, {"seed": 6}, "entangled unet disentangled posenet posenet_sheared"),
        (BASE, {"sensor": replace(TACTIP_331, rings=8)}, " ".join(ALL_NETWORKS)),
        (BASE, {"targets": ("x_mm",)}, " ".join(ALL_NETWORKS)),
        (BASE, {"paired__poses": 50}, "entangled unet disentangled posenet_sheared"),
        (BASE, {"pose__poses": 50}, "posenet"),
        (BASE, {"train__epochs": 9.0}, "entangled unet disentangled"),
        (BASE, {"train_posenet__epochs": 9.0}, "posenet posenet_sheared"),
        (BASE, {"train_teacher__epochs": 9.0}, TEACHER),
        (BASE, {"posenet__hidden": 7}, f"posenet posenet_sheared {TEACHER}"),
        (BASE, {"unshear__pose_channels": 8, "unshear__shear_channels": 120}, "disentangled"),
        (TAUGHT, {"train_teacher__epochs": 9.0}, f"disentangled {TEACHER}"),
        (TAUGHT, {"train_posenet__epochs": 9.0}, "posenet"),
        (TAUGHT, {"posenet__hidden": 7}, f"disentangled posenet {TEACHER}"),
        (PINS, {"paired__ranges__twist_deg": 5.0}, "entangled disentangled posenet_sheared"),
        (PINS, {"pose__ranges__tilt_deg": 5.0}, f"posenet {TEACHER} entangled disentangled"),
        (PINS, {"pins__rotated_share": 0.5}, "posenet disentangled"),
        (RECORDED_PINS, {"paired__labelled": 0.1}, "posenet_sheared disentangled"),
        (RECORDED_PINS, {"paired__unlabelled": "pseudo_label"}, "disentangled"),
        (RECORDED_PINS, {"paired__pairing": "nearest"}, "disentangled"),
        (RECORDED_PINS, {"paired__direct_taps": "recorded"}, "posenet_sheared"),
        (RECORDED_PINS, {"pins__direct_conv_channels": (8,)}, "posenet_sheared"),
        (RECORDED_PINS, {"pins__rotated_share": 0.5}, "posenet_sheared"),
        (READ, {"paired__direct_taps": "rendered"}, "posenet_sheared disentangled"),
        (READ, {"pins__direct_conv_channels": (8,)}, "posenet_sheared disentangled"),
    ],
)
def test_a_setting_concerns_the_networks_that_use_it(base, fields, concerned):
    other = change(base, **fields)
    names = RECORDED_NETWORKS if base.paired.source == RECORDED.paired.source else ()
    for name in names or {*concerned.split(), "disentangled", "posenet"}:
        one, two = resolve_network(base, name), resolve_network(other, name)
        assert (one.digest == two.digest) == (name not in concerned.split()), name


@pytest.mark.parametrize("field", ["labelled", "unlabelled", "pairing", "direct_taps"])
def test_the_origin_of_a_network_says_how_it_uses_recordings(field):
    value = {"labelled": 0.1, "unlabelled": "pseudo_label", "pairing": "nearest"}.get(
        field, "recorded"
    )
    other = replace_field(RECORDED_PINS, f"paired.{field}", value)
    for name in RECORDED_NETWORKS:
        origins, sources = [], []
        for experiment in (RECORDED_PINS, other):
            config = resolve_network(experiment, name)
            origins.append(open_source(experiment).describe_origin(config))
            sources.append(config.source)
        assert (origins[0] == origins[1]) == (sources[0] == sources[1]), name


def test_a_teacher_is_trained_before_the_networks_that_it_teaches():
    taught = replace(TAUGHT, networks=("unet", "posenet"))
    assert list_trained_networks(BASE) == BASE.networks
    assert list_trained_networks(taught) == (TEACHER, "unet", "posenet")
    assert list_trained_networks(replace(taught, networks=("posenet",))) == ("posenet",)
    for experiment, network, required in (
        (BASE, "disentangled", ("disentangled",)),
        (TAUGHT, "posenet", ("posenet",)),
        (TAUGHT, "disentangled", (TEACHER, "disentangled")),
        (READ, "disentangled", (RENDERER, TEACHER, "posenet_sheared", "disentangled")),
    ):
        assert list_required_networks(resolve_network(experiment, network)) == required


@pytest.fixture
def record_training(monkeypatch, tmp_path):
    """Return what `run_stages` asks of a training: its arguments, but for the folder."""
    from jaxunshear.data import stored_sets
    from jaxunshear.training import examples, trainer

    class Reader:
        def train_batches(self, *words):
            self.words = words
            return lambda start: iter(())

        def split(self, *words):
            return iter([{name: np.zeros((1, 1)) for name in words[2]}])

        def length(self, split):
            return 10

    def record(experiment, network):
        calls = []

        def train(task, training, data, seed, folder, provenance):
            fields = [sorted(batch) for batch in data.validation()]
            learnt = (task.kind, task.net, task.targets, task.weights)
            calls.append((learnt, training, seed, fields, data.epoch_images, provenance))
            counts = dict.fromkeys(("steps", "parameters", "best_step"), 1)
            measured = ("best_loss", "train_seconds", "images_per_second")
            return trainer.TrainingSummary(**counts, **dict.fromkeys(measured, 1.0))

        def open_set(*words):
            calls.append(words)
            return Reader()

        monkeypatch.setattr(stored_sets, "open_set", open_set)
        monkeypatch.setattr(examples, "open_set", open_set)
        monkeypatch.setattr(trainer, "train", train)
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        run.run_stages(experiment, (network,), out, tmp_path, "none")
        return calls

    return record


@pytest.mark.parametrize("network", [name for name in TRAINABLE if name != RENDERER])
def test_networks_of_one_digest_have_one_training(record_training, network):
    fields = {
        "targets": ("yaw_deg", "y_mm"),
        "paired__poses": 50,
        "train__epochs": 7.0,
        "train_posenet__epochs": 9.0,
        "train_teacher__epochs": 11.0,
        "unshear__pose_channels": 7,
        "unseen": ("flower",),
    }
    trainings = {}
    for name, value in fields.items():
        other = change(BASE, **{name: value})
        training = record_training(other, network)
        digest = resolve_network(other, network).digest
        assert trainings.setdefault(digest, training) == training
    assert 2 <= len(trainings) < len(fields)
