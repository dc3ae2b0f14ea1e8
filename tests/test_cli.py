"""What cannot work is refused at once: exit code 2, one line with the reason, nothing lost."""

import errno
import json
import re
import socket
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from jaxunshear import cli
from jaxunshear.cli import main
from jaxunshear.cli.program import RESTART
from jaxunshear.config.load import load_experiment
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import load_sweep

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "experiments" / "demo.py"

# (what follows `run experiments/demo.py`, what the line must hold); tests/config has all others
BAD_FIELDS = [
    ("--train.epoch 5", "did you mean --train.epochs?"),
    ("--train.epochs five", "takes a number, not 'five'"),
    ("--unshear.size 96", "differs from the data set's images"),
    ("--sensor.rings 40", "past the rim"),
    ("stray", "stray"),
]


def is_one_line(answer) -> None:
    assert answer.code == 2
    assert answer.err.startswith("jaxunshear: error: ")
    assert answer.err.count("\n") == 1
    assert "Traceback" not in answer.err
    assert answer.out == ""


@pytest.fixture
def stages(monkeypatch):
    """Return `stages(act)`, after which `act` runs instead of the stages of an experiment."""

    def replace(act):
        module = ModuleType("jaxunshear.run")
        module.run_stages = act
        monkeypatch.setitem(sys.modules, module.__name__, module)

    return replace


@pytest.fixture
def no_stage(stages):
    """No stage may start: what is refused must be refused before any work."""

    def started(*_, **__):
        pytest.fail("a stage started")

    stages(started)


@pytest.mark.parametrize(("words", "line"), BAD_FIELDS, ids=[words for words, _ in BAD_FIELDS])
def test_a_bad_field_is_refused_by_name_before_any_work(command, no_stage, tmp_path, words, line):
    answer = command("run", DEMO, "--out", tmp_path / "runs", *words.split())
    is_one_line(answer)
    assert line in answer.err
    assert not (tmp_path / "runs").exists()


def bad_commands(tmp_path: Path) -> list[tuple[list, str]]:
    """Command lines that name what is not there, or not what it should be."""
    image = tmp_path / "image.png"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(image)
    run, other, untrained = (tmp_path / name for name in ("run", "other", "untrained"))
    settings = ('{"name": ', '{"name": "x"}', json.dumps(to_json(load_experiment(DEMO))))
    for folder, text in zip((run, other, untrained), settings, strict=True):
        folder.mkdir()
        (folder / "experiment.json").write_text(text)
    out = ("--out", tmp_path / "out")
    return [
        (["run", tmp_path], "is a folder"),
        (["run", image], "not text"),
        (["train", DEMO, "--network", "resnet"], "--network"),
        (["train", DEMO, "--json", tmp_path / "x"], "--json"),
        (["run", DEMO, "--out"], "--out"),
        (["report"], "MODEL"),
        (["report", tmp_path / "none"], "no results.json"),
        (["unshear", image, "--model", run], "--out"),
        (["unshear", tmp_path / "none.png", "--model", run, *out], "none.png does not exist"),
        (["unshear", image, "--model", tmp_path / "none", *out], "no experiment.json"),
        (["unshear", image, "--model", run, *out], "not valid JSON"),
        (["unshear", image, "--model", other, *out], "does not fit version"),
        (["unshear", image, "--model", untrained, *out], "holds no trained network"),
        (["pose", image, "--model", untrained], "holds no trained network"),
        (["pose", tmp_path / "none", "--model", untrained], "does not exist"),
        (["pose", image, "--model", image], "no experiment.json"),
        (["sensors", "draw"], "name what to draw"),
        (["sensors", "draw", "gelsight", "--out", tmp_path / "a.png"], "gelsight"),
        (["sensors", "draw", "tactip331", "--out", tmp_path / "a.txt"], "ends in .png"),
        (["stimuli", "draw", "box", "--out", tmp_path / "a.png"], "stimulus 'box' is unknown"),
        (["stimuli", "list", "disk"], "takes nothing more"),
        (["stimuli", "draw", "disk", "--out", image / "a.png"], "a.png"),
        (["stimuli", "--colour"], "--colour"),
    ]


def test_bad_commands_and_paths(command, no_stage, tmp_path):
    for words, line in bad_commands(tmp_path):
        answer = command(*words)
        is_one_line(answer)
        assert line in answer.err, words
    assert not (tmp_path / "out").exists()


@pytest.fixture
def run_with(stages, command):
    """`run_with(act)`: the answer of `run` whose stages are `act`."""

    def run(act):
        stages(act)
        return command("run", DEMO)

    return run


def fails_with(error: BaseException):
    def act(*_, **__):
        raise error

    return act


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (ValueError("RESOURCE: No space left on device [place]\n  more"), "the disk is full"),
        (PermissionError(errno.EACCES, "Not permitted", "runs/demo"), "runs/demo: Not permitted"),
        (MemoryError(), "out of memory"),
    ],
)
def test_what_the_machine_refuses_is_one_line(run_with, error, line):
    answer = run_with(fails_with(error))
    is_one_line(answer)
    assert line in answer.err


def test_a_full_disk_wrapped_by_a_library(run_with):
    def act(*_, **__):
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise RuntimeError("save failed") from error

    is_one_line(run_with(act))


def test_an_interrupt_says_how_to_go_on(run_with):
    answer = run_with(fails_with(KeyboardInterrupt()))
    assert (answer.code, answer.err) == (130, "stopped; run the same command to continue\n")


def test_an_interrupt_promises_nothing_where_no_work_is_kept(monkeypatch, command):
    monkeypatch.setattr(
        "jaxunshear.calibration.calibrate.calibrate", fails_with(KeyboardInterrupt())
    )
    answer = command("calibrate", "recordings")
    assert (answer.code, answer.err) == (130, f"stopped; {RESTART}\n")


@pytest.mark.parametrize(
    "words",
    [
        ("sensors", "draw", "tactip331", "--out", "/proc/new/a.png"),
        ("stimuli", "draw", "disk", "--out", "/proc/new/a.png"),
        ("run", DEMO, "--out", "/proc/new"),
    ],
)
def test_a_place_that_cannot_be_written_is_named(command, words):
    answer = command(*words)
    is_one_line(answer)
    assert "/proc/new" in answer.err


def test_a_bug_keeps_its_traceback(run_with):
    with pytest.raises(ZeroDivisionError):
        run_with(fails_with(ZeroDivisionError()))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["run"], ("data", "entangled", "disentangled", "posenet", "evaluate", "report")),
        (["data"], ("data",)),
        (["train"], ("entangled", "disentangled", "posenet")),
        (["train", "--network", "posenet"], ("posenet",)),
        (["evaluate"], ("evaluate",)),
    ],
)
def test_commands_become_stages(stages, command, tmp_path, words, expected):
    calls = []
    stages(lambda *a, **k: calls.append((a, k)))
    name, *more = words
    answer = command(name, DEMO, *more, "--out", tmp_path, "--train.epochs", "2", "--data=sets")
    assert (answer.code, answer.err) == (0, "")
    ((experiment, asked), named) = calls[0]
    assert experiment.train.epochs == 2 and asked == expected
    assert (named["out"], named["data"]) == (tmp_path, Path("sets"))
    assert named["command"].startswith(f"jaxunshear {words[0]} ")


def test_lists_and_drawings(command, tmp_path):
    assert "tactip127" in command("sensors").out
    assert {"spiral_2", "edge"} < set(command("stimuli", "list").out.split())
    for kind, name in (("sensors", "tactip331"), ("stimuli", "edge"), ("stimuli", "surface")):
        path = tmp_path / f"{name}.png"
        assert command(kind, "draw", name, "--out", path).code == 0
        assert np.asarray(Image.open(path).convert("L")).std() > 10


def test_help_and_refusals_import_nothing_heavy():
    probe = (
        "import sys\n"
        "from jaxunshear.cli import main\n"
        "for line in ('--help', 'run --help', 'unshear --help', 'sweep --help',\n"
        "             'run x --train.epoch 5', 'unshear'):\n"
        "    assert main(line.split()) == (0 if '--help' in line else 2), line\n"
        "    heavy = {'jax', 'flax', 'scipy', 'matplotlib', 'skimage', 'tensorflow_datasets'}\n"
        "    assert not heavy.intersection(sys.modules), line\n"
    )
    words = [sys.executable, "-c", probe]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_help_lists_every_field(command):
    brief, text = command("run", "--help").out, command("run", "--help-all").out
    for name in (
        *("--paired.ranges.{lateral_mm,", "--train.{epochs,", "--sensor.{name,"),
        "--ray-cores N",
    ):
        assert name in text and name not in brief
    assert "`jaxunshear run --help-all`" in brief and "--help-all`" not in text
    for option in ("--help", "--help-all"):
        assert "Add --unshear.input pins if" in command("fit", option).out


def test_every_stage_of_a_command_is_one_of_run():
    stages = cli.experiments.STAGES
    assert {stage for own in stages.values() for stage in own} == set(stages["run"])


def test_every_field_has_its_meaning_in_help(command):
    from jaxunshear.config.fields import list_field_types

    groups = {name.rpartition(".")[0] for name in list_field_types()}
    written = "".join(command("run", "--help-fields", group).out for group in groups)
    entries = dict(re.findall(r"^--(\S+) .*\n((?:    .*\n?)+)", written, re.MULTILINE))
    assert entries.keys() == set(list_field_types())
    assert not [
        name for name, text in entries.items() if len(" ".join(text.split()).partition(". ")[2]) < 6
    ]
    answer = command("run", "--help-fields", "trains")
    is_one_line(answer)
    assert "name one of sensor, paired," in answer.err


def test_help_on_fields_has_the_values_of_the_file(command):
    def shown(*words):
        answer = command(*words)
        assert answer.code == 0 and not answer.err
        return re.findall(r"^--(\S+) (.*)$", answer.out, re.MULTILINE)

    usual = shown("run", "--help-fields", "paired")
    assert len(dict(usual)) == len(usual)  # each field once, whichever kinds of settings have it
    demo = load_experiment(DEMO)
    changed = dict(shown("run", DEMO, "--help-fields", "paired", "--paired.seed", "7"))
    assert (changed["paired.poses"], changed["paired.seed"]) == (str(demo.paired.poses), "7")
    recorded = dict(shown("run", ROOT / "experiments" / "recorded.py", "--help-fields=paired"))
    assert "paired.pairing" in recorded and "paired.poses" not in recorded
    few = load_sweep(ROOT / "experiments" / "few_pairs.py").base
    words = ("sweep", ROOT / "experiments" / "few_pairs.py", "--help-fields", "train_pins")
    assert dict(shown(*words))["train_pins.epochs"] == str(few.train_pins.epochs)
    usual = dict(shown("run", "--help-fields", "train_pins"))
    assert usual["train_pins.epochs"] == str(demo.train_pins.epochs)


def test_help_on_fields_of_a_group_that_a_file_lacks_is_refused(command):
    answer = command("run", ROOT / "experiments" / "recorded.py", "--help-fields", "paired.ranges")
    is_one_line(answer)
    assert "its Recorded has other fields" in answer.err


def test_help_names_each_command_once(command):
    shown = command("--help").out
    assert (command().code, command().out) == (0, shown)
    for name in cli.COMMANDS:
        assert len(re.findall(rf"^  {name} ", shown, re.M)) == 1, name


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


def test_a_calibration_writes_statistics_and_parameters(tmp_path, monkeypatch):
    rows = {"rows": [{"name": "pin spacing"}], "parameters": [{"name": "friction"}]}
    monkeypatch.setattr("jaxunshear.calibration.calibrate.calibrate", lambda recordings, out: rows)
    file = tmp_path / "calibration.json"
    assert main(["calibrate", "recordings", "--json", str(file)]) == 0
    assert json.loads(file.read_text())["rows"] == rows["rows"] + rows["parameters"]


@pytest.mark.parametrize(
    "words", [("calibrate", "recordings"), ("run", "experiments/tiny.py"), ("servo",)]
)
def test_a_file_cannot_be_the_folder_of_results(tmp_path, capsys, words):
    (tmp_path / "file").touch()
    assert main([*words, "--out", str(tmp_path / "file")]) == 2
    assert f"--out {tmp_path / 'file'} is a file: name a folder" in capsys.readouterr().err
    assert main([*words, "--out", str(tmp_path / "file" / "deeper")]) == 2
    assert f"{tmp_path / 'file'} is a file: name another folder" in capsys.readouterr().err
