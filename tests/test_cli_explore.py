"""`jaxunshear explore`: what it needs, and what it refuses before it works."""

import socket

import pytest


def test_without_the_extra_one_line_names_it(command, absent):
    absent("nicegui")
    answer = command("explore")
    assert answer.code == 2 and "`explore`" in answer.err and answer.err.count("\n") == 1


def test_ports_that_cannot_be_had(command):
    pytest.importorskip("nicegui", reason="needs the extra `explore`")
    assert "--port 0" in command("explore", "--port", 0).err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        answer = command("explore", "--port", taken.getsockname()[1])
    assert answer.code == 2 and "name another" in answer.err
