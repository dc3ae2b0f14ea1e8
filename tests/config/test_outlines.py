"""Outlines are read from files, traced from functions and stored; others are refused in a line."""

import dataclasses
import json

import numpy as np
import pytest

from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields
from jaxunshear.config.load import load_experiment
from jaxunshear.config.outlines import parse_stimulus, read_outline, trace_outline
from jaxunshear.config.rules import validate
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError

SQUARE = ((0, 0), (20, 0), (20, 20), (0, 20))
PLUS = (
    *((1, 1), (1, 3), (-1, 3), (-1, 1), (-3, 1), (-3, -1)),
    *((-1, -1), (-1, -3), (1, -3), (1, -1), (3, -1), (3, 1)),
)
PLAIN = Experiment("own", "none", paired=PairedData(stimuli=("disk", Outline("square", SQUARE))))
SVG = '<svg xmlns="http://www.w3.org/2000/svg" {}>{}</svg>'


def make_star(corners):
    """Make a polygon whose radius changes from corner to corner."""
    angle, radius = np.arange(corners) / 80, 20 + np.arange(corners) % 2
    return tuple(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))


STAR = make_star(500)


def ring(xy):
    return np.hypot(*xy.T) - 12


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ((), "a point or a line"),
        (((0, 0), (9, 9)), "a point or a line"),
        (((0, 0), (0, 0), (9, 9), (0, 0)), "a point or a line"),
        (((0, 0), (2, 0), (0, 2)), "encloses less than 9 mm²"),
        (((0, 0), (300, 0), (0, 300)), "at most 120 mm"),
        (((0, 0), (10, 10), (10, 0), (0, 10)), "crosses itself"),
        (((0, 0), (10, 0), (5, 0), (5, 8)), "crosses itself"),  # folds back
        (((0, 0), (9, float("nan")), (9, 9)), "must be finite"),
        (((0, 0, 0), (9, 0, 0), (9, 9, 0)), "must be pairs"),
        ("square", "must be pairs"),
        (STAR, "corners"),
    ],
)
def test_what_is_no_outline_is_refused(points, reason):
    with pytest.raises(UserError, match=reason) as refusal:
        Outline("mine", points)
    assert "outline 'mine'" in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["disk", "", "two words", 7, "a/b"])
def test_names_are_of_few_signs_and_of_no_other_shape(name):
    with pytest.raises(UserError, match="outline '"):
        Outline(name, SQUARE)


@pytest.mark.parametrize(
    ("more", "reason"), [({"friction": -1}, "0 or more"), ({"target": (1, 2)}, "degrees")]
)
def test_targets_and_frictions_that_cannot_be(more, reason):
    with pytest.raises(UserError, match=reason):
        Outline("mine", SQUARE, **more)


def test_sides_on_one_line_do_not_cross():
    assert Outline("plus", PLUS).place == (3, 0, 0)


@pytest.mark.parametrize(
    ("points", "place"),
    [
        (SQUARE, (20, 10, 0)),
        (SQUARE[::-1], (20, 10, 0)),  # whichever way round
        (((0, 0), (10, 10), (0, 20), (-10, 10)), (10, 10, 0)),  # at a corner, between both sides
        (((0, 0), (20, 20), (-20, 20)), (40 / 3, 40 / 3, -45)),
        (np.array(SQUARE, np.float32), (20, 10, 0)),
    ],
)
def test_the_target_is_where_a_line_from_the_middle_leaves(points, place):
    np.testing.assert_allclose(Outline("mine", points).place, place, atol=1e-9)


def test_drawings_are_read_in_mm_with_y_up(tmp_path):
    size = 'width="4cm" height="20mm" viewBox="0 0 80 40"'
    path = '<path d="M0,0 h40 q40 20 0 40 c-20 0 -40 0 -40-20z"/>'
    (tmp_path / "lens.svg").write_text(SVG.format(size, path))
    lens = np.array(read_outline(tmp_path / "lens.svg").points)
    np.testing.assert_allclose([lens.min(0), lens.max(0)], [[0, -20], [30, 0]], atol=0.02)
    # the curve's vertex: half way to its control point
    assert np.abs(lens - [30, -10]).sum(-1).min() < 0.5
    (tmp_path / "disc.svg").write_text(SVG.format("", '<circle cx="5" cy="7" r="10"/>'))
    disc = read_outline(tmp_path / "disc.svg")
    radius = np.linalg.norm(disc.points - np.array([5, -7]), axis=-1)
    np.testing.assert_allclose(radius, 10, atol=0.02)
    np.testing.assert_allclose(disc.place, (15, -7, 0), atol=0.05)


def test_points_are_read_from_tables_and_lists(tmp_path):
    (tmp_path / "a.csv").write_text("x_mm,y_mm\n" + "".join(f"{x}, {y}\n" for x, y in SQUARE))
    (tmp_path / "a.json").write_text(json.dumps(SQUARE))
    (tmp_path / "b.json").write_text(json.dumps({"name": "a", "points": SQUARE, "friction": 0.3}))
    for name in ("a.csv", "a.json"):
        assert read_outline(tmp_path / name) == Outline("a", SQUARE)
    assert read_outline(tmp_path / "b.json") == Outline("a", SQUARE, friction=0.3)
    assert parse_stimulus("disk") == "disk" and parse_stimulus(str(tmp_path / "a.csv")).name == "a"


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.svg", "<svg", "no drawing that can be read"),
        ("a.svg", SVG.format("", '<path d="M0 0 L x"/>'), "no drawing that can be read"),
        ("a.svg", SVG.format("", ""), "has 0 paths"),
        ("a.svg", SVG.format("", '<path d="M0 0h9v9z M20 0h9v9z"/>'), "has 2 paths"),
        (
            "a.svg",
            SVG.format("", '<g transform="scale(2)"><rect width="9" height="9"/></g>'),
            "has transforms",
        ),
        ("a.svg", SVG.format("", '<path d="M0 0h9v9z"/>').replace("9", "1"), "encloses less"),
        ("a.csv", "0 0\n1", "line 2"),
        ("a.csv", "0 0\n1 up", "a point a line"),
        ("a.json", '{"corners": []}', "list of [x, y]"),
        ("disk.csv", "0 0\n9 0\n9 9", "use another"),
    ],
)
def test_files_that_hold_no_outline_are_refused_in_a_line(
    command, tmp_path, monkeypatch, name, text, reason
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text(text)
    for words in (("stimuli", "draw", name), ("servo", "--stimulus", f"leaf,{name}")):
        answer = command(*words)
        assert answer.code == 2 and reason in answer.err and name in answer.err, answer.err
        assert len(answer.err.strip().splitlines()) == 1
    with pytest.raises(UserError, match=r"nowhere\.svg is no file"):
        parse_stimulus("nowhere.svg")


def test_a_function_is_traced_to_the_contacts_precision():
    points = np.array(trace_outline("ring", ring, within_mm=20).points)
    assert np.abs(ring(points)).max() < 0.01 and len(points) < 200
    assert trace_outline("ring", ring, 20) == trace_outline("ring", ring, 20)


@pytest.mark.parametrize(
    ("distance", "reason"),
    [
        (lambda xy: np.abs(ring(xy)) - 2, "has 2 outlines"),
        (lambda xy: np.hypot(*xy.T) + 1, "is nowhere negative"),
        (lambda xy: xy[:, 0], "goes beyond within_mm"),
        (lambda xy: 1.0, "one finite number for each row"),
        (lambda xy: ring(xy) / 0.0, "one finite number for each row"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_functions_that_give_no_outline_are_refused(distance, reason):
    with pytest.raises(UserError, match=reason):
        trace_outline("mine", distance, within_mm=20)


def test_settings_with_outlines_are_stored_and_read_again():
    validate(PLAIN)
    stored = json.loads(json.dumps(to_json(PLAIN)))
    disk, square = stored["paired"]["stimuli"]
    assert disk == "disk" and square["points"][1] == [20, 0]
    assert from_json(stored) == PLAIN and hash(from_json(stored)) == hash(PLAIN)
    stored["paired"]["stimuli"][1]["points"] = [[0, 0]]
    with pytest.raises(UserError, match="a point or a line"):
        from_json(stored)
    stored["paired"]["stimuli"][1] = 7
    with pytest.raises(UserError, match=r"paired\.stimuli is no group"):
        from_json(stored)


def test_other_points_are_another_set():
    larger = Outline("square", tuple((2 * x, 2 * y) for x, y in SQUARE))
    names = {
        compute_config_name(PairedData(stimuli=(one,)), TACTIP_331)
        for one in ("disk", Outline("square", SQUARE), larger)
    }
    assert len(names) == 3


def test_files_are_named_on_the_command_line(tmp_path):
    (tmp_path / "square.csv").write_text("\n".join(f"{x} {y}" for x, y in SQUARE))
    file = tmp_path / "square.csv"
    argv = f"--paired.stimuli disk,{file} --pose.stimuli disk --unseen leaf".split()
    changed = override_fields(Experiment("own", "none"), argv)
    assert changed.paired == PLAIN.paired and changed.paired.names == ("disk", "square")
    twice = override_fields(changed, ["--paired.stimuli", f"disk,{file},{file}"])
    with pytest.raises(UserError, match=r"stimuli disk,square,square: name each stimulus once"):
        validate(twice)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"unseen": (Outline("square", PLUS),)}, "square is trained on"),
        (
            {"pose": PoseData(stimuli=("disk", Outline("square", PLUS)))},
            "two outlines are called square",
        ),
        ({"paired": PairedData(stimuli=("disk", ring))}, "takes names, or files of outlines"),
        ({"paired": PairedData(stimuli=("disk", "box"))}, "box is unknown"),
    ],
)
def test_rules_between_shapes(changes, reason):
    with pytest.raises(UserError, match=reason):
        validate(dataclasses.replace(PLAIN, **changes))


def test_an_experiment_file_has_shapes_and_a_sensor_of_its_own(tmp_path):
    file = tmp_path / "mine.py"
    text = """
from dataclasses import replace
import numpy as np
from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.outlines import trace_outline
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.stimuli import Outline

def blob_mm(xy):
    return np.hypot(*xy.T) - 12 - 2 * np.cos(3 * np.arctan2(*xy.T))
blob = trace_outline("blob", blob_mm, within_mm=20)
kite = Outline("kite", ((0, -15), (12, 0), (0, 25), {corner}))
small = replace(TACTIP_331, name="small", rings=6, dome_radius_mm=15.0)
paired = PairedData(stimuli=("disk", blob, kite))
experiment = Experiment("mine", "none", sensor=small, paired=paired)
"""
    file.write_text(text.format(corner="(-12, 0)"))
    found = load_experiment(file)
    assert found.sensor.pins == 127 and found.paired.names == ("disk", "blob", "kite")
    assert from_json(json.loads(json.dumps(to_json(found)))) == found
    file.write_text(text.format(corner="(8, -20)"))
    with pytest.raises(UserError, match=r"mine\.py fails in line 13: .*'kite' crosses itself"):
        load_experiment(file)
