"""`show`: a picture of what a model makes of a few frames, and what it says of them."""

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear.cli import first_steps
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import find_common_view, read_image
from jaxunshear.report.show import (
    PNG_SOFTWARE,
    ShownFrame,
    collect_poses,
    describe_touch,
    format_poses,
    plot_frames,
    predict_taps,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "recordings"))
import made

TOUCH = {
    "contact": 0.991,
    "slip": 0.5,
    "shear_x_mm": 0.3,
    "shear_y_mm": -0.4,
    "shear_deg": -0.04,
    "shear_half_width_mm": 0.1,
    "shear_half_width_deg": 1.0,
}


@pytest.mark.parametrize(
    ("reason", "touch", "said"),
    [
        ("", TOUCH, "50% of the contact slips. Friction has dragged the skin by 0.50 mm"),
        ("no contact", {"contact": 0.12}, "the dome touches nothing (probability of a contact 0.1"),
        ("its pins cannot be identified for sure", {}, "Not understood: its pins cannot be ident"),
        ("", {"contact": 0.4}, "no contact could be measured"),
    ],
)
def test_a_sentence_says_what_is_seen(reason, touch, said):
    sentence = describe_touch(reason, touch)
    assert said in sentence and "nan" not in sentence and "-0.0" not in sentence


def test_poses_have_units_and_labels():
    lines = format_poses({"y_mm": {"as_recorded": 1.0, "label": 1.5}, "Rz_deg": {"as_recorded": 2}})
    assert lines[0].split() == ["pose", "as", "recorded", "label"]
    assert lines[1].split() == ["y,", "mm", "1.00", "1.50"]
    assert lines[2].split() == ["Rz,", "deg", "2.00", "-"]
    assert format_poses({}) == []


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ({"y_mm": 5.0, "Rz_deg": -178.0}, {"label": 5.0}),
        ({"y_mm": 5.0}, {"tap": 6.0}),  # another frame has a quantity of the same name
        ({"y_mm": np.nan, "Rz_deg": np.nan}, {}),
    ],
)
def test_what_is_right_stands_beside_the_estimates(label, expected):
    kinds = {"as_recorded": (1.0, 178.0), "unsheared": (2.0, -179.0)}
    estimates = {
        kind: {"y_mm": np.array([0.0, y]), "Rz_deg": np.array([0.0, turn])}
        for kind, (y, turn) in kinds.items()
    }
    tap = {"y_mm": 6.0, "Rz_deg": 181.0}
    poses = collect_poses(SimpleNamespace(poses=estimates), 1, label, tap)
    assert poses["y_mm"] == {"as_recorded": 1.0, "unsheared": 2.0} | expected
    angles = list(poses["Rz_deg"].values())
    assert np.ptp(angles) <= 4 and len(angles) == 2 + len(expected)


@pytest.mark.parametrize("together", [False, True])
def test_taps_at_the_poses_of_slides_are_found(tmp_path, together):
    """In a folder beside the slides', or in one folder with them."""
    pose, move = made.contacts(3, True, 0)
    tap_pose = np.concatenate([pose[:2], pose[2:] + 1.0])  # the last is of another pose
    made.write(tmp_path / "tap", tap_pose, 0 * move)
    slides = made.write(tmp_path / "shear", pose, move) / "images"
    files = sorted(slides.glob("*.png"))
    model = SimpleNamespace(
        preprocess=Preprocess(size=made.SIZE),
        view=find_common_view(files, Preprocess(size=made.SIZE)),
        predict=lambda images: SimpleNamespace(
            poses={"as_recorded": {"edge_mm": images.mean(axis=(1, 2))}}
        ),
    )
    path = tmp_path if together else tmp_path / "shear"
    found = predict_taps(path, files, model)
    assert list(found) == files[:2]
    for file, read in found.items():
        tap = read_image(tmp_path / "tap" / "images" / file.name)
        assert read["edge_mm"] == pytest.approx(tap.mean(), rel=0.05)
    assert predict_taps(files[0], files[:1], model) == {}


def test_frames_of_both_kinds_are_drawn():
    image, place = np.zeros((32, 32), np.uint8), np.ones((7, 2))
    motion = {"as_recorded": np.full((7, 2), 0.1), "unsheared": np.full((7, 2), np.nan)}
    rejected = ShownFrame("a.png", image, None, motion, place, {}, "Not understood.")
    seen = rejected._replace(unsheared=np.eye(32), poses={"y_mm": {"unsheared": 1.0}})

    class Model:
        folder = Path("skin")

        class source:  # noqa: N801
            describe = staticmethod(lambda: "These networks learnt. " * 20)

    png = plot_frames([rejected, seen], Model)
    picture = Image.open(io.BytesIO(png))
    assert picture.width == 1200 and picture.info["Software"] == PNG_SOFTWARE
    assert png == plot_frames([rejected, seen], Model)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Frames of 127 pins, which no released weights know."""
    return made.write(tmp_path_factory.mktemp("show") / "taps", *made.contacts(24, False, 0))


def test_another_sensor_is_refused_with_a_remedy(command, frames, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(first_steps, "DEFAULT_MODELS", first_steps.DEFAULT_MODELS[:1])
    answer = command("show", frames)
    assert answer.code == 2 and answer.err.count("\n") == 1
    assert "name a MODEL that learnt from it" in answer.err
    assert not list(tmp_path.iterdir())


def test_what_it_did_not_draw_stays(command, frames, tmp_path):
    other = tmp_path / "mine.png"
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(other)
    for out, line in (
        (other, "holds something else"),
        (tmp_path / "a.jpg", "ends in .png"),
        (tmp_path / "mine.png" / "a.png", "is a file"),
        (frames / "images" / "show.png", "lies among the recordings"),
    ):
        answer = command("show", frames, "--out", out)
        assert answer.code == 2 and line in answer.err and answer.err.count("\n") == 1
    assert "does not exist" in command("show", tmp_path / "none").err
