"""The Python snippets of the pages run on frames of a camera, and give answers for them."""

import re
import warnings
from pathlib import Path

import made
import nbformat
import numpy as np
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.config.sensor import TACTIP_331_FITTED
from jaxunshear.errors import Note

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = "docs/notebooks/unshear.ipynb"


def cells(kind: str) -> str:
    stored = nbformat.read(ROOT / NOTEBOOK, as_version=4).cells
    return "\n".join(cell.source for cell in stored if cell.cell_type == kind)


TEXTS = {"README.md": (ROOT / "README.md").read_text(), NOTEBOOK: cells("markdown")}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Where `recordings/edge/shear` is: 24 slides of a sensor of 331 pins."""
    folder = tmp_path_factory.mktemp("laboratory")
    recording = folder / "recordings" / "edge" / "shear"
    made.write(recording, *made.contacts(24, True, 0), sensor=TACTIP_331_FITTED, size=192)
    return folder


@pytest.fixture
def frames(place):
    files = sorted((place / "recordings" / "edge" / "shear" / "images").glob("*.png"))
    return [np.asarray(Image.open(file)) for file in files]


@pytest.mark.parametrize("page", TEXTS)
def test_a_snippet_answers_for_frames_of_a_camera(page, place, frames, monkeypatch):
    """And says nothing against its weights: these suit a camera."""
    (snippet,) = re.findall(r"```python\n(.*?)```", TEXTS[page], re.DOTALL)
    names: dict = {"frames": frames, "np": np, "load_model": load_model}
    monkeypatch.chdir(place)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        exec(snippet, names)
    assert not [note for note in said if "simulated touches only" in str(note.message)]
    unsheared = names["model"].unshear(names["images"])
    sure = np.isfinite(unsheared).all(axis=(1, 2))
    assert len(sure) == len(frames) and sure.mean() > 0.9
    edge = names["model"].pose(names["images"])["unsheared"]["edge_mm"]
    np.testing.assert_array_equal(np.isfinite(edge), sure)


def test_weights_for_simulated_images_are_loaded_for_these_alone():
    """No page hands frames to `standard`; its notebook names it for images of the simulator."""
    for text in TEXTS.values():
        for snippet in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            assert "prepare" not in snippet or "standard" not in snippet
    assert "prepare" not in cells("code")


def test_weights_that_learnt_from_simulated_images_warn_about_a_camera(frames):
    model = load_model("standard")
    with pytest.warns(Note, match="simulated touches only.*take the weights `skin`"):
        model.prepare(frames[0])
