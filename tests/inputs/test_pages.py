"""Pages and figures: what a run's page shows of its files, and what the page of `explore` says."""

import json
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxunshear.apps.explore.explorer import (
    FIRST_MOVE,
    FIRST_POSE,
    SHEARED,
    TAP,
    Touch,
    compute_likeness,
    describe_limits,
)
from jaxunshear.config.data import Ranges
from jaxunshear.config.sensor import SENSORS
from jaxunshear.errors import UserError
from jaxunshear.files import write_json
from jaxunshear.perception.drawing import SURPLUS, compare_images
from jaxunshear.report import applications, html, wording
from jaxunshear.report.contact_figures import build_contact_section, plot_contacts
from jaxunshear.report.html import build_contents
from jaxunshear.report.report import write_report
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results
from jaxunshear.simulator.stimuli import STIMULI
from jaxunshear.style import label_log_axis
from jaxunshear.text_table import format_plain
from tests.inputs.cases import Case, list_cases, run_each
from tests.report.conftest import make_run

SOURCE = {"version": "0.3.0", "date": "2026-11-29", "commit": "96954d006e903c", "clean": True}
NAMES = ("edge_mm", "edge_deg")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run, its page and its results; no test changes them."""
    folder = tmp_path_factory.mktemp("pages") / "run"
    folder.mkdir()
    results = make_run(folder) | {"source": SOURCE}
    results["contact"]["free"]["max"] = 1261.0
    (folder / "results.json").write_text(json.dumps(results))
    (folder / "servo").mkdir()
    row = {"stimulus": "disk", "way": "disentangled", "starts": 5, "closed": 4, "perceive_ms": 6.5}
    row |= {"mean_mm": 0.214, "p95_mm": 0.5, "largest_mm": 1.23}
    write_json(folder / "servo" / "servo.json", {"rows": [row], "command": "jaxunshear servo"})
    for log in folder.glob("*/log.jsonl"):  # curves take long
        log.unlink()
    return folder, write_report(folder).read_text(), convert_record(results, Results, "", "")


def read_page(text, run):
    """Say what the page of the run contains, or not after a minus."""
    page = re.sub(r'"data:[^"]*"', "", run[1])
    assert (text[1:] not in page) if text[0] == "-" else (text in page), text


def check_contents(run):
    page = run[1]
    places = re.findall(r'<h2 id="(.*?)">', page)
    assert len(places) > 8 and len(set(places)) == len(places)
    assert re.findall(r'<a href="#(.*?)">', page) == places


def check_servo_first(run):
    headings = re.findall(r"<h2 .*?>(.*?)</h2>", run[1])
    assert headings[:2] == ["What it does", "Around objects by touch"]


def describe_code(change, text, run):
    results = replace(run[2], source=change and replace(run[2].source, **change))
    assert wording.describe_source(results) == text


def draw_axis(low, high, texts, run):
    """Compare the labels of a logarithmic axis between two values."""
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0, 1], [low, high])
    axes.set_yscale("log")
    label_log_axis(axes.yaxis)
    figure.canvas.draw()
    ends = axes.get_ylim()
    ticks = zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
    shown = [label.get_text() for place, label in ticks if ends[0] <= place <= ends[1]]
    assert shown == texts and not any(each.get_text() for each in axes.get_yticklabels(minor=True))


def format_value(value, text, run):
    assert format_plain(value) == text


def make_scores(**changes):
    """Make scores of 40 slides whose predictions are off by 0.5, unsheared by 0.1."""
    generator = np.random.default_rng(0)
    scores = {"slide_mm": generator.uniform(0, 5, 40), "depth_mm": generator.uniform(1, 6, 40)}
    for name in NAMES:
        scores[f"pose.true.{name}"] = generator.uniform(-5, 5, 40)
        for kind, error in (("sheared", 0.5), ("disentangled", 0.1)):
            scores[f"pose.{kind}.{name}"] = scores[f"pose.true.{name}"] + error
            scores[f"pose/{kind}/{name}"] = np.full(40, error)
    return scores | changes


def section_of(scores, run, tmp_path):
    if scores is not None:
        np.savez(tmp_path / "scores.npz", **scores)
    return build_contact_section(tmp_path, wording.describe(run[2]))


def lack_scores(scores, run, tmp_path):
    assert section_of(scores, run, tmp_path) == ""


def keep_figures(monkeypatch):
    """Return a list that gets each figure that is saved from now on."""
    drawn, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda f, *a, **k: (drawn.append(f), save(f, *a, **k)))
    return drawn


def show_scores(scores, panels, run, tmp_path, monkeypatch):
    """Count the panels with axes of the section's figure, and read their labels."""
    drawn = keep_figures(monkeypatch)
    section = section_of(scores, run, tmp_path)
    assert 'id="contact-by-contact"' in section and "data:image/png" in section
    axes = [each for each in drawn[0].axes if each.axison]
    assert len(axes) == panels
    assert [each.get_ylabel() for each in axes[:2]] == ["predicted, mm", "mean error, mm"]
    np.testing.assert_allclose(axes[1].lines[0].get_ydata(), 0.5)


def turn_the_short_way(run, monkeypatch):
    true, predicted = np.full(40, 179.0), np.full(40, -179.0)
    scores = make_scores(**{"pose.true.edge_deg": true, "pose.sheared.edge_deg": predicted})
    drawn = keep_figures(monkeypatch)
    plot_contacts(scores, ["edge_deg"], wording.describe(run[2]))
    np.testing.assert_allclose(drawn[0].axes[0].lines[0].get_ydata(), 181)


def refuse_damage(run, tmp_path):
    (tmp_path / "scores.npz").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"scores\.npz is damaged.*run `jaxunshear evaluate` again"):
        build_contact_section(tmp_path, wording.describe(run[2]))


def show_ablation(run, tmp_path):
    row = {"name": "DC(z_p)", "target": "tap", "paper": {"mse": 0.023, "ms_ssim": 0.93}}
    row |= {"mse": 0.0065, "ssim": 0.974, "ms_ssim": 0.9695, "ms_ssim interval": [0.968, 0.971]}
    other = row | {"name": "DS(z_p,0)", "paper": None}
    content = {"rows": [row, other], "metric": {"ms_ssim": "ms_ssim@4"}, "command": "ablate"}
    write_json(tmp_path / "ablation.json", content)
    (shown,) = applications.build_sections(tmp_path).values()
    for text in ("ms_ssim@4", "0.970 <small>[0.968, 0.971]", "0.006", "0.023", "\u2013", "ablate"):
        assert text in shown, text


def refuse_ablation(run, tmp_path):
    write_json(tmp_path / "ablation.json", {"command": "ablate"})
    with pytest.raises(UserError, match=r"ablation\.json lacks 'rows': run its command again"):
        applications.build_sections(tmp_path)


def count_hints(columns, hints, run):
    assert html.table(["a"] * columns, [["b"] * columns]).count("class=hint") == hints


def escape_contents(run):
    name = "<script>\"'&"
    shown = build_contents([html.section(name, "")])
    assert "<script" not in shown and shown.count("&lt;script&gt;") == 2


def refuse_model(run, command, tmp_path):
    answer = command("reconstruct", "--model", "standard", "--out", tmp_path / "out")
    assert (answer.code, len(answer.err.splitlines())) == (2, 1)
    assert "takes no --model; see `jaxunshear" in answer.err and not (tmp_path / "out").exists()


def touch_at(pose=FIRST_POSE, move=FIRST_MOVE):
    return Touch(STIMULI["disk"], SENSORS["tactip331-fitted"], pose, move, 0.4)


def limit(changes, text, run):
    said = describe_limits(touch_at(**changes), Ranges())
    assert said == (f"outside what the networks know: {text}" if text else "")


def compare_equal(run):
    image = np.random.default_rng(0).integers(0, 2, (128, 128), np.uint8) * 255
    likeness = compute_likeness({SHEARED: image, TAP: image})
    assert likeness == {SHEARED: pytest.approx(1, abs=1e-5)}


def colour_surplus(run):
    image, tap = np.full((1, 1), 255, np.uint8), np.zeros((1, 1), np.uint8)
    assert compare_images(image, tap)[0, 0].tolist() == list(SURPLUS)


PAGE, AXIS, NUMBER, SCORES = "write_report", "label_log_axis", "format_plain", "scores.npz"
LIMITS = "explore: a touch"
EDGE = (1.0, 0.0, 0.0)
EARLIER = {"pose/sheared/edge_mm": np.ones(3)}
LENGTHLESS = make_scores(slide_mm=np.full(40, np.nan))
FIXTURES = ("command", "tmp_path", "monkeypatch")  # that checks may ask for
COMMIT = "Evaluated on 2026-11-29 by jaxunshear 0.3.0, commit 96954d006e"
INSTALLED = {"commit": None, "clean": None}
DECADES = ["0.00002", "0.00005", "0.0001", "0.0002", "0.0005", "0.001"]
CASES = [
    Case("any run", f"{PAGE}: contents", "a link to each heading, in their order", check_contents),
    Case("walks of servo", PAGE, "right after the montage", check_servo_first),
    Case("a heading with HTML in it", f"{PAGE}: contents", "escaped, not double", escape_contents),
    *list_cases(
        *(PAGE, "its text", partial(partial, read_page)),
        [
            ("a run of a commit", f"{COMMIT}."),
            ("print: closed parts are opened", "details-content"),
            ("print: tables are not clipped", ".wide { overflow: vis"),
            ("1261 nodes free", "<td>1261</td>"),
            ("large numbers without an exponent", "-e+0"),
        ],
    ),
    *list_cases(
        *("describe_source", "version, commit", partial(partial, describe_code)),
        [
            ("code that was changed", {"clean": False}, f"{COMMIT} with changes."),
            ("an installed package", INSTALLED, "Evaluated on 2026-11-29 by jaxunshear 0.3.0."),
            ("an earlier version", None, ""),
        ],
    ),
    *list_cases(
        *(AXIS, "no exponent", partial(partial, draw_axis)),
        [
            ("9 to 12 deg", 9, 12, ["9", "10", "11", "12"]),
            ("1, 2, 5 of each decade", 2e-5, 1e-3, DECADES),
        ],
    ),
    *list_cases(
        *(NUMBER, "three digits, or all", partial(partial, format_value)),
        [
            ("1263.4", 1263.4, "1263"),
            ("0.0377", 0.03768, "0.0377"),
            ("12345678", 12345678.0, "12345678"),
            ("no number", float("nan"), "nan"),
        ],
    ),
    Case("missing", SCORES, "no section", partial(lack_scores, None)),
    Case("of an earlier version", SCORES, "no section", partial(lack_scores, EARLIER)),
    Case("damaged", SCORES, "named, with a remedy", refuse_damage),
    Case("with poses", SCORES, "scatter, slide, depth", partial(show_scores, make_scores(), 6)),
    Case("slides of unknown length", SCORES, "depth alone", partial(show_scores, LENGTHLESS, 4)),
    Case("-179 deg for 179 deg", SCORES, "2 deg off", turn_the_short_way),
    Case("run", "ablation.json", "its table, with the paper's", show_ablation),
    Case("without rows", "ablation.json", "named, with a remedy", refuse_ablation),
    Case("a table of 7 columns", "report: 400 px", "a hint", partial(count_hints, 7, 1)),
    Case("a table of 2 columns", "report: 400 px", "no hint", partial(count_hints, 2, 0)),
    Case("--model", "jaxunshear reconstruct", "unknown: exit 2", refuse_model),
    *list_cases(
        *(LIMITS, "what networks know", partial(partial, limit)),
        [
            ("the first", {}, ""),
            ("8 mm deep", {"pose": (*EDGE, 8.0)}, "depth 8 mm (learnt: 1 to 6)"),
            ("a slide of 4 mm", {"move": (0, -4.0)}, "slide along x or y 4 mm (learnt: 0 to 2.5)"),
            ("20 mm beside", {"pose": (-20.0, 0, 0, 3.0)}, "x -20 mm (learnt: -5 to 5)"),
            ("yaw of 90 deg", {"pose": (1.0, 0, 90.0, 3.0)}, "yaw 90 deg (learnt: -45 to 45)"),
        ],
    ),
    Case("the tap itself", "explore: MS-SSIM", "1", compare_equal),
    Case("a bright dot too many", "explore: difference", "blue", colour_surplus),
]


@run_each(CASES)
def test_page(case, run, request):
    names = case.check.func if isinstance(case.check, partial) else case.check
    wanted = names.__code__.co_varnames[: names.__code__.co_argcount]
    given = {name: request.getfixturevalue(name) for name in FIXTURES if name in wanted}
    case.check(run=run, **given)
