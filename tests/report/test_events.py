"""TensorBoard's event files hold what log.jsonl holds, each step once, also of logs that grow, are cut back, or begin anew."""

import io
import json
import struct
import threading

import numpy as np
import pytest
from PIL import Image

from jaxunshear.report import events, montage
from jaxunshear.report.events import scalars, write_events
from jaxunshear.results import stored
from jaxunshear.results.run import Results
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.stored import to_json
from jaxunshear.settings.training import Training
from jaxunshear.training.step import learning_rate

pytest.importorskip("tensorboardX")
TRAINING = Training(epochs=4, batch=6, schedule="steps", drops=((2.0, 0.1),))


def line(step, shift=0.0):
    validation = {"supervised": 0.7 / step + shift, "reconstruction": None if step == 20 else 0.5}
    counts = {"step": step, "epoch": step / 6, "images": 6 * step, "train_seconds": 0.05 * step}
    return counts | {
        "train": {"supervised": 0.9 / step, "gradient": 3.0},
        "validation": validation,
        "kernels": {"E": 0.1},
    }


def write(run, lines, network="disentangled"):
    (run / network).mkdir(parents=True, exist_ok=True)
    (run / "experiment.json").write_text(json.dumps(to_json(Experiment(name=run.name, claim="none"))))
    model = {"training": to_json(Experiment(name="a", claim="b", train=TRAINING))["train"], "epoch_images": 36}
    (run / network / "model.json").write_text(json.dumps(model))
    (run / network / "log.jsonl").write_text("".join(json.dumps(each) + "\n" for each in lines))


def read(folder):
    """Events of all files in a folder, in their order: records of a length, its check, the event, and its check."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            found.append(Event.FromString(data[12 : 12 + size]))
            data = data[16 + size :]
    return found


def values(folder):
    """By tag: (step, value) of each."""
    found = {}
    for event in read(folder):
        for value in event.summary.value:
            if value.HasField("simple_value"):
                found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


def expected(lines):
    found = {}
    for each in lines:
        for tag, value in scalars(each).items():
            found.setdefault(tag, []).append((each["step"], np.float32(value)))
    return found


def logged(folder):
    return {tag: at for tag, at in values(folder).items() if tag.partition("/")[0] in events.GROUPS}


def test_events_are_what_the_log_says(tmp_path, command):
    lines = [line(step) for step in (10, 20, 24)]
    write(tmp_path / "demo", lines)
    answer = command("logs", tmp_path / "demo", "--tensorboard", tmp_path / "events")
    assert answer.code == 0 and "3 validations of 1 networks" in answer.out, answer.err
    folder = tmp_path / "events" / "demo" / "disentangled"
    assert logged(folder) == expected(lines)
    found = values(folder)
    assert [step for step, _ in found["validation/reconstruction"]] == [10, 24]  # one was not finite
    assert dict(found["images_per_second"]) == pytest.approx({10: 120, 20: 120, 24: 120})
    rate = learning_rate(TRAINING, 24, 6)
    assert dict(found["learning_rate"]) == pytest.approx({step: float(rate(step - 1)) for step in (10, 20, 24)})
    assert found["learning_rate"][0][1] == pytest.approx(10 * found["learning_rate"][1][1])
    times = [event.wall_time for event in read(folder) if event.summary.value]
    assert max(times) - min(times) == pytest.approx(0.05 * 14, abs=1e-5)
    (text,) = (v for event in read(tmp_path / "events" / "demo") for v in event.summary.value)
    assert b"| train.batch | 16 |" in text.tensor.string_val[0]


def test_the_montage_is_there_once_a_run_is_evaluated(made_up_run, tmp_path):
    run, _ = made_up_run
    experiment = to_json(Experiment(name="made up", claim="none"))
    (run / "experiment.json").write_text(json.dumps(experiment))
    write_events([run], tmp_path / "events", None)
    found = [value for event in read(tmp_path / "events" / run.name) for value in event.summary.value]
    (image,) = (value.image for value in found if value.tag == "montage")
    results = stored.read(run / "results.json", Results, "again")
    drawn = montage.drawing(montage.read(run / "montage.npz"), results)
    shown, wanted = (Image.open(io.BytesIO(png)).convert("RGB") for png in (image.encoded_image_string, drawn))
    assert np.array_equal(shown, wanted)


def test_written_again_no_step_is_there_twice(tmp_path):
    lines = [line(step) for step in (10, 20, 30)]
    folder = tmp_path / "events" / "demo" / "disentangled"
    for held in (lines[:2], lines, [*lines[:1], line(20, 0.5)]):  # the last: gone back to a checkpoint
        write(tmp_path / "demo", held)
        write_events([tmp_path / "demo"], tmp_path / "events", None)
        assert logged(folder) == expected(held)
        assert len(list(folder.iterdir())) == 1
    (folder / "events.out.tfevents.1.other").write_bytes(b"")
    write_events([tmp_path / "demo"], tmp_path / "events", None)
    assert len(list(folder.iterdir())) == 2  # what others wrote stays


def test_a_growing_log_is_followed_to_its_end(tmp_path):
    run, out = tmp_path / "demo", tmp_path / "events"
    states = [
        [],
        [line(10)],
        [line(10), line(20)],
        [line(10)],
        [line(10), line(20, 0.5)],
        [line(10), line(20, 0.5), line(30)],
    ]
    write(run, states[0])
    done = threading.Event()

    def wait():  # between two readings: the run goes on, is killed after step 20, and continues from step 10
        if states:
            write(run, states.pop(0))
        else:
            write(run, [line(5)], "posenet")
            (run / "results.json").write_text("{}")
            done.set()

    write_events([run], out, wait)
    assert done.is_set()
    assert logged(out / "demo" / "disentangled") == expected([line(10), line(20, 0.5), line(30)])
    assert logged(out / "demo" / "posenet") == expected([line(5)])
    starts = [event for event in read(out / "demo" / "disentangled") if event.HasField("session_log")]
    assert len(starts) == 1 and starts[0].session_log.status == 1  # a TensorBoard that is open drops earlier steps


def test_rows_of_a_sweep_have_folders_of_their_own(tmp_path):
    for seed in (0, 1):
        write(tmp_path / "wide" / "rows" / f"base_seed-{seed}", [line(10, seed)])
    write_events([tmp_path / "wide"], tmp_path / "events", None)
    for seed in (0, 1):
        assert logged(tmp_path / "events" / "wide" / f"base_seed-{seed}" / "disentangled") == expected([line(10, seed)])


def test_refusals_are_one_line(tmp_path, command, absent):
    write(tmp_path / "demo", [line(10)])
    (tmp_path / "empty").mkdir()
    for words, reason in (
        ((tmp_path / "empty", "--tensorboard", tmp_path / "out"), "is no run and no sweep"),
        ((tmp_path / "demo", "--tensorboard", tmp_path / "demo" / "new"), "files of its own"),
        ((tmp_path / "demo", "--tensorboard", tmp_path / "demo" / "experiment.json"), "is a file"),
    ):
        answer = command("logs", *words)
        assert (answer.code, answer.err.count("\n")) == (2, 1) and reason in answer.err, answer.err
    absent("tensorboardX")
    answer = command("logs", tmp_path / "demo", "--tensorboard", tmp_path / "out")
    assert answer.code == 2 and "jaxunshear[tensorboard]" in answer.err and not (tmp_path / "out").exists()
