"""The section of a run's page on poses: errors by kind of contact, and recovery."""

from markupsafe import Markup

from jaxunshear.config.targets import get_unit
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.report import html, wording
from jaxunshear.report.html import format_cells, format_number
from jaxunshear.report.score_sections import describe_differences
from jaxunshear.report.wording import Wording
from jaxunshear.results.run import Parts, Results, Span

UNSHEARED_ALIAS = "unsheared"  # in recorded results: the run's main network, once more
ARROW = " \u2192 "


def build_pose_section(results: Results, words: Wording) -> Markup:
    """Build the section on errors of poses, with all that is derived from them."""
    if not results.pose_mae:
        return wording.section("no_pose")
    intervals = wording.describe_intervals(results)
    return wording.section(
        "pose",
        _build_error_table(results, words),
        _describe_unambiguous_edges(results, words),
        _describe_recovery(results, words),
        _build_parts(results, words, results.pose_by_stimulus, "shape"),
        _build_parts(results, words, results.pose_by_depth, words.depth),
        _build_parts(results, words, results.pose_by_slide, "length of the slide"),
        *_describe_differences(results, words),
        posenet=words.posenet,
        intervals=intervals[0].upper() + intervals[1:],
    )


def _build_error_table(results: Results, words: Wording) -> Markup:
    digits = words.digits
    paper = words.paper.get("pose_mae", {})
    paper_names = [name for name in paper.get("tap", ()) if name in digits]
    rows: list[list[str]] = []
    for kind, errors in results.pose_mae.items():
        if kind != UNSHEARED_ALIAS:
            cells = format_cells(errors, results.spread.pose_mae[kind], digits)
            paper_cells = html.format_paper_cells(paper.get(kind, {}), paper_names)
            rows.append([words.kinds[kind], *cells, *paper_cells])
    main_row = len(rows) - 1
    constant_answer = Markup("<i>one answer to every {}</i>").format(words.contact)
    cells = format_cells(results.baselines["pose_chance"], {}, digits)
    rows.append([constant_answer, *cells, *("" for _ in paper_names)])
    headings = map(wording.format_heading, digits)
    paper_headings = html.format_paper_headings(map(wording.format_heading, paper_names))
    head = [words.modality.pose_input, *headings, *paper_headings]
    return html.table(head, rows, range(1 + len(digits), len(head)), [main_row])


def _describe_unambiguous_edges(results: Results, words: Wording) -> Markup:
    """Describe errors of edge angles without ambiguous ones; nothing if none are marked."""
    smooth, counts = results.pose_smooth, results.counts
    if smooth is None or not counts.test_smooth or not counts.test:
        return Markup()
    parts = []
    for kind, errors in smooth.pose_mae.items():
        interval = _format_interval(smooth.spread.pose_mae[kind]["edge_deg"], ".1f")
        parts.append(f"{words.kinds[kind]} {format_number(errors['edge_deg'], 1)}{interval}")
    return html.soft(
        f"Edge angle errors, deg, on the {counts.test_smooth / counts.test:.0%} of contacts whose "
        f"nearest edge has one direction: {'; '.join(parts)}. On the others two edges are as near, "
        "or the edge is tightly curved."
    )


def _describe_recovery(results: Results, words: Wording) -> Markup:
    """Describe recovery; nothing if no network unshears, or there are no errors on taps."""
    kind, parts = choose_main_kind(results.pose_recovery), []
    if kind == "sheared":
        return Markup()
    recovery, spread = results.pose_recovery[kind], results.spread.pose_recovery[kind]
    for name in words.digits:
        text, value = "none, as slides do no harm", recovery.get(name)
        if value is not None:
            text = f"{value:.2f}{_format_interval(spread[name], '.2f')}"
        parts.append(f"{wording.name_quantity(name)} {text}")
    return wording.write_recovery(results, kind, parts)


def _format_interval(interval: Span, form: str) -> str:
    return "" if interval is None else f" [{interval[0]:{form}}, {interval[1]:{form}}]"


def _build_parts(results: Results, words: Wording, parts: Parts | None, by: str) -> Markup:
    """Build the folded table of recovery by `parts`; of errors if recovery is unknown."""
    kind, names = choose_main_kind(results.pose_mae), words.digits
    if kind == "sheared":
        return Markup()
    head = [f"sheared{ARROW}unsheared, by {by}", *map(wording.format_heading, names)]
    rows = []
    for name, part in (parts or {}).items():
        if part and kind in part.pose_recovery:
            head = [f"recovery, by {by}", *map(wording.name_quantity, names)]
            spread = part.spread.pose_recovery[kind]
            cells = format_cells(part.pose_recovery[kind], spread, dict.fromkeys(names, 2))
            rows.append([name, *cells])
        elif part and {"sheared", kind} <= set(part.pose_mae):
            before, after = part.pose_mae["sheared"], part.pose_mae[kind]
            cells = []
            for quantity, digits in names.items():
                shown = [format_number(errors[quantity], digits) for errors in (before, after)]
                cells.append(ARROW.join(shown))
            rows.append([name, *cells])
    return html.folded(f"By {by}", html.table(head, rows)) if rows else Markup()


def _describe_differences(results: Results, words: Wording) -> list[Markup]:
    """Describe the disentangled network less each other one, contact by contact."""
    subjects = {"edge_mm": "mm from the edge"}
    if "edge_mm" not in words.digits:
        subjects = {n: f"{get_unit(n)} of {wording.name_quantity(n)}" for n in words.digits}
    return [
        describe_differences(results, name, subject, 3, -1) for name, subject in subjects.items()
    ]
