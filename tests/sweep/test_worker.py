"""The outcome of a task in this process."""

import errno
from pathlib import Path

import pytest

from jaxunshear.config import losses, types
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.load import run_file
from jaxunshear.config.serialization import to_json
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
    assert reported.endswith("then run the same command with --retry-failed")
    passed_on = UserError(f"its posenet, which other rows share, failed: {reported}")
    assert reason("row", passed_on).count("--retry-failed") == 1


def test_data_that_failed_are_tried_again_by_the_same_command(reason):
    assert reason("data", FULL).endswith("then run the same command")


def test_losses_of_an_experiment_file_are_known_to_the_process_of_a_row(tmp_path, monkeypatch):
    monkeypatch.setattr(losses, "LOSSES", dict(losses.LOSSES))
    monkeypatch.setattr(types, "REGISTERED", {})
    file = tmp_path / "mine.py"
    file.write_text(
        "from jaxunshear.config.losses import register_loss\n"
        "@register_loss('mine')\n"
        "def compute(inputs):\n    return inputs.outputs.canonical.sum((1, 2, 3))\n"
    )
    run_file(file)
    assert types.list_registering_files() == [str(file)]
    del losses.LOSSES["mine"]
    settings = to_json(Experiment(name="a", claim="b"))
    order = TaskOrder(kind="row", experiment=settings, files=[str(file)])
    worker._start_task(order, tmp_path)
    assert losses.get_loss("mine").name == "mine"
