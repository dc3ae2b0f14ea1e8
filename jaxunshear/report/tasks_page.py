"""The page of a run about several tasks: what its joint network makes of each task."""

from pathlib import Path

from markupsafe import Markup

from jaxunshear.files import write_text
from jaxunshear.report import html, wording
from jaxunshear.report.html import format_cells, format_number
from jaxunshear.results.run import FurtherTest, Results

ROWS = {  # kinds of `task_run.ROWS`
    "tap": "taps (no slide)",
    "sheared": "slides as recorded",
    "others": "unsheared by a network that learnt from the other tasks",
    "own": "unsheared by a network of this task alone",
    "unsheared": "unsheared by the joint network",
    "sheared_learnt": "slides, learnt from slides directly",
}
DIGITS = 3  # of errors; the pins of a real sensor show hundredths of a mm


def write_tasks_page(path: Path, results: Results) -> Path:
    """Write the page of a run about several tasks, and return its path."""
    sections = [_build_section(name, test) for name, test in results.tests.items()]
    sections += [_build_frames_section(results), _build_pages_section(results)]
    made = wording.describe_source(results)
    lead = Markup(
        "<p>One network learnt to unshear the slides of all tasks. Each task has a PoseNet of its "
        "own, which has seen its taps alone. Contacts of the test are of the same sessions.</p>"
    )
    opening = html.opening(results.experiment, results.claim, lead, made)
    contents = html.build_contents(sections)
    page = html.page(f"jaxunshear: {results.experiment}", opening, contents, *sections)
    write_text(path, page)
    return path


def _build_section(name: str, test: FurtherTest) -> Markup:
    targets = dict.fromkeys(next(iter(test.pose_mae.values())), DIGITS)
    rows: list[list[str]] = []
    strong: list[int] = []
    for kind, title in ROWS.items():
        if kind in test.pose_mae:
            strong += [len(rows)] if kind == "unsheared" else []
            cells = format_cells(test.pose_mae[kind], test.spread.pose_mae[kind], targets)
            rows.append([title, *cells])
    head = ["mean absolute error", *map(wording.format_heading, targets)]
    lead = f"{test.contacts} slides of the test; {wording.describe_intervals(test)}"
    return html.section(f"Task {name}", lead, html.table(head, rows, (), strong))


def _build_frames_section(results: Results) -> Markup:
    rows = []
    for name, frame in results.frames.items():
        shift = ", ".join(format_number(value) for value in frame.shift_px)
        rows.append([name, shift, format_number(frame.left_px)])
    lead = (
        "The pins of all tasks are brought to the frame of the first, by a shift that their rest "
        "positions at the rim show. What is left over is mostly how their contacts differ."
    )
    head = ["task", "shift, px", "left over, px rms"]
    return html.section("One frame for all", lead, html.table(head, rows))


def _build_pages_section(results: Results) -> Markup:
    line = Markup(
        '{0}: <a href="{0}/report.html">joint network</a>, '
        '<a href="trained/{0}/report.html">its own network</a>'
    )
    lines = [line.format(name) for name in results.tests]
    lead = "Each folder can be used as a model, for pose, unshear, stream and export."
    return html.section("Pages of each task", lead, html.listed(lines, 0))
