"""Checkpoints: complete or refused."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.targets import make_range_targets, to_json
from jaxunshear.errors import UserError
from jaxunshear.training import checkpoint

STATE = {
    "step": jnp.asarray(5, jnp.int32),
    "average": {
        "params": {"E": {"kernel": jnp.arange(6000.0).reshape(60, 100)}},
        "batch_stats": {"E": {"mean": jnp.ones(3)}},
    },
}
RECORD = {"history": [], "best_step": 5, "train_seconds": 1.0, "compile_seconds": 0.0}


@pytest.fixture
def folder(tmp_path):
    checkpoint.save(tmp_path, 5, STATE, RECORD)
    return tmp_path


def test_there_and_back(folder):
    assert checkpoint.find_latest_step(folder) == 5
    state, record = checkpoint.restore(folder, 5, STATE)
    assert record["best_step"] == 5
    np.testing.assert_array_equal(get_kernel(state), get_kernel(STATE))
    assert state["step"].dtype == jnp.int32
    variables = checkpoint.load_best(folder)
    assert set(variables) == {"params", "batch_stats"}
    np.testing.assert_array_equal(variables["batch_stats"]["E"]["mean"], 1)


def test_the_latest_and_the_best_are_kept_and_listed_latest_first(folder):
    assert checkpoint.list_kept_steps(folder / "nothing") == []
    checkpoint.save(folder, 6, STATE, RECORD)
    checkpoint.save(folder, 7, STATE | {"step": jnp.asarray(7)}, RECORD)
    assert checkpoint.list_kept_steps(folder) == [7, 5]
    assert {path.name for path in (folder / "checkpoints").iterdir()} == {"00000005", "00000007"}


def files(folder):
    root = folder / "checkpoints" / "00000005"
    return sorted(path for path in root.rglob("*") if path.is_file() and path.stat().st_size)


def get_kernel(state):
    return state["average"]["params"]["E"]["kernel"]


@pytest.mark.parametrize("damage", ["cut", "change", "remove"])
def test_no_damage_goes_unseen(folder, tmp_path_factory, damage):
    """Of each file: either everything is still read as it was, or one line. Of the arrays' files
    it is our own: Orbax' threads would say much."""
    refused = []
    for number in range(len(files(folder))):
        copy = tmp_path_factory.mktemp("copy") / "run"
        shutil.copytree(folder, copy)
        path = files(copy)[number]
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data if damage == "change" else data[: len(data) // 2])
        if damage == "remove":
            path.unlink()
        try:
            state, _ = checkpoint.restore(copy, 5, STATE)
        except UserError as error:
            refused.append((path.parts, str(error)))
        else:
            np.testing.assert_array_equal(*(get_kernel(each) for each in (state, STATE)))
    assert len(refused) >= 2
    for place, line in refused:
        assert "run/checkpoints/00000005" in line and "delete" in line and "\n" not in line
        assert "state" not in place or "its files are not those" in line


@pytest.mark.parametrize(
    ("step", "way"),
    [(6, ".*00000006 to go on from the one before"), (5, "{folder} to train from the start")],
)
def test_damage_names_the_way_back_if_there_is_one(folder, step, way):
    checkpoint.save(folder, 6, STATE, RECORD)
    (folder / "checkpoints" / f"0000000{step}" / "record.json").write_text("{")
    with pytest.raises(
        UserError, match=f"0000000{step} is damaged.*: delete {way.format(folder=folder)}"
    ):
        checkpoint.restore(folder, step, STATE)


def test_another_network_is_refused(folder):
    with pytest.raises(UserError, match="does not fit this network"):
        checkpoint.restore(folder, 5, STATE | {"more": jnp.ones(2)})


def test_no_model(tmp_path):
    for read in (checkpoint.load_best, checkpoint.read_net):
        with pytest.raises(UserError, match="holds no trained model"):
            read(tmp_path)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "checkpoints").write_text("a file")
    with pytest.raises(UserError, match="cannot write checkpoint"):
        checkpoint.save(tmp_path, 5, STATE, RECORD)


@pytest.mark.parametrize(
    ("kind", "net"), [("unshear", UnshearNet(size=64, widths=(3, 4))), ("posenet", PoseNet())]
)
def test_settings_there_and_back(tmp_path, kind, net):
    checkpoint.write_settings(tmp_path, {"kind": kind, "net": net.__dict__})
    checkpoint.write_settings(tmp_path, {"kind": kind, "net": net.__dict__})
    assert checkpoint.read_net(tmp_path) == net
    with pytest.raises(UserError, match=r"net\.size"):
        checkpoint.write_settings(tmp_path, {"kind": kind, "net": net.__dict__ | {"size": 8}})


def test_a_posenet_gives_its_targets_and_others_may(tmp_path):
    targets = make_range_targets((), Ranges())
    for name, more in (("known", {"targets": to_json(targets)}), ("older", {})):
        for kind in ("posenet", "unshear"):
            checkpoint.write_settings(tmp_path / name / kind, {"kind": kind, **more})
    for name, expected in (
        ("known/posenet", targets),
        ("known/unshear", targets),
        ("older/unshear", ()),
    ):
        assert checkpoint.read_targets(tmp_path / name) == expected
    with pytest.raises(
        UserError, match=r"posenet.model\.json states no pose targets .*: train again"
    ):
        checkpoint.read_targets(tmp_path / "older" / "posenet")


@pytest.mark.parametrize("text", ["", "[]", '{"kind": "other"}', '{"kind": "unshear", "net": {}}'])
def test_broken_settings_are_refused(tmp_path, text):
    (tmp_path / "model.json").write_text(text)
    with pytest.raises(UserError, match=r"model\.json"):
        checkpoint.read_net(tmp_path)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "not enough memory"),
        (PermissionError(13, "Permission denied"), "Permission"),
    ],
)
def test_nobody_is_asked_to_delete_what_the_machine_could_not_read(
    folder, monkeypatch, error, said
):
    def refuse(*_):
        raise error

    monkeypatch.setattr(checkpoint.ocp.Checkpointer, "restore", refuse)
    with pytest.raises(UserError, match=said) as refusal:
        checkpoint.load_best(folder)
    assert "to train from the start" not in str(refusal.value)
