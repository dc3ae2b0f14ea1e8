"""`show`: a picture of what a model makes of a few frames, and what it says of them."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear.cli import first_steps
from jaxunshear.report.show import (
    PNG_SOFTWARE,
    ShownFrame,
    describe_touch,
    format_poses,
    plot_frames,
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
