"""Words of command lines: misspelt, missing, doubled, empty, negative, huge, of another type."""

import shlex
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.serialization import RELEASED
from jaxunshear.errors import Note
from tests.conftest import Answer
from tests.inputs.cases import Case, run_each

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.py"
LEARNING_RATES = "--train.learning_rate or --train_posenet.learning_rate"


@dataclass
class Desk:
    """A working folder with an experiment, an image and a run, and the command line."""

    folder: Path
    command: Callable[..., Answer]
    runs: list[Any]  # the arguments of each run that was let through


@pytest.fixture
def desk(monkeypatch, tmp_path, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "experiments").mkdir()
    shutil.copy(DEMO, "experiments")
    shutil.copy(DEMO, "mine.py")
    Path("five.py").write_text("experiment = 5\n")
    Path("raises.py").write_text("raise ValueError(object())\n")
    Path("notes.csv").write_text("a,b\n1,2\n")
    Path("frames").mkdir()
    Path("frames", "a.png").write_bytes(b"no image")
    Image.fromarray(np.zeros((64, 64), np.uint8)).save("image.png")
    Path("README.md").write_text("of something else")
    Path("started").mkdir()
    shutil.copy(RELEASED / "skin" / "experiment.json", "started")
    runs: list[Any] = []
    stages = ModuleType("jaxunshear.run")
    stages.run_stages = lambda *given, **named: runs.append((given, named))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, stages.__name__, stages)
    return Desk(tmp_path, command, runs)


def refuse(line: str, *said: str) -> Callable[[Desk], None]:
    """Check that a command line is refused in one line with `said`, and leaves nothing."""

    def check(desk):
        before = sorted(desk.folder.rglob("*"))
        answer = desk.command(*shlex.split(line))
        assert (answer.code, answer.out, desk.runs) == (2, "", [])
        *shown, error = answer.err.splitlines()
        assert error.startswith("jaxunshear: error: ") and all(": " in each for each in shown)
        assert all(each in error for each in said), error
        assert " object at 0x" not in error
        assert sorted(desk.folder.rglob("*")) == before

    return check


def check_last_wins(desk):
    assert desk.command("run", "mine.py", "--train.epochs", "5", "--train.epochs=7").code == 0
    (((experiment, _), _),) = desk.runs
    assert experiment.train.epochs == 7


def check_hours(desk):
    with pytest.warns(Note, match=r"about 13,500 hours on two cores: use fewer epochs or poses"):
        assert desk.command("run", "mine.py", "--train.epochs", "1e6").code == 0
    assert len(desk.runs) == 1


def check_home(desk):
    assert desk.command("run", "mine.py", "--out=~/runs").code == 0
    ((_, named),) = desk.runs
    assert named["out"] == Path.home() / "runs"


# name of the input; command line; what its answer holds
REFUSED = [
    ("a command misspelt", "trian mine.py", "did you mean `train`?"),
    ("a command of an earlier version", "check verify --only x", "`python -m verification verify`"),
    ("a command of other tools", "eval runs/demo", "did you mean `evaluate`?"),
    ("a command of no meaning", "dance", "there is no command 'dance'; see `jaxunshear --help`"),
    ("an empty command", "''", "there is no command ''"),
    ("an option misspelt", "pose image.png --modle skin", "`pose` takes no --modle: did you mean"),
    ("an experiment's name", "run demo", "did you mean experiments/demo.py?"),
    ("an experiment's file", "train demo.py", "did you mean experiments/demo.py?"),
    ("a file without its ending", "run ./mine", "did you mean mine.py?"),
    ("a file that is not there", "run nowhere.py", "does not exist: name a Python file"),
    ("no file", "run", "required: EXPERIMENT"),
    ("an experiment as --sensor-from", "run mine.py --sensor-from mine.py", "is an experiment"),
    ("a folder as --sensor-from", "run mine.py --sensor-from frames", "is a folder: name a calib"),
    ("a source that is not there", "stream nowhere", "nowhere does not exist: name"),
    ("a source that is no image", "stream notes.csv", "is no image and no video"),
    (
        "untouched frames that are not there",
        "pose image.png --model standard --untouched nowhere",
        "nowhere does not exist",
    ),
    ("a lost pin", "fit --taps frames --without 12", "leaves out the pins that no frame shows"),
    ("a lost pin of no number", "pose image.png --without 12,x", "give numbers of pins"),
    ("a lost pin of networks over images", "pose image.png --model standard --without 3", "pins"),
    ("a lost pin that no sensor has", "doctor image.png --without 400", "from 0 to 330"),
    ("an empty file name", "run ''", "names nothing"),
    ("two files", "run mine.py mine.py", "unrecognized arguments: mine.py"),
    ("a number as experiment", "run five.py", "`experiment` is of type int, not Experiment"),
    ("a file that fails with an object", "run raises.py", "fails in line 1: ValueError: <object"),
    ("lr", "run mine.py --train.lr 0.1", "did you mean --train.learning_rate?"),
    ("lr of no group", "run mine.py --lr 0.1", f"did you mean {LEARNING_RATES}"),
    ("bs", "run mine.py --train.bs 8", "did you mean --train.batch?"),
    ("batch_size", "run mine.py --train.batch_size 8", "did you mean --train.batch?"),
    ("lr_schedule", "run mine.py --train.lr_schedule steps", "did you mean --train.drops?"),
    ("weight_decay", "run mine.py --train.weight_decay 1", "did you mean --train.l2?"),
    ("num_epochs", "run mine.py --train_pins.num_epochs 3", "did you mean --train_pins.epochs?"),
    ("optimizer", "run mine.py --train.optimizer adam", "did you mean --train.optimiser?"),
    ("latent_dim", "run mine.py --unshear.latent_dim 4", "did you mean --unshear.pose_channels?"),
    ("NaN", "run mine.py --train.epochs nan", "must be a finite number, not nan"),
    ("infinity", "run mine.py --train.epochs 1e400", "must be a finite number, not inf"),
    ("an empty value", "run mine.py --train.epochs=", "takes a number, not ''"),
    ("a fraction of an integer", "run mine.py --train.batch 1.5", "takes an integer, not '1.5'"),
    ("a huge batch", f"run mine.py --train.batch {10**30}", "larger than the training set"),
    ("a thousand million poses", f"run mine.py --paired.poses {10**9}", "GB of memory, and there"),
    ("a thousand million taps", f"sweep mine.py --pose.poses {10**9}", "GB of memory, and there"),
    ("an empty item", "run mine.py --paired.stimuli disk,,clover", "not 'disk,,clover'"),
    ("an empty --out", "run mine.py --out ''", "argument --out: names nothing"),
    ("a file as --out", "run mine.py --out five.py", "--out five.py is a file"),
    ("a file as --data", "run mine.py --data five.py", "--data five.py is a file"),
    ("a folder as --json", "run mine.py --json frames", "--json frames is a folder"),
    ("another file as --json", "doctor image.png --json notes.csv", "holds something else"),
    ("an empty network", "train mine.py --network ''", "is none of this experiment's"),
    ("a seed twice", "sweep mine.py --seeds 1,1", "lists a seed twice"),
    ("a negative seed", "sweep mine.py --seeds -1", "from 0 to 2147483647"),
    ("a huge seed", f"sweep mine.py --seeds {10**20}", "from 0 to 2147483647"),
    ("-3 px", "pins image.png --size -3", "use 32 to 2048 px"),
    ("NaN px", "pins image.png --size nan", "invalid int value: 'nan'"),
    ("NaN fps", "stream image.png --fps nan", "use more than 0"),
    ("a huge number of starts", f"servo --starts {10**14}", "at most"),
    ("an empty way", "servo --ways ''", "perception '' is unknown"),
    ("NaN mm", "servo --depth nan", "use more than 0"),
    ("an image that is none", "doctor frames", "no readable image (cannot identify image file)"),
    ("a folder that is not there", "fit --taps nowhere", "nowhere"),
    ("a task that is not there", "fit --recordings nowhere frames", "nowhere"),
    ("no recordings", "fit", "one for each task, --recordings DIR DIR"),
    ("tasks and taps", "fit --recordings frames --taps frames", "one for each task"),
    ("a place in a file", "export skin --out five.py/a.onnx", "five.py is a file"),
    ("released weights", "compare skin standard", "released weights hold no contacts and no"),
    ("released weights", "report skin", "released weights hold no contacts and no scores"),
    ("released weights", "ablate skin", "released weights hold no contacts and no scores"),
    ("a folder with a README.md", "evaluate .", "holds no experiment.json"),
    ("a run that was stopped", "report started", "is not finished: run its command again"),
]
CASES = [
    *(
        Case(name, shlex.split(line)[0] or "jaxunshear", said, refuse(line, said))
        for name, line, said in REFUSED
    ),
    Case("a field twice", "run", "the last wins", check_last_wins),
    Case("a million epochs", "run", "runs, and says the hours", check_hours),
    Case("--out=~/runs", "run", "the home folder", check_home),
]


@run_each(CASES)
def test_commands(case, desk):
    case.check(desk)
