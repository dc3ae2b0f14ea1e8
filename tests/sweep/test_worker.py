"""The outcome of a task in this process."""

import errno
from pathlib import Path

import pytest

from jaxunshear.errors import UserError
from jaxunshear.files import explain_os_error
from jaxunshear.sweep import worker
from jaxunshear.sweep.tasks import TaskOrder

FULL = explain_os_error(Path("somewhere"), OSError(errno.ENOSPC, "No space left on device"))


@pytest.fixture
def reason(monkeypatch, tmp_path):
    """`reason(kind, error)` of a task of that kind which ends with that error."""

    def report(kind, error):
        def refuse(*_):
            raise error

        functions = {"data": "_make_data", "training": "_run_trainings", "row": "_run_row"}
        monkeypatch.setattr(worker, functions[kind], refuse)
        outcome = worker.run_order(TaskOrder(kind=kind), tmp_path)
        assert outcome.status == "failed" and outcome.wall_seconds >= 0
        return outcome.reason

    return report


@pytest.mark.parametrize("kind", ["training", "row"])
def test_a_stored_failure_names_the_command_that_tries_it_again(reason, kind):
    reported = reason(kind, FULL)
    assert reported.endswith(
        "the disk is full; free some space, then run the same command with --retry-failed"
    )
    assert (
        reason("row", UserError(f"its posenet, which other rows share, failed: {reported}")).count(
            "--retry-failed"
        )
        == 1
    )


def test_data_that_failed_are_tried_again_by_the_same_command(reason):
    assert reason("data", FULL).endswith("then run the same command")
