"""Each door gives the same answer to what is not understood, and refuses before it writes."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.config.serialization import RELEASED
from jaxunshear.metrics.images import ms_ssim, mse, ssim
from tests.inputs.cases import Case, run_each

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n"


def list_files(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="session")
def standard():
    return load_model("standard")


@pytest.fixture
def given(command, standard, tmp_path):
    return SimpleNamespace(command=command, standard=standard, folder=tmp_path)


def refuse(answer, *words):
    """Assert that a command ended with one line that has these words."""
    assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
    for word in words:
        assert word in answer.err


def evaluate_released(name):
    def check(given):
        before = list_files(RELEASED / name)
        refuse(given.command("evaluate", name), "--recordings DIR", "released weights")
        assert list_files(RELEASED / name) == before

    return check


def copy_standard(given):
    return shutil.copytree(RELEASED / "standard", given.folder / "copy")


def evaluate_release_folder(given):
    folder = copy_standard(given)
    before = list_files(folder)
    refuse(given.command("evaluate", folder), "--recordings DIR")
    assert list_files(folder) == before


def run_into_release_folder(given):
    folder = copy_standard(given)
    before = list_files(folder)
    words = ("experiments/tiny.py", "--name", folder.name, "--out", folder.parent)
    refuse(given.command("run", *words), "released weights")
    assert list_files(folder) == before


def pose_by(change, *words):
    """Give a black image to released weights of which `change` spoilt a file."""

    def check(given):
        folder, image = copy_standard(given), given.folder / "image.png"
        Image.fromarray(np.zeros((128, 128), np.uint8)).save(image)
        change(folder / "posenet")
        refuse(given.command("pose", image, "--model", folder), str(folder / "posenet"), *words)

    return check


def widen(folder):
    settings = json.loads((folder / "model.json").read_text())
    del settings["checksum"]
    settings["net"]["widths"][0] += 1
    (folder / "model.json").write_text(json.dumps(settings))


def forget_a_target(folder):
    settings = json.loads((folder / "model.json").read_text())
    del settings["checksum"], settings["targets"][-1]
    (folder / "model.json").write_text(json.dumps(settings))


def replace_weights(data):
    return lambda folder: (folder / "weights.npz").write_bytes(data)


def read_stub(data, *words):
    def check(given):
        (given.folder / "image.png").write_bytes(data)
        refuse(given.command("pose", given.folder / "image.png", "--model", "standard"), *words)

    return check


def score_images(metric, scale, words):
    """Give images times `scale` to a measure, which must refuse them; 1 is of the right range."""

    def check(given):
        a, b = np.random.default_rng(0).random((2, 1, 32, 32, 1), np.float32)
        with pytest.raises(ValueError, match=words):
            metric(scale * a, scale * b)
        assert 0 < float(metric(a, b)[0]) < 1

    return check


def ms_ssim_of_two(a, b):
    return ms_ssim(a, b, scales=2)


NO_RANGE = r"images in \[0, 1\] are needed"
WRITES = [
    Case(f"{name}, no recordings", "evaluate", "refused, untouched", evaluate_released(name))
    for name in ("standard", "skin")
] + [
    Case("a release folder", "evaluate", "refused, untouched", evaluate_release_folder),
    Case("into a release folder", "run", "refused, untouched", run_into_release_folder),
]
WEIGHTS = [
    Case("weights of other settings", "pose", "one line", pose_by(widen, "do not fit")),
    Case("a target less in model.json", "pose", "one line", pose_by(forget_a_target, "do not fit")),
    Case("weights: LFS pointer", "pose", "is named", pose_by(replace_weights(LFS), "git lfs pull")),
    Case("weights: empty", "pose", "is named", pose_by(replace_weights(b""), "it is empty")),
    Case("image: LFS pointer", "pose", "is named", read_stub(LFS, "git lfs pull")),
    Case("image: empty", "pose", "is named", read_stub(b"", "it is empty")),
]
MEASURES = [
    Case("floats to 255", "ms_ssim", "refused", score_images(ms_ssim_of_two, 255, NO_RANGE)),
    Case("floats to 255", "ssim", "refused", score_images(ssim, 255, NO_RANGE)),
    Case("floats to 255", "mse", "refused", score_images(mse, 255, NO_RANGE)),
    Case("floats to -2", "mse", "refused", score_images(mse, -2, NO_RANGE)),
]
CASES = [*WRITES, *WEIGHTS, *MEASURES]


@run_each(CASES)
def test_answer(case, given):
    case.check(given)
