"""Weights released from a run: complete, minimal, found by name, and checked for damage."""

import shutil
from copy import deepcopy
from dataclasses import asdict
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from jaxunshear.config import serialization, targets
from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.rules import validate
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.targets import count_outputs
from jaxunshear.errors import UserError
from jaxunshear.files import read_json, write_json
from jaxunshear.inference import infer
from jaxunshear.models import posenet, unshearnet
from jaxunshear.models.operations import NetworkSize
from jaxunshear.release import make_card, release
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results
from jaxunshear.training import checkpoint
from jaxunshear.training.trainer import get_compile_options

SIZE = 32
NET = UnshearNet(size=SIZE, widths=(4, 4, 4), pose_channels=4, shear_channels=4)
POSENET = PoseNet(size=SIZE, widths=(4, 4, 4, 4, 4), hidden=8)
SEEN = Preprocess(size=SIZE)
TARGETS = targets.make_range_targets((), Ranges())
DATA = {"paired": PairedData(preprocess=SEEN), "pose": PoseData(preprocess=SEEN)}
EXPERIMENT = Experiment("small", "A claim.", unshear=NET, posenet=POSENET, **DATA)
SIZES = {"disentangled": NetworkSize(12_345, 6.78e9)}
LEARNT = {"origin": {"set": "tactip_paired"}, "data": ["ab"], "start": "1234"}
RESULTS = {
    "settings": asdict(EXPERIMENT),
    "metric": {"ms_ssim": "ms_ssim@2", "image_px": SIZE},
    "counts": {"train": 40, "test": 8, "test_poses": 4},
    "seeds": {"experiment": 0},
    "command": "jaxunshear run small.py",
    "pose_mae": {"tap": {"edge_mm": 0.123, "edge_deg": 4.0, "x_mm": 1.0, "yaw_deg": 2.0}},
    "ms_ssim": {"sheared": {"overall": 0.3}, "disentangled": {"overall": 0.9}},
    "tests": {"unseen": {"stimuli": ["leaf"], "ms_ssim": {"disentangled": {"overall": 0.8}}}},
    "machine": {"cores": 2},
    "versions": {"jax": "0"},
    "pin_error": {},
}


def card_of(held):
    return make_card(convert_record(held, Results, "results.json", "again"), "mine", SIZES)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "small"
    outputs = count_outputs(TARGETS)
    for name, kind, init, net in (
        ("disentangled", "unshear", partial(unshearnet.init, NET), NET),
        ("posenet", "posenet", partial(posenet.init, POSENET, outputs), POSENET),
    ):
        variables = jax.jit(init, compiler_options=get_compile_options())(jax.random.key(1))
        variables["params"] = jax.tree.map(lambda x: 8 * x, variables["params"])
        settings = {"kind": kind, "net": asdict(net), "targets": targets.to_json(TARGETS)}
        settings |= {"training": "long", "seed": 0, **LEARNT}
        checkpoint.write_settings(folder / name, settings)
        checkpoint.save(folder / name, 1, {"average": variables}, {"history": [], "best_step": 1})
        write_json(folder / name / "summary.json", {"steps": 1})
    write_json(folder / "experiment.json", to_json(EXPERIMENT))
    write_json(folder / "results.json", RESULTS)
    return folder


@pytest.fixture
def run(finished, tmp_path):
    """A copy for each test to spoil."""
    return shutil.copytree(finished, tmp_path / "runs" / "small")


def image_in(folder):
    folder.mkdir()
    dots = (np.random.default_rng(0).random((SIZE, SIZE)) < 0.3).astype(np.uint8) * 255
    Image.fromarray(dots).save(folder / "a.png")
    return folder


def test_a_card_names_the_machine_that_trained_where_another_one_measured():
    own = RESULTS | {"trained_on": {"disentangled": RESULTS["machine"]}}
    assert "Trained on" not in card_of(RESULTS) and "Trained on" not in card_of(own)
    other = {"device": "gpu: one"}
    text = card_of(RESULTS | {"trained_on": {"disentangled": other, "posenet": other}})
    assert text.count("Trained on: ") == 1 and '"gpu: one"' in text


def test_a_card_gives_the_size_of_each_network():
    assert "| disentangled | 12,345 | 6.78 G |" in card_of(RESULTS)


def test_a_folder_of_the_name_that_a_temporary_one_might_have_is_kept(run, tmp_path):
    mine = tmp_path / "weights" / "mine.part" / "notes.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    release(run, tmp_path / "weights" / "mine")
    assert mine.read_text() == "mine"
    assert sorted(path.name for path in mine.parents[1].iterdir()) == ["mine", "mine.part"]


def test_a_card_gives_how_far_slides_twist_and_the_sensor_leans():
    assert "slides up to 2.5 mm. The errors" in card_of(RESULTS)
    wider = deepcopy(RESULTS)
    wider["settings"]["paired"]["ranges"] |= {"twist_deg": 5.0, "tilt_deg": 25.0}
    text = card_of(wider)
    assert "slides up to 2.5 mm, twist up to 5 deg, tilt up to 25 deg. The errors" in text


def test_released_weights_do_what_the_run_does(run, tmp_path):
    made = release(run, tmp_path / "weights" / "mine")
    frames = image_in(tmp_path / "frames")
    for model, out in ((run, "by_run"), (made, "by_weights")):
        infer.unshear_recordings(frames, Path(model), tmp_path / out, force=True)
    pictures, poses = [], []
    for out in (tmp_path / "by_run", tmp_path / "by_weights"):
        pictures.append(np.asarray(Image.open(out / "a.png"), float))
        poses.append(np.genfromtxt(out / "poses.csv", delimiter=",", skip_header=1)[2:])
    assert np.ptp(pictures[0]) > 20
    assert np.abs(pictures[0] - pictures[1]).mean() <= 3  # kernels are float16
    np.testing.assert_allclose(*poses, atol=0.05)
    for name in ("disentangled", "posenet"):
        reported = read_json(made / name / "model.json")
        assert {key: reported[key] for key in LEARNT} == LEARNT and "training" not in reported
    assert not (made / "entangled").exists()  # which this run has not trained
    assert read_json(made / "experiment.json")["name"] == "mine"
    arrays = np.load(made / "disentangled" / "weights.npz").files
    assert not any("DS" in name or "shear" in name for name in arrays)
    card = (made / "README.md").read_text()
    assert all(words in card for words in ("--model mine", "0.123", "simulated", "`unseen` (leaf)"))


def test_nothing_is_overwritten_and_nothing_unfinished_is_released(run, tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(UserError, match="exists"):
        release(run, tmp_path / "taken")
    (run / "results.json").unlink()
    with pytest.raises(UserError, match="is not finished"):
        release(run, tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["posenet", "entangled"])
def test_a_half_trained_network_is_not_released(run, tmp_path, name):
    if name == "entangled":
        shutil.copytree(run / "disentangled", run / name)
    (run / name / "summary.json").unlink()
    with pytest.raises(UserError, match=f"training of {name} in {run / name} was not finished"):
        release(run, tmp_path / "new")
    assert not list(tmp_path.glob("new*"))


@pytest.mark.parametrize(
    ("file", "text", "line"),
    [
        ("results.json", "{}", r"lacks 'settings'.*evaluate"),
        ("results.json", "[]", r"evaluate"),
        ("posenet/model.json", '{"net": {}}', r"model\.json lacks"),
        ("posenet/model.json", "{", r"model\.json"),
    ],
)
def test_a_damaged_run_is_not_released(run, tmp_path, file, text, line):
    (run / file).write_text(text)
    with pytest.raises(UserError, match=line):
        release(run, tmp_path / "new")
    assert not list(tmp_path.glob("new*"))


def test_damaged_weights_and_those_of_another_network_are_reported(run, tmp_path):
    file = release(run, tmp_path / "new") / "posenet" / "weights.npz"
    with np.load(file) as kept:
        arrays = dict(kept)
    name = next(name for name in arrays if name.endswith("kernel"))
    np.savez(file, **(arrays | {name: arrays[name] + 1}))
    with pytest.raises(UserError, match="digest"):
        checkpoint.load_best(file.parent)
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(UserError, match="damaged"):
        checkpoint.load_best(file.parent)


def test_an_unknown_name_lists_those_there_are():
    names = ", ".join(folder.name for folder in RELEASED)
    with pytest.raises(UserError, match=rf"released weights \({names}\)"):
        serialization.load_settings(serialization.find_model_folder(Path("yours")))


RELEASED = sorted(path.parent for path in serialization.RELEASED.glob("*/experiment.json"))


@pytest.mark.parametrize("folder", RELEASED, ids=lambda folder: folder.name)
def test_what_is_released_with_the_package_can_be_used(folder):
    experiment = from_json(read_json(folder / "experiment.json"))
    validate(experiment)
    wanted = targets.make_range_targets(experiment.targets, experiment.paired.ranges)
    for name in ("disentangled", "posenet"):
        assert checkpoint.load_best(folder / name)["params"]
        checkpoint.read_net(folder / name)
        assert checkpoint.read_targets(folder / name) == wanted
    assert (folder / "README.md").read_text().startswith(f"# {folder.name}\n")
