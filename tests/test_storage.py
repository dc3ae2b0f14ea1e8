"""Files appear whole or not at all, and every failure names its path."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from jaxunshear import storage
from jaxunshear.errors import UserError


def test_json_round_trip_of_arrays_paths_and_nan(tmp_path):
    path = tmp_path / "deep" / "results.json"
    storage.write_json(path, {"a": np.float32(0.5), "b": np.arange(3), "c": (float("nan"), np.inf), "d": Path("x")})
    assert storage.read_json(path) == {"a": 0.5, "b": [0, 1, 2], "c": [None, None], "d": "x"}
    assert os.listdir(path.parent) == ["results.json"]


def test_what_is_not_json_is_refused_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "results.json"
    storage.write_json(path, 1)
    with pytest.raises(TypeError, match="object"):
        storage.write_json(path, object())
    assert storage.read_json(path) == 1


def test_full_disk_keeps_the_old_file_and_names_the_new(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    storage.write_text(path, "old")

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match=r"results\.json: the disk is full"):
        storage.write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["results.json"]


def test_a_file_where_a_folder_should_be(tmp_path):
    (tmp_path / "runs").write_text("")
    with pytest.raises(UserError, match="runs"):
        storage.write_text(tmp_path / "runs" / "a", "x")


@pytest.mark.parametrize("content", [b"{", b"", b"\xff\xfe"])
def test_corrupt_json_names_file_and_remedy(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"results\.json .*make it again"):
        storage.read_json(path)


def test_missing_json_names_file(tmp_path):
    with pytest.raises(UserError, match=r"none\.json: No such file"):
        storage.read_json(tmp_path / "none.json")
