"""The process asks for large pages once, and only where it may."""

import os
import sys

import pytest

from jaxunshear.memory import restart_with_large_pages


@pytest.fixture
def restarts(monkeypatch):
    made = []
    monkeypatch.setattr(os, "execv", lambda *call: made.append(call))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", "jaxunshear", "stimuli"])
    monkeypatch.setenv("GLIBC_TUNABLES", "")
    monkeypatch.delenv("GLIBC_TUNABLES")
    return made


def test_the_same_command_runs_once_more(restarts):
    restart_with_large_pages()
    assert restarts == [(sys.executable, [sys.executable, "-X", "dev", "-m", "jaxunshear", "stimuli"])]
    assert os.environ["GLIBC_TUNABLES"] == "glibc.malloc.hugetlb=1"
    restart_with_large_pages()
    assert len(restarts) == 1


def test_a_setting_of_the_user_stays(restarts, monkeypatch):
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.arena_max=1")
    restart_with_large_pages()
    assert not restarts and os.environ["GLIBC_TUNABLES"] == "glibc.malloc.arena_max=1"


@pytest.mark.parametrize(("name", "value"), [("platform", "darwin"), ("orig_argv", ["python"])])
def test_nothing_happens_elsewhere(restarts, monkeypatch, name, value):
    monkeypatch.setattr(sys, name, value)
    restart_with_large_pages()
    assert not restarts and "GLIBC_TUNABLES" not in os.environ
