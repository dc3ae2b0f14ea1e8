"""The Python snippets of the pages run, and give answers: for frames of a camera, or simulated."""

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
TUTORIAL = "docs/python.md"


def cells(kind: str) -> str:
    stored = nbformat.read(ROOT / NOTEBOOK, as_version=4).cells
    return "\n".join(cell.source for cell in stored if cell.cell_type == kind)


README = (ROOT / "README.md").read_text()
TEXTS = {
    "README.md": README,
    NOTEBOOK: cells("markdown"),
    TUTORIAL: (ROOT / TUTORIAL).read_text(),
}
PREPARE = "images = np.stack([model.prepare(frame) for frame in frames])"


def list_snippets(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", TEXTS[page], re.DOTALL)


def list_camera_snippets() -> list[str]:
    """The model that the README names for a camera, and the snippets of notebook and tutorial."""
    named = re.findall(r"real camera use\s`(load_model\(.*?\))`", README)
    snippets = [*list_snippets(NOTEBOOK), list_snippets(TUTORIAL)[-1]]
    return [*(f"model = {call}\n{PREPARE}" for call in named), *snippets]


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


@pytest.mark.long
def test_the_snippet_of_the_readme_answers_for_simulated_contacts(capsys):
    """Each contact has an answer, and unsheared ones are nearer to the tap's."""
    (snippet,) = list_snippets("README.md")
    names: dict = {}
    exec(snippet, names)
    unsheared, sheared = names["unsheared"], names["contacts"].sheared
    assert unsheared.shape == sheared.shape and np.isfinite(unsheared).all()
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    kinds, errors, rest = zip(*lines, strict=True)
    assert kinds == ("as_recorded", "unsheared") and {*rest} == {"mm from what the tap gives"}
    assert 0 < float(errors[1]) < float(errors[0])


@pytest.mark.long
def test_the_snippets_of_the_tutorial_print_what_it_shows(capsys):
    """Errors differ by machine in their last digit."""
    names: dict = {}
    for snippet in list_snippets(TUTORIAL)[:-1]:
        exec(snippet, names)
    printed = capsys.readouterr().out.splitlines()
    shown = "".join(re.findall(r"```text\n(.*?)```", TEXTS[TUTORIAL], re.DOTALL)).splitlines()
    assert [re.sub(r"\d\.\d+", "", line) for line in printed] == [
        re.sub(r"\d\.\d+", "", line) for line in shown
    ]


@pytest.mark.parametrize("snippet", list_camera_snippets(), ids=TEXTS)
def test_a_snippet_answers_for_frames_of_a_camera(snippet, place, frames, monkeypatch):
    """And says nothing against its weights: these suit a camera."""
    names: dict = {"frames": frames, "np": np, "load_model": load_model}
    monkeypatch.chdir(place)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        exec(snippet, names)
    assert not [note for note in said if "simulated contacts alone" in str(note.message)]
    unsheared = names["model"].unshear(names["images"])
    sure = np.isfinite(unsheared).all(axis=(1, 2))
    assert len(sure) == len(frames) and sure.mean() > 0.9
    edge = names["model"].pose(names["images"])["unsheared"]["edge_mm"]
    np.testing.assert_array_equal(np.isfinite(edge), sure)


def test_weights_for_simulated_images_are_loaded_for_these_alone():
    """No page hands frames to `standard`; its notebook names it for images of the simulator."""
    for page in TEXTS:
        for snippet in list_snippets(page):
            assert "prepare" not in snippet or "standard" not in snippet
    assert "prepare" not in cells("code")


def test_weights_that_learnt_from_simulated_images_warn_about_a_camera(frames):
    model = load_model("standard")
    with pytest.warns(Note, match="simulated contacts alone.*take the weights `skin`"):
        model.prepare(frames[0])
