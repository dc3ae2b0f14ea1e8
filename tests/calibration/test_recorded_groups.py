"""Every recording has a name of its own; a broken image costs that image alone."""

import numpy as np
import pytest
from PIL import Image

from jaxunshear.calibration.recorded_groups import sample_folders
from jaxunshear.errors import UserError


def _images(folder, count=3):
    folder.mkdir(parents=True)
    for i in range(count):
        image = np.zeros((140, 140), np.uint8)
        image[10 + i : 120, 20:100] = 255
        Image.fromarray(image).save(folder / f"image_{i}.png")


def test_names(tmp_path):
    """Images in a folder of their own, and without one."""
    for folder in ("a", "b/images", "c/frames_bw"):
        _images(tmp_path / "all" / folder)
    parts, _ = sample_folders(tmp_path / "all", 9, 0)
    assert [part.name for part in parts] == ["all/a", "all/b", "all/c"]
    assert [part.name for part in sample_folders(tmp_path / "all" / "b", 3, 0)[0]] == ["b"]
    assert [part.name for part in sample_folders(tmp_path / "all" / "b" / "images", 3, 0)[0]] == [
        "images"
    ]


def test_a_torn_first_image_is_left_out(tmp_path):
    _images(tmp_path / "one")
    (tmp_path / "one" / "image_0.png").write_bytes(b"\x89PNG")
    parts, notes = sample_folders(tmp_path / "one", 9, 0)
    assert parts[0].images.shape == (2, 140, 140)
    assert any("left out image_0.png" in note for note in notes)


def test_nothing_readable_is_refused(tmp_path):
    _images(tmp_path / "one", 1)
    (tmp_path / "one" / "image_0.png").write_bytes(b"")
    with pytest.raises(UserError, match=r"none of 1 images .*: image_0\.png: the file is empty"):
        sample_folders(tmp_path / "one", 9, 0)


def test_a_folder_that_cannot_be_read_costs_itself_alone(tmp_path):
    _images(tmp_path / "all" / "a")
    _images(tmp_path / "all" / "b", 2)
    for torn in (tmp_path / "all" / "b").iterdir():
        torn.write_bytes(b"\x89PNG")
    parts, notes = sample_folders(tmp_path / "all", 9, 0)
    assert [part.name for part in parts] == ["all/a"]
    assert sum("left out b/" in note for note in notes) == 2
