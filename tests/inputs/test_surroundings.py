"""What surrounds a process: streams, signals, rights, variables, folders and names."""

import errno
import io
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from PIL import Image

from jaxunshear import environment
from jaxunshear.__main__ import run
from jaxunshear.cluster import Call, WorkerDied, make_ray_runner
from jaxunshear.config.serialization import RELEASED
from jaxunshear.data import recorded_frames
from jaxunshear.environment import count_cores, prepare_process
from jaxunshear.errors import Note, UserError
from jaxunshear.files import read_object, write_text
from jaxunshear.inference.trained_model import load_model
from jaxunshear.progress import Progress
from jaxunshear.sweep import tasks
from tests.conftest import Answer
from tests.helpers.dots import draw_dots, make_lattice
from tests.helpers.ray_stand_in import make_ray
from tests.inputs.cases import Case, run_each

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.py"
CUDA, MINUS_ONE = "JAX_PLATFORMS=cuda", "JAXUNSHEAR_DEVICES=-1"
DOCTOR = ("doctor", ".", "--json", "a.json")
ODD = "räc ξ"  # a name with a space and letters that ASCII has not


@dataclass
class Surroundings:
    """What the cases change, and the commands that they call."""

    monkeypatch: pytest.MonkeyPatch
    folder: Path  # the working folder
    command: Callable[..., Answer]
    capsys: pytest.CaptureFixture[str]

    def start(self, *words: str) -> int:
        """Start `jaxunshear` as its own process does, and return its exit code."""
        self.monkeypatch.setattr(sys, "argv", ["jaxunshear", *words])
        self.monkeypatch.setattr(os, "_exit", sys.exit)
        try:
            return run()
        except SystemExit as end:
            return int(str(end.code))

    def replace_stages(self, act: Callable[[], None]) -> None:
        """Have `act` run instead of the stages of an experiment."""
        module = ModuleType("jaxunshear.run")
        module.run_stages = lambda *_, **__: act()  # type: ignore[attr-defined]
        self.monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.fixture
def around(monkeypatch, tmp_path, command, capsys):
    stops = (signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.signal(number, signal.SIG_DFL) for number in stops]
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    monkeypatch.delenv("PYTHONSAFEPATH")
    monkeypatch.chdir(tmp_path)
    yield Surroundings(monkeypatch, tmp_path, command, capsys)
    for number, handler in zip(stops, handlers, strict=True):
        signal.signal(number, handler)


def make_failing(number: int) -> io.TextIOWrapper:
    """Make a stream that refuses what is written with an error of the system."""

    class Failing(io.BytesIO):
        def write(self, _: Any) -> int:
            raise OSError(number, os.strerror(number))

    return io.TextIOWrapper(Failing())


def check_ascii(around):
    held = io.BytesIO()
    around.monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(held, "ascii"))
    assert around.start("stimuli", "draw", "disk", "--out", f"{ODD}.png") == 0
    assert held.getvalue() == b"r\\xe4c \\u03be.png\n"
    assert (around.folder / f"{ODD}.png").is_file()


def check_closed_streams(around):
    nothing = around.folder / "nothing"
    nothing.touch()
    around.monkeypatch.setattr(os, "devnull", str(nothing))
    for name in ("stdout", "stderr"):
        around.monkeypatch.setattr(sys, name, None)
    around.replace_stages(lambda: Progress("work", 1).__enter__().advance(1))
    assert around.start("run", str(DEMO)) == 0
    sys.stdout.close()
    sys.stderr.close()


def check_full_stdout(around):
    around.monkeypatch.setattr(sys, "stdout", make_failing(errno.ENOSPC))
    assert around.start("sensors") == 2
    assert around.capsys.readouterr().err.startswith("jaxunshear: error: the disk is full")


def check_reader_gone(around):
    around.monkeypatch.setattr(sys, "stdout", make_failing(errno.EPIPE))
    assert around.start("sensors") == 141
    assert around.capsys.readouterr().err == ""


def check_stop(number: int) -> Callable[[Surroundings], None]:
    def check(around):
        around.replace_stages(lambda: os.kill(os.getpid(), number))
        assert around.start("run", str(DEMO)) == 128 + number
        said = around.capsys.readouterr().err
        assert said == "stopped; run the same command to continue\n"

    return check


def check_nohup(around):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    around.replace_stages(lambda: os.kill(os.getpid(), signal.SIGHUP))
    assert around.start("run", str(DEMO)) == 0


def write_foreign_module(around) -> None:
    (around.folder / "random.py").write_text("raise RuntimeError('mine')")


def check_children(around):
    write_foreign_module(around)
    prepare_process()
    done = subprocess.run([sys.executable, "-c", "import tempfile"], capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")


def check_sweep_worker(around):
    write_foreign_module(around)
    (around.folder / "task.json").write_text("{}")
    words = "import random, sys, jaxunshear.version; sys.exit('found')"
    worker = [word for word in tasks.WORKER if word not in ("-m", "jaxunshear.sweep.worker")]
    around.monkeypatch.setattr(tasks, "write_failure", lambda *found: print(found[-1]))
    tasks.run_task(around.folder, "row", [*worker, "-c", words])
    assert around.capsys.readouterr().out == "ended with exit code 1: found\n"


def check_no_shared_memory(around):
    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    around.monkeypatch.setattr(recorded_frames, "ProcessPoolExecutor", refuse)
    around.monkeypatch.setattr(recorded_frames, "count_cores", lambda: 2)
    assert list(recorded_frames._map_over_cores(abs, [(1,), (-2,)])) == [1, 2]


def check_one_core(around):
    around.monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert count_cores() == 1


def check_variable(said: str, setting: str) -> Callable[[Surroundings], None]:
    def check(around):
        around.monkeypatch.setattr(environment, "NVIDIA_DEVICES", ())
        around.monkeypatch.setenv(*setting.split("="))
        answer = around.command("run", DEMO)
        assert (answer.code, answer.out, answer.err.count("\n")) == (2, "", 1)
        assert said in answer.err
        assert not list(around.folder.iterdir())

    return check


def check_notes(action: str) -> Callable[[Surroundings], None]:
    def check(around):
        around.replace_stages(lambda: warnings.warn("less well", Note, stacklevel=1))
        with warnings.catch_warnings(record=True) as shown:
            warnings.simplefilter(action)
            assert around.command("run", DEMO).code == 0
        assert [str(each.message) for each in shown] == ["less well"]

    return check


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def check_terminal(escapes: bool, **variables: str) -> Callable[[Surroundings], None]:
    def check(around):
        for name, value in variables.items():
            around.monkeypatch.setenv(name, value)
        stream = Terminal()
        with Progress("train", total=1, stream=stream) as progress:
            progress.advance()
        assert ("\x1b" in stream.getvalue()) == escapes
        assert "train: 1" in stream.getvalue()

    return check


def check_no_rights(*words: object) -> Callable[[Surroundings], None]:
    def check(around):
        around.monkeypatch.setattr(os, "access", lambda *_, **__: False)
        around.replace_stages(lambda: pytest.fail("a stage started"))
        answer = around.command(*words)
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert "may not be written: name another folder" in answer.err

    return check


def draw_recordings(folder: Path, *names: str) -> Path:
    folder.mkdir()
    image = Image.fromarray(draw_dots(make_lattice(6), 2))
    for name in names:
        image.save(folder / name)
    return folder


def check_odd_folder(around):
    draw_recordings(around.folder / ODD, "a.png", "b c.png")
    answer = around.command("doctor", ODD, "--json", f"{ODD}.json")
    assert answer.code in (0, 1) and answer.err.count("Traceback") == 0
    assert f"{ODD}: 2 frames" in answer.out
    assert f"'{ODD}.json'" in read_object(Path(f"{ODD}.json"))["command"]


def check_bytes_in_name(around):
    name = os.fsdecode(b"b\xff.png")
    try:
        draw_recordings(around.folder / "frames").joinpath(name).write_bytes(b"no image")
    except OSError:
        pytest.skip("this file system has names of UTF-8 alone")
    assert around.start("doctor", "frames", "--json", "a.json") == 2
    said = around.capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("jaxunshear: error: ") and r"b\udcff.png" in said
    write_text(around.folder / "poses.csv", name)
    assert (around.folder / "poses.csv").read_bytes() == rb"b\udcff.png"


def check_moved(around):
    shutil.copytree(RELEASED / "standard" / "posenet", "run/posenet")
    shutil.copy(RELEASED / "standard" / "experiment.json", "run")
    model = load_model("run")
    (around.folder / "elsewhere").mkdir()
    around.monkeypatch.chdir("elsewhere")
    assert model.load_network("posenet").targets


def check_clock_step(around):
    around.monkeypatch.setattr(time, "time", lambda: -1e9)
    stream = io.StringIO()
    with Progress("train", total=1, stream=stream) as progress:
        progress.advance()
    assert "done in 0 s" in stream.getvalue()


def check_kernel(around):
    stream = io.StringIO()
    around.monkeypatch.setattr(sys, "stdout", stream)
    prepare_process()
    assert sys.stdout is stream


def check_ray(died: bool) -> Callable[[Surroundings], None]:
    def check(around):
        for name in ("RAY_USAGE_STATS_ENABLED", "RAY_task_oom_retries"):
            around.monkeypatch.setenv(name, "0")  # so that none is left
        around.monkeypatch.setitem(sys.modules, "ray", make_ray(died))
        calls = [Call(Path(str(number)), abs, (-number,)) for number in range(3)]
        found = dict(make_ray_runner(None, 2)(calls))
        expected = WorkerDied("its Ray worker died too often: RayError")
        assert found == {call.name: expected if died else -call.arguments[0] for call in calls}

    return check


def check_ray_address(around):
    around.monkeypatch.setitem(sys.modules, "ray", make_ray(died=False))
    with pytest.raises(UserError, match=r"--ray-address .*:1: no cluster answers there"):
        make_ray_runner("127.0.0.1:1", 2)


CASES = [
    Case("stdout of ASCII, a name outside it", "stimuli draw", "escaped, exit 0", check_ascii),
    Case("stdout and stderr closed", "run", "works all the same", check_closed_streams),
    Case("stdout on a full disk", "sensors", "one line, exit 2", check_full_stdout),
    Case("stdout whose reader has gone", "sensors", "silent, exit 141", check_reader_gone),
    Case("SIGTERM", "run", "says how to continue, exit 143", check_stop(signal.SIGTERM)),
    Case("SIGHUP", "run", "says how to continue, exit 129", check_stop(signal.SIGHUP)),
    Case("SIGHUP under nohup", "run", "goes on", check_nohup),
    Case("random.py in the working folder", "child processes", "is not read", check_children),
    Case("random.py in the working folder", "sweep worker", "is not read", check_sweep_worker),
    Case("no shared memory", "fit", "frames are read in one process", check_no_shared_memory),
    Case("one core of many", "count_cores", "one", check_one_core),
    Case("JAX_PLATFORMS=cuda, no GPU", "run", "one line", check_variable("no NVIDIA GPU", CUDA)),
    Case("-1 devices", "run", "one line", check_variable("use a number of devices", MINUS_ONE)),
    Case("PYTHONWARNINGS=error", "run", "a note stays a note", check_notes("error")),
    Case("PYTHONWARNINGS=ignore", "run", "a note is shown", check_notes("ignore")),
    Case("TERM=dumb", "progress", "plain lines", check_terminal(False, TERM="dumb")),
    Case("10 columns", "progress", "one line, cut", check_terminal(True, TERM="x", COLUMNS="10")),
    Case("a working folder without rights", "run", "one line", check_no_rights("run", DEMO)),
    Case("a folder without rights", "pins --out", "one line", check_no_rights("pins", ".")),
    Case("a folder without rights", "doctor --json", "one line", check_no_rights(*DOCTOR)),
    Case("spaces and letters outside ASCII", "doctor", "taken as they are", check_odd_folder),
    Case("a name that is no UTF-8", "doctor", "escaped", check_bytes_in_name),
    Case("another working folder since", "load_model", "networks are found", check_moved),
    Case("the clock steps back", "progress", "times are unchanged", check_clock_step),
    Case("streams of a notebook", "prepare_process", "stay as they are", check_kernel),
    Case("Ray with one node", "make_ray_runner", "every outcome", check_ray(died=False)),
    Case("Ray's workers die", "make_ray_runner", "WorkerDied", check_ray(died=True)),
    Case("no cluster at the address", "make_ray_runner", "one line", check_ray_address),
]


@run_each(CASES)
def test_surroundings(case, around):
    case.check(around)
