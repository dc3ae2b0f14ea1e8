"""Files appear complete or not at all, locks have one holder; every failure names its path."""

import contextlib
import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear import files
from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock
from jaxunshear.output_checks import check_new_file


def test_json_round_trip_of_arrays_paths_and_nan(tmp_path):
    path = tmp_path / "deep" / "results.json"
    values = (np.float32(0.5), np.arange(3), (float("nan"), np.inf), Path("x"))
    files.write_json(path, dict(zip("abcd", values, strict=True)))
    assert files.read_json(path) == {"a": 0.5, "b": [0, 1, 2], "c": [None, None], "d": "x"}
    assert os.listdir(path.parent) == ["results.json"]


def test_full_disk_keeps_the_old_file_and_names_the_new(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    files.write_text(path, "old")

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match=r"results\.json: the disk is full"):
        files.write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["results.json"]


@pytest.fixture
def pipe(tmp_path):
    """Its path, and a function that gives what was written into it; stands for a device."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    end = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    yield path, lambda: os.read(end, 2**16)
    os.close(end)


@pytest.mark.parametrize("linked", [False, True])
def test_a_pipe_is_written_into_and_stays(tmp_path, pipe, linked):
    path, written = pipe
    link = tmp_path / "link"
    link.symlink_to(path)
    check_new_file(link if linked else path)
    files.write_json(link if linked else path, {"a": 1})
    assert path.is_fifo() and link.is_symlink() and len(os.listdir(tmp_path)) == 2
    assert files.check_and_remove_checksum(json.loads(written())) == {"a": 1}


def test_a_command_writes_its_rows_into_a_pipe(command, tmp_path, pipe):
    Image.fromarray(np.eye(64, dtype=np.uint8) * 255).save(tmp_path / "image.png")
    answer = command("doctor", tmp_path / "image.png", "--json", pipe[0])
    assert answer.code == 0, answer.err
    assert pipe[0].is_fifo() and "versions" in json.loads(pipe[1]())


@pytest.mark.parametrize("there", [True, False])
def test_links_are_followed_and_stay(tmp_path, there):
    (tmp_path / "far").mkdir()
    far, path = tmp_path / "far" / "results.json", tmp_path / "results.json"
    path.symlink_to(far)
    if there:
        far.write_text("old")
    files.write_json(path, 1)
    assert path.is_symlink() and far.read_text() == "1\n"
    assert os.listdir(far.parent) == ["results.json"] and len(os.listdir(tmp_path)) == 2


@pytest.mark.parametrize("content", [b"{", b"", b"\xff\xfe"])
def test_corrupt_json_names_file_and_remedy(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"results\.json .*make it again"):
        files.read_json(path)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError(), "there is not enough memory"),
        (PermissionError(errno.EACCES, "Permission denied"), "Permission denied"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
    ],
)
def test_what_the_machine_lacks_is_no_damage_of_the_file(error, line):
    wrapped = ValueError("a library's own")
    wrapped.__cause__ = error
    for each in (error, wrapped):
        with pytest.raises(UserError, match=f"cannot read runs: {line}"):
            files.raise_machine_error(Path("runs"), each)
    files.raise_machine_error(Path("runs"), ValueError("bad header"))  # may be damage


def test_a_file_not_worth_stopping_for_is_read_if_it_is_sound(tmp_path):
    path = tmp_path / "times.json"
    assert files.read_object_if_sound(path) is None
    for text in ("{", "[1]"):
        path.write_text(text)
        assert files.read_object_if_sound(path) is None
    files.write_json(path, {"data": 1.0})
    assert files.read_object_if_sound(path) == {"data": 1.0}


@pytest.mark.parametrize(("text", "kind"), [("[]", "list"), ("null", "NoneType")])
def test_what_is_no_object_is_refused_where_one_is_read(tmp_path, text, kind):
    path = tmp_path / "experiment.json"
    path.write_text(text)
    with pytest.raises(UserError, match=f"experiment.json holds no JSON object but a {kind}"):
        files.read_object(path)


def test_a_flipped_bit_is_never_another_figure(tmp_path):
    """Every bit of a file: a digit that became another, a name that did, the seal's own."""
    path, held = tmp_path / "results.json", {"edge_mm": 0.125, "ok": True, "of": [1, None]}
    files.write_json(path, held)
    sound, refused = path.read_bytes(), 0
    for bit in range(8 * len(sound)):
        damaged = bytearray(sound)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            assert files.read_json(path) == held
        except UserError as error:
            refused += "results.json" in str(error) and "make it again" in str(error)
    assert refused > 0.8 * 8 * len(sound)


def test_what_bears_no_seal_is_read_and_what_is_written_again_is_sealed_anew(tmp_path):
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"a": 1}))
    assert files.read_json(path) == {"a": 1}
    files.write_json(path, files.read_json(path) | {"b": [0.5, float("nan")]})
    files.write_json(path, json.loads(path.read_text()) | {"c": 2})  # with the old seal in it
    assert files.read_json(path) == {"a": 1, "b": [0.5, None], "c": 2}
    path.write_text(path.read_text().replace("0.5", "0.7"))
    with pytest.raises(UserError, match=r"its checksum differs.* delete its line 'checksum'"):
        files.read_json(path)


def test_no_bit_of_an_npz_turns_over_unseen():
    buffer = io.BytesIO()
    image = np.arange(9 * 128 * 128, dtype=np.uint8).reshape(9, 128, 128)
    np.savez_compressed(buffer, image=image)
    stored = bytearray(buffer.getvalue())
    unseen = []
    # the headers of zip and numpy; np.load alone reads another array after some of these
    for bit in range(8 * 200):
        stored[bit // 8] ^= 1 << bit % 8
        with contextlib.suppress(*files.BROKEN_NPZ):
            read = files.read_npz(io.BytesIO(stored))
            unseen += [bit] * (read.keys() != {"image"} or not np.array_equal(read["image"], image))
        stored[bit // 8] ^= 1 << bit % 8
    assert unseen == [] and np.array_equal(files.read_npz(io.BytesIO(stored))["image"], image)


HOLD = """
import sys
from pathlib import Path
from jaxunshear.files import hold_lock
with hold_lock(Path(sys.argv[1]), wait=False) as free:
    print(free, flush=True)
    sys.stdin.read()
"""


def holder(path):
    words = [sys.executable, "-c", HOLD, str(path)]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_a_lock_is_another_processs_until_it_is_killed(tmp_path):
    path = tmp_path / "folder" / ".lock"
    with holder(path) as other:
        assert other.stdout.readline() == "True\n"
        with hold_lock(path, wait=False) as free:
            assert not free
        other.kill()
        with hold_lock(path, wait=True) as free:
            assert free
    assert path.read_bytes() == b""


def test_an_error_in_it_is_not_taken_for_one_of_the_lock_and_frees_it(tmp_path):
    with pytest.raises(OSError, match="of the work"), hold_lock(tmp_path / ".lock", wait=False):
        raise OSError("of the work")
    with hold_lock(tmp_path / ".lock", wait=False) as free:
        assert free


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    Path(tmp_path / "file").write_text("")
    with (
        pytest.raises(UserError, match=r"cannot write .*lock: "),
        hold_lock(tmp_path / "file" / ".lock", wait=False),
    ):
        pass
