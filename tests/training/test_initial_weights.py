"""Training that goes on from weights there are."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.configs import compute_fingerprint
from jaxunshear.config.data import PairedData, Recorded, RecordedTaps
from jaxunshear.config.experiment import Experiment, list_further_tests
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.serialization import RELEASED, load_settings
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import write_json
from jaxunshear.models import unshearnet
from jaxunshear.training import checkpoint, trainer
from jaxunshear.training.provenance import (
    InitialWeights,
    check_origin,
    check_unseen,
    list_training_digests,
    replace_weights,
    start_folder,
)
from tests.helpers.network_parts import drop_parts
from tests.training import small


def tree(value, **shapes):
    return {"params": {name: {"kernel": jnp.full(shape, value)} for name, shape in shapes.items()}}


def test_what_both_have_is_taken_and_nothing_else():
    found = replace_weights(tree(0.0, E=(2, 3), DS=(4,)), tree(1.0, E=(2, 3), other=(5,)))
    expected = {"E": {"kernel": np.ones((2, 3))}, "DS": {"kernel": np.zeros(4)}}
    jax.tree.map(np.testing.assert_array_equal, found, {"params": expected})


@pytest.mark.parametrize(
    ("start", "line"),
    [
        (tree(1.0, E=(3, 2)), r"params.E.kernel of these"),
        (
            {"params": {"E": {"kernel": np.ones((2, 3)), "Same_0": np.ones(3)}}},
            "params.E.Same_0 of",
        ),
        (tree(1.0, other=(2, 3)), "no part of these"),
        ({}, "no part of these"),
    ],
)
def test_weights_that_do_not_fit_are_refused(start, line):
    with pytest.raises(UserError, match=line):
        replace_weights(tree(0.0, E=(2, 3)), start)


NETWORK = "disentangled"
SIMULATED = Experiment(name="small", claim="none", networks=(NETWORK,), other_jitters_mm=(1.0,))
RECORDED = replace(
    SIMULATED, paired=Recorded(digest="aa+pcc+bb"), pose=RecordedTaps(), other_jitters_mm=()
)


def beginning(experiment, folder):
    return replace(experiment, train=replace(experiment.train, start=str(folder)))


def keep(folder, **model):
    write_json(folder / NETWORK / "model.json", model)
    return folder / NETWORK


def test_what_was_learnt_through_others_is_known(tmp_path):
    first = keep(tmp_path / "first", data=list_training_digests(SIMULATED, NETWORK, None))
    second = keep(tmp_path / "second", data=list_training_digests(RECORDED, NETWORK, first))
    pairs, taps = (
        compute_fingerprint(each, SIMULATED.sensor) for each in (SIMULATED.paired, SIMULATED.pose)
    )
    assert json.loads((second / "model.json").read_text())["data"] == sorted(["aa", "bb", pairs])
    losses = {**SIMULATED.train.losses, "pose_tap": 0.5}
    taught = replace(SIMULATED, train=replace(SIMULATED.train, losses=losses))
    assert list_training_digests(taught, NETWORK, None) == sorted([pairs, taps])
    with pytest.raises(
        UserError, match=rf"second/{NETWORK} learnt from .* tested \(digest bb\): use"
    ):
        check_unseen(second, ["bb", "cc"])
    check_unseen(second, ["cc"])


def test_weights_are_refused_if_they_learnt_from_what_is_tested(tmp_path):
    """Sets of one seed share their splits, recordings may have been split otherwise."""
    (test,) = list_further_tests(SIMULATED).values()
    folder = keep(tmp_path, data=list_training_digests(SIMULATED, NETWORK, None))
    for experiment in (SIMULATED, RECORDED):
        assert start_folder(beginning(experiment, tmp_path), NETWORK) == folder
    tested = compute_fingerprint(test, SIMULATED.sensor)
    for experiment, digest in ((SIMULATED, tested), (RECORDED, "bb")):
        keep(tmp_path, data=[digest])
        with pytest.raises(UserError, match=digest):
            start_folder(beginning(experiment, tmp_path), NETWORK)


def test_weights_that_do_not_say_what_they_learnt_from_are_refused(tmp_path):
    keep(tmp_path, kind="unshear")
    with pytest.raises(UserError, match=r"learnt from unknown data \(files of version 0\.2\.0"):
        start_folder(beginning(SIMULATED, tmp_path), NETWORK)
    with pytest.raises(UserError, match=f"start: nowhere holds no {NETWORK}"):
        start_folder(beginning(SIMULATED, "nowhere"), NETWORK)
    assert start_folder(SIMULATED, NETWORK) is None


def test_a_network_of_other_data_is_refused_by_what_differs(tmp_path):
    own = open_source(SIMULATED).describe_origin(resolve_network(SIMULATED, NETWORK))
    keep(tmp_path, origin=own)
    check_origin(SIMULATED, NETWORK, tmp_path)
    with pytest.raises(UserError, match=r"another settings\.seed: give another --out"):
        check_origin(replace(SIMULATED, paired=PairedData(seed=7)), NETWORK, tmp_path)
    keep(tmp_path, origin=own | {"version": "2.4.0"})
    with pytest.raises(UserError, match="another version"):
        check_origin(SIMULATED, NETWORK, tmp_path)


@pytest.mark.parametrize("name", ["standard", "skin"])
def test_released_weights_say_what_they_learnt_from(name):
    experiment = load_settings(RELEASED / name)
    for model in (RELEASED / name).glob("*/model.json"):
        expected = list_training_digests(experiment, model.parent.name, None)
        assert json.loads(model.read_text())["data"] == expected


def trained(folder, start):
    """One step so short that weights stay where they begin."""
    still = {"learning_rate": 1e-12, "ema_decay": 0.0, "l1": 0.0, "l2": 0.0}
    training = replace(small.TRAINING, epochs=0.25, **still)
    return small.train(folder, training=training, provenance=trainer.Provenance(start=start))


@pytest.mark.long
def test_a_training_goes_on_from_released_weights_and_knows_which(tmp_path):
    """Those hold E, the pose code and DC: the rest is as fresh as without them."""
    there = unshearnet.init(small.NET, jax.random.key(5))
    released = drop_parts(there, "shear", "DS")
    trained(tmp_path / "started", InitialWeights(released, "of these"))
    trained(tmp_path / "fresh", None)
    found, fresh = (
        checkpoint.load_best(tmp_path / name)["params"] for name in ("started", "fresh")
    )
    origin = {**dict.fromkeys(("E", "pose", "DC"), there["params"]), "shear": fresh, "DS": fresh}
    for module, params in origin.items():
        for a, b in zip(*map(jax.tree.leaves, (found[module], params[module])), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
    assert not np.allclose(found["E"]["First_0"]["kernel"], fresh["E"]["First_0"]["kernel"])
    assert json.loads((tmp_path / "started" / "model.json").read_text())["start"] == "of these"
    assert "start" not in json.loads((tmp_path / "fresh" / "model.json").read_text())
    with pytest.raises(UserError, match="start = of these, now others"):
        trained(tmp_path / "started", InitialWeights(released, "others"))


def test_a_network_of_other_data_is_refused(tmp_path):
    own = open_source(SIMULATED).describe_origin(resolve_network(SIMULATED, "disentangled"))
    write_json(tmp_path / "disentangled" / "model.json", {"origin": own})
    check_origin(SIMULATED, "disentangled", tmp_path)
    other = replace(SIMULATED, paired=PairedData(seed=7))
    with pytest.raises(UserError, match=r"another settings\.seed: give another --out"):
        check_origin(other, "disentangled", tmp_path)
    write_json(tmp_path / "disentangled" / "model.json", {"origin": own | {"version": "2.4.0"}})
    with pytest.raises(UserError, match="another version"):
        check_origin(SIMULATED, "disentangled", tmp_path)
