"""Locks have one holder at a time, and are free again however the holder ends."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock

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
