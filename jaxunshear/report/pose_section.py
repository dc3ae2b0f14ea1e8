"""The section of a run's page on poses: errors by kind of contact, and recovery."""

from markupsafe import Markup

from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.report import html, labels
from jaxunshear.report.html import format_cells, format_number, format_paper_heading
from jaxunshear.report.score_sections import describe_differences
from jaxunshear.results.run import PartPoses, Parts, Results, Span

TITLE = "What a pose network reads"
UNSHEARED_ALIAS = "unsheared"  # in recorded results: the run's main network, once more
ARROW = " \u2192 "


def build_pose_section(results: Results) -> Markup:
    """Build the section on errors of poses, with all that is derived from them."""
    errors, spread = results.pose_mae, results.spread.pose_mae
    if not errors:
        return html.section(TITLE, "This run has no PoseNet.")
    digits, paper = labels.choose_target_digits(results), results.paper["pose_mae"]
    headings = [labels.format_heading(name) for name in digits]
    paper_names = [name for name in paper["tap"] if name in digits and results.simulated]
    paper_headings = [format_paper_heading(labels.format_heading(name)) for name in paper_names]
    rows: list[list[str]] = []
    for kind, values in errors.items():
        if kind != UNSHEARED_ALIAS:
            cells = format_cells(values, spread[kind], digits)
            paper_cells = html.format_paper_cells(paper.get(kind, {}), paper_names)
            rows.append([labels.name_kind(results, kind), *cells, *paper_cells])
    main_row = len(rows) - 1
    contact = "image" if results.simulated else "contact"
    constant_answer = Markup("<i>one answer to every {}</i>").format(contact)
    cells = format_cells(results.baselines["pose_chance"], {}, digits)
    rows.append([constant_answer, *cells, *("" for _ in paper_names)])
    given = "what PoseNet is given" if labels.uses_pins(results) else "image given to PoseNet"
    head = [given, *headings, *paper_headings]
    return html.section(
        TITLE,
        f"{_describe_posenet(results)} {_capitalise(labels.describe_intervals(results))}",
        html.table(head, rows, range(1 + len(headings), len(head)), [main_row]),
        _describe_unambiguous_edges(results),
        _describe_recovery(results),
        _build_parts(results, results.pose_by_stimulus, "shape"),
        _build_parts(results, results.pose_by_depth, "depth" if results.simulated else "z"),
        _build_parts(results, results.pose_by_slide, "length of the slide"),
        *_describe_differences(results),
    )


def _capitalise(text: str) -> str:
    return text[0].upper() + text[1:]


def _describe_posenet(results: Results) -> str:
    if results.simulated:
        lead = "Mean absolute error of a PoseNet that has only learned from taps."
        if "edge_mm" in labels.list_targets(results):
            lead += (
                " x and yaw are ambiguous along a smooth edge; the distance to the edge and its "
                "local angle are not."
            )
        return lead
    training = "taps."
    if set(results.pose_mae) == {"sheared_learnt"}:
        training = "labelled slides."
    elif "sheared_learnt" in results.pose_mae:
        training = "taps; one row is of a PoseNet that learned from labelled slides."
    return (
        "Mean absolute errors on held-out contacts, in the labels' own frame, of a PoseNet that "
        f"has only learned from {training}"
    )


def _describe_unambiguous_edges(results: Results) -> Markup:
    """Describe errors of edge angles without ambiguous ones; nothing if none are marked."""
    smooth, counts = results.pose_smooth, results.counts
    if smooth is None or not counts.test_smooth or not counts.test:
        return Markup()
    parts = []
    for kind, errors in smooth.pose_mae.items():
        interval = _format_interval(smooth.spread.pose_mae[kind]["edge_deg"], ".1f")
        error = format_number(errors["edge_deg"], 1)
        parts.append(f"{labels.name_kind(results, kind)} {error}{interval}")
    return html.soft(
        f"Edge angle errors, deg, on the {counts.test_smooth / counts.test:.0%} of contacts whose "
        f"nearest edge has one direction: {'; '.join(parts)}. On the others two edges are as near, "
        "or the edge is tightly curved."
    )


def _describe_recovery(results: Results) -> Markup:
    """Describe recovery; nothing if no network unshears, or there are no errors on taps."""
    kind = choose_main_kind(results.pose_recovery)
    if kind == "sheared":
        return Markup()
    recovery, spread = results.pose_recovery[kind], results.spread.pose_recovery[kind]
    if results.simulated:
        parts = [
            f"{labels.name_quantity(name)} {value:.0%}{_format_interval(spread[name], '.0%')}"
            for name, value in recovery.items()
            if value is not None
        ]
        return html.soft(
            "Recovery, the part of the slide's damage that is undone, by the "
            f"{kind} network: {', '.join(parts) or 'none'}."
        )
    parts = []
    for name in labels.list_targets(results):
        text, value = "none, as slides do no harm", recovery[name]
        if value is not None:
            text = f"{value:.2f}{_format_interval(spread[name], '.2f')}"
        parts.append(f"{labels.name_quantity(name)} {text}")
    return Markup(
        "<p>Recovery, (as felt - unsheared) / (as felt - taps), by the {} network: {}. 1 is as "
        "good as taps, 0 as bad as slides as felt.</p>{}"
    ).format(kind, "; ".join(parts), html.soft(_describe_paper_recovery(results)))


def _describe_paper_recovery(results: Results) -> str:
    """Describe the paper's recoveries, which are of another sensor and give the scale."""
    error, parts = results.paper["pose_mae"], []
    for name, sheared in error["sheared"].items():
        recovery = (sheared - error[DISENTANGLED][name]) / (sheared - error["tap"][name])
        parts.append(f"{recovery:.2f} in {labels.name_quantity(name)}")
    return (
        "The paper's disentangled network, on another sensor and task, has a recovery of "
        f"{' and '.join(parts)}."
    )


def _format_interval(interval: Span, form: str) -> str:
    return "" if interval is None else f" [{interval[0]:{form}}, {interval[1]:{form}}]"


def _build_parts(results: Results, parts: Parts | None, by: str) -> Markup:
    """Build the folded table of recovery by `parts`; of errors if recovery is unknown.

    Results of an earlier version have no parts and give no table.
    """
    kind = choose_main_kind(results.pose_mae)
    names = labels.list_targets(results)
    if kind == "sheared":
        return Markup()
    recovered, rows = False, []
    for name, part in (parts or {}).items():
        if not part:
            continue
        if kind in part.pose_recovery:
            recovered, spread = True, part.spread.pose_recovery[kind]
            cells = format_cells(part.pose_recovery[kind], spread, dict.fromkeys(names, 2))
            rows.append([name, *cells])
        elif not results.simulated and {"sheared", kind} <= set(part.pose_mae):
            rows.append([name, *_format_error_changes(results, part, kind)])
    if not rows:
        return Markup()
    head = [f"as felt{ARROW}unsheared, by {by}", *map(labels.format_heading, names)]
    if recovered:
        head = [f"recovery, by {by}", *map(labels.name_quantity, names)]
    return html.folded(f"By {by}", html.table(head, rows))


def _format_error_changes(results: Results, part: PartPoses, kind: str) -> list[str]:
    before, after, cells = part.pose_mae["sheared"], part.pose_mae[kind], []
    for name, digits in labels.choose_target_digits(results).items():
        errors = format_number(before[name], digits), format_number(after[name], digits)
        cells.append(ARROW.join(errors))
    return cells


def _describe_differences(results: Results) -> list[Markup]:
    """Describe the disentangled network less each other one, contact by contact."""
    if not results.simulated:
        return [
            _describe_recorded_difference(results, kind)
            for kind, columns in results.difference.items()
            if set(columns) != {"ms_ssim"}
        ]
    names = labels.list_main_targets(results)
    if "edge_mm" in names:
        return [describe_differences(results, "edge_mm", "mm from the edge", 3, -1)]
    sentences = []
    for name in names:
        subject = f"{labels.get_unit(name)} of {labels.name_quantity(name)}"
        sentences.append(describe_differences(results, name, subject, 3, -1))
    return sentences


def _describe_recorded_difference(results: Results, kind: str) -> Markup:
    differences, spread = results.difference[kind], results.spread.difference[kind]
    parts = []
    for name, digits in labels.choose_target_digits(results).items():
        low, high = spread[name] or (0.0, 0.0)
        verdict = "within chance" if low <= 0 <= high else "better" if high < 0 else "worse"
        form = f"+.{digits}f"
        interval = _format_interval(spread[name], form)
        figure = f"{differences[name]:{form}}{interval} {labels.get_unit(name)}"
        quantity = labels.name_quantity(name)
        parts.append(Markup("{} <b>{}</b> ({})").format(quantity, verdict, figure))
    other = labels.name_kind(results, kind)
    if kind == "sheared_learnt":
        other = "a PoseNet that learnt from slides directly"
    return Markup(
        "<p>Slide by slide, the disentangled network's slides against {}: {}.</p>"
    ).format(other, Markup("; ").join(parts))
