"""Images of a dome that is touched, dragged, or left alone, whatever networks there are."""

import csv
import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear.apps.robot import stream as streams
from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.sensor import TACTIP_331, Nuisance
from jaxunshear.config.targets import make_range_targets
from jaxunshear.data.simulation import render_images
from jaxunshear.errors import UserError
from jaxunshear.inference import infer, readers, trained_model
from jaxunshear.inference.trained_model import load_model
from jaxunshear.perception.preprocess import View
from jaxunshear.perception.touch import Touch
from jaxunshear.simulator.pin_layout import compute_pin_tips
from tests.helpers.models import init, write_run
from tests.inputs.cases import Case, run_each

NETS = {
    "disentangled": UnshearNet(size=128, widths=(4, 4, 4), pose_channels=4, shear_channels=4),
    "posenet": PoseNet(size=128, widths=(4, 4, 4, 4, 4), hidden=8),
}
TARGETS = make_range_targets((), Ranges())
PAIRED = PairedData()
EXPERIMENT = Experiment(
    *("touched", "none"), unshear=NETS["disentangled"], posenet=NETS["posenet"], pose=PoseData()
)
USUAL = Nuisance()
VIEWS = {
    "usual": USUAL,
    "shifted": replace(USUAL, drift_px=2.0, drift_brightness=0.2),
    "blurred": replace(USUAL, blur_px=1.5),
    "noisy": replace(USUAL, noise=0.04, specks=12),
}


def deform(depth=0.0, drag=(0.0, 0.0), turn_deg=0.0, middle=(0.0, 0.0)):
    """Return tips (P, 3) mm of a dome that is pressed and dragged, as a smooth bump."""
    tips = compute_pin_tips(TACTIP_331)
    offset = tips[:, :2] - middle
    share = np.exp(-np.square(offset).sum(-1) / (2 * 5.0**2))[:, None]
    across = np.radians(turn_deg) * offset[:, ::-1] * [-1, 1]
    tips[:, :2] += share * (0.06 * depth * offset + drag + across)
    tips[:, 2] += 0.5 * depth * share[:, 0]
    return tips


STATES = {
    "untouched": deform(),
    "slight": deform(0.5),
    "deep": deform(3.0),
    "beside": deform(1.5, middle=(4.0, -3.0)),
    "along columns": deform(2.0, (0.6, 0.0)),
    "along rows": deform(2.0, (0.0, -0.6)),
    "turned": deform(2.0, turn_deg=4.0),
}


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    nets = NETS.items()
    variables = {n: init(net, 0, TARGETS if n == "posenet" else ()) for n, net in nets}
    folder = write_run(tmp_path_factory.mktemp("touched"), EXPERIMENT, NETS, variables, TARGETS)
    images = {}
    for view, nuisance in VIEWS.items():
        names = STATES if view in ("usual", "shifted") else ("untouched", "slight")
        tips = np.stack([STATES[name] for name in names])
        ages, settings = np.full(len(tips), 1.0), replace(PAIRED, nuisance=nuisance)
        made, _ = render_images(settings, TACTIP_331, tips, np.arange(len(tips)), ages, len(tips))
        images |= dict(zip([f"{name}, {view}" for name in names], made, strict=True))
    return SimpleNamespace(model=load_model(folder), images=images)


class Door:
    """What a case is given."""

    def __init__(self, shared, command, monkeypatch, tmp_path):
        self.model, self.images = shared.model, shared.images
        self.command, self.patch, self.path = command, monkeypatch, tmp_path
        monkeypatch.setattr(infer, "load_model", lambda *_: self.model)

    def touch(self, *names):
        return self.model.touch(np.stack([self.images[name] for name in names]))

    def write(self, *names):
        folder = self.path / "frames"
        folder.mkdir()
        for number, name in enumerate(names):
            Image.fromarray(self.images[name]).save(folder / f"{number:03d}.png")
        return folder

    def stream(self, name):
        frame = SimpleNamespace(pixels=self.images[name], view=View(), problem="")
        return streams._answer_frame(self.model, frame)


@pytest.fixture
def door(shared, command, monkeypatch, tmp_path):
    yield Door(shared, command, monkeypatch, tmp_path)
    shared.model.force, shared.model.with_sheared_poses = False, True


def is_free(name):
    def check(door):
        touch = door.touch(name)
        assert touch.contact[0] < 0.5
        assert np.isnan([touch.slip[0], touch.shear_x_mm[0], touch.shear_half_width_mm[0]]).all()

    return check


def is_touched(name):
    def check(door):
        touch = door.touch(name)
        assert touch.contact[0] > 0.9
        assert 0 <= touch.slip[0] <= 1 and np.isfinite(np.array(touch)).all()

    return check


def follows_drag(view):
    def check(door):
        touch = door.touch(f"along columns, {view}", f"along rows, {view}")
        assert touch.shear_x_mm[0] > 3 * abs(touch.shear_y_mm[0])
        assert -touch.shear_y_mm[1] > 3 * abs(touch.shear_x_mm[1])
        assert touch.shear_x_mm[0] == pytest.approx(-touch.shear_y_mm[1], rel=0.2)

    return check


def follows_turn(door):
    touch = door.touch("turned, usual", "deep, usual")
    assert touch.shear_deg[0] > touch.shear_half_width_deg[0]
    assert touch.curl[0] > 3 * abs(touch.curl[1])


def spreads(door):
    slight, deep = door.touch("slight, usual", "deep, usual").divergence
    assert deep > 2 * slight > 0


def has_nothing(images):
    def check(door):
        assert np.isnan(np.array(door.model.touch(images))).all()

    return check


def takes_bool(door):
    image = door.images["deep, usual"][None]
    np.testing.assert_array_equal(door.model.touch(image > 0), door.model.touch(image))


def refuses_size(door):
    with pytest.raises(UserError, match=r"takes \(B, 128, 128\)"):
        door.model.touch(door.images["deep, usual"][None, :100, :100])


def misses_a_side(door):
    image = door.images["deep, usual"].copy()
    image[:, 109:] = 0  # the outermost pins of one side
    assert door.model.touch(image[None]).contact[0] > 0.9


def keeps_rows(door):
    names = ("untouched, usual", "deep, usual", "along rows, usual")
    together = np.array(door.touch(*names))
    alone = np.concatenate([np.array(door.touch(name)) for name in names], axis=1)
    np.testing.assert_allclose(together, alone)


def predict(door, name, force=False):
    door.model.force = force
    return door.model.predict(door.images[name][None])


def has_no_pose(door):
    answer = predict(door, "untouched, usual")
    assert answer.rejection[0] == "no contact" and answer.confidence[0] == 0
    assert np.isnan(answer.poses["unsheared"]["x_mm"][0]) and np.isnan(answer.unsheared).all()
    assert answer.touch.contact[0] < 0.5


def tracks_when_asked(door):
    tracked, track = [], readers.track_images
    door.patch.setattr(readers, "track_images", lambda *a, **b: tracked.append(1) or track(*a, **b))
    frames = np.stack([door.images["deep, usual"]])
    answer = door.model.predict(frames)
    frames[:] = 0  # a camera writes its next frame there
    assert answer.rejection[0] == "" and not tracked
    expected = door.touch("deep, usual")
    np.testing.assert_array_equal(answer.touch, expected)
    assert answer.touch is answer.touch and len(tracked) == 2
    untouched, deep = "untouched, shifted", "deep, usual"
    mixed = door.model.predict(np.stack([door.images[untouched], door.images[deep]]))
    assert mixed.rejection.tolist() == ["no contact", ""] and len(tracked) == 3
    np.testing.assert_allclose(mixed.touch, door.touch(untouched, deep))


def has_pose(name, force=False):
    def check(door):
        answer = predict(door, name, force)
        assert answer.rejection[0] == "" and np.isfinite(answer.poses["unsheared"]["x_mm"][0])

    return check


def read(text):
    return list(csv.DictReader(io.StringIO(text)))


def pose_of_some(door):
    folder = door.write("untouched, usual", "deep, usual", "slight, usual")
    answer = door.command("pose", folder)
    rows = read(answer.out)
    assert answer.code == 0, answer.err
    assert [row["left_out"] for row in rows] == ["no contact", "", ""]
    assert [float(row["contact"]) > 0.5 for row in rows] == [False, True, True]
    assert rows[0]["slip"] == rows[0]["unsheared_x_mm"] == "" != rows[1]["shear_deg"]
    assert "left out 1: no contact" in answer.err


def pose_of_half(door):
    answer = door.command("pose", door.write("untouched, usual", "deep, usual"))
    assert answer.code == 1 and "left out 1: no contact" in answer.err


def pose_by_force(door):
    answer = door.command("pose", door.write("untouched, usual"), "--force")
    (row,) = read(answer.out)
    assert answer.code == 0 and row["left_out"] == "" != row["unsheared_x_mm"]
    assert float(row["contact"]) < 0.5


def pose_from_untouched(door):
    door.patch.setitem(door.model.__dict__, "touch_reader", door.model.touch_reader)
    folder = door.write("slight, usual", "deep, usual", "beside, usual")
    answer = door.command("pose", folder, "--untouched", folder / "000.png")
    assert [row["left_out"] for row in read(answer.out)] == ["no contact", "", ""], answer.err


def unshear_some(door):
    folder, out = door.write("untouched, usual", "deep, usual", "slight, usual"), door.path / "out"
    assert door.command("unshear", folder, "--out", out).code == 0
    rows = read((out / "poses.csv").read_text())
    assert [row["image"] for row in rows] == ["", "001.png", "002.png"]
    assert not (out / "000.png").exists() and float(rows[0]["contact"]) < 0.5
    assert float(rows[1]["shear_half_width_mm"]) > 0


def stream_untouched(door):
    answer = door.stream("untouched, usual")
    assert answer.error == "no contact" and not answer.pose
    assert answer.touch["contact"] < 0.5 and "slip" not in answer.touch
    json.dumps(answer.touch, allow_nan=False)


def stream_touched(door):
    answer = door.stream("along rows, usual")
    assert not answer.error and answer.pose
    assert set(answer.touch) == set(Touch._fields)


def stream_from_untouched(door):
    door.patch.setitem(door.model.__dict__, "touch_reader", door.model.touch_reader)
    door.patch.setattr(trained_model, "load_model", lambda *_, **__: door.model)
    folder = door.write("slight, usual", "deep, usual", "beside, usual")
    answer = door.command("stream", folder, "--untouched", folder / "000.png")
    lines = [json.loads(line) for line in answer.out.splitlines() if line.startswith("{")]
    assert [line.get("error") for line in lines] == ["no contact", None, None], answer.err
    assert "skipped 1: no contact" in answer.err and answer.code == 0
    assert lines[0]["touch"]["contact"] < 0.5 < lines[1]["touch"]["contact"]


NOISE = np.where(np.random.default_rng(0).random((1, 128, 128)) < 0.3, 255, 0).astype(np.uint8)
PYTHON, PREDICT = "model.touch", "model.predict"
CASES = [
    *(Case(f"untouched, {v}", PYTHON, "no contact", is_free(f"untouched, {v}")) for v in VIEWS),
    *(Case(f"0.5 mm, {v}", PYTHON, "contact", is_touched(f"slight, {v}")) for v in VIEWS),
    Case("3 mm", PYTHON, "contact", is_touched("deep, usual")),
    Case("beside the middle", PYTHON, "contact", is_touched("beside, shifted")),
    Case("dragged", PYTHON, "shear along the drag", follows_drag("usual")),
    Case("dragged, view shifted", PYTHON, "shear along the drag", follows_drag("shifted")),
    Case("turned", PYTHON, "turn and curl of its sign", follows_turn),
    Case("slight and deep", PYTHON, "more divergence", spreads),
    Case("blank", PYTHON, "NaN", has_nothing(np.zeros((1, 128, 128), np.uint8))),
    Case("random dots", PYTHON, "NaN", has_nothing(NOISE)),
    Case("bool", PYTHON, "as uint8", takes_bool),
    Case("another size", PYTHON, "the size it takes", refuses_size),
    Case("a side hidden", PYTHON, "contact", misses_a_side),
    Case("a mixed batch", PYTHON, "each as alone", keeps_rows),
    Case("untouched", PREDICT, "no pose, no contact", has_no_pose),
    Case("untouched, force", PREDICT, "a pose", has_pose("untouched, usual", True)),
    Case("3 mm", PREDICT, "tracked only when asked", tracks_when_asked),
    Case("0.5 mm", PREDICT, "a pose", has_pose("slight, noisy")),
    Case("one of three untouched", "pose", "left out by name, exit 0", pose_of_some),
    Case("half untouched", "pose", "exit 1", pose_of_half),
    Case("untouched, --force", "pose", "a pose, its contact", pose_by_force),
    Case("--untouched, a slight contact", "pose", "its pins are the rest", pose_from_untouched),
    Case("one of three untouched", "unshear", "no image, its contact", unshear_some),
    Case("--untouched, a slight contact", "stream", "its pins are the rest", stream_from_untouched),
    Case("untouched", "stream", "no contact, its probability", stream_untouched),
    Case("dragged", "stream", "all of touch", stream_touched),
]


@run_each(CASES)
def test_touch(case, door):
    case.check(door)
