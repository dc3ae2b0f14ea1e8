"""The section on poses: what a PoseNet reads of every kind of contact, and how much of the slide's damage is undone."""

from markupsafe import Markup

from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.report import html, labels, score_sections
from jaxunshear.report.html import format_number, format_with_interval
from jaxunshear.results.run import Parts, Results, Span

TITLE = "What a pose network reads"
UNSHEARED_ALIAS = "unsheared"  # in recorded results: the network that the run is about, once more


def build_pose_section(results: Results) -> Markup:
    ours, spread = results.pose_mae, results.spread.pose_mae
    if not ours:
        return html.section(TITLE, "This run has no PoseNet.")
    names, paper = labels.list_targets(results), results.paper["pose_mae"]
    known = [name for name in paper["tap"] if name in names and results.simulated]
    given = "what PoseNet is given" if labels.reads_pins(results) else "image given to PoseNet"
    head = [
        given,
        *map(labels.format_heading, names),
        *(Markup("{}<br>paper").format(labels.format_heading(q)) for q in known),
    ]
    rows = [
        [
            labels.name_kind(results, kind),
            *(
                format_with_interval(
                    ours[kind].get(q), spread[kind].get(q), labels.choose_digits(results, q)
                )
                for q in names
            ),
            *(format_number(paper.get(kind, {}).get(q)) for q in known),
        ]
        for kind in ours
        if kind != UNSHEARED_ALIAS
    ]
    strong, chance = [len(rows) - 1], results.baselines["pose_chance"]
    rows.append(
        [
            Markup("<i>one answer to every {}</i>").format(
                "image" if results.simulated else "contact"
            ),
            *(format_number(chance.get(q), labels.choose_digits(results, q)) for q in names),
            *("" for _ in known),
        ]
    )
    return html.section(
        TITLE,
        _lead(results, names),
        html.table(head, rows, range(1 + len(names), len(head)), strong),
        _smooth(results),
        _recovery(results),
        _by_part(results, results.pose_by_stimulus, "shape"),
        _by_part(results, results.pose_by_depth, "depth" if results.simulated else "z"),
        _by_part(results, results.pose_by_slide, "length of the slide"),
        *_describe_differences(results),
    )


def _smooth(results: Results) -> Markup:
    """The sentence on edge angles without those that are ambiguous; nothing if none are marked."""
    smooth, counts = results.pose_smooth, results.counts
    if smooth is None or not counts.test_smooth or not counts.test:
        return Markup()
    errors, spans = smooth.pose_mae, smooth.spread.pose_mae
    reported = [
        f"{labels.name_kind(results, kind)} {format_number(errors[kind]['edge_deg'], 1)}{_span(spans[kind]['edge_deg'], '.1f')}"
        for kind in errors
    ]
    return html.soft(
        f"Edge angle errors, deg, on the {counts.test_smooth / counts.test:.0%} of contacts whose nearest edge has one "
        f"direction: {'; '.join(reported)}. On the others two edges are as near, or the edge is tightly curved."
    )


def _lead(results: Results, names: list[str]) -> str:
    if results.simulated:
        lead = "Mean absolute error of a PoseNet that has only learned from taps."
        if "edge_mm" in names:
            lead += " x and yaw are ambiguous along a smooth edge; the distance to the edge and its local angle are not."
        return f"{lead} {_brackets(results)}"
    ours = results.pose_mae
    lead = "Mean absolute errors on held-out contacts, in the labels' own frame, of a PoseNet that has only learned from "
    if set(ours) == {"sheared_learnt"}:
        lead += "labelled slides."
    else:
        lead += (
            "taps; one row is of a PoseNet that learned from labelled slides."
            if "sheared_learnt" in ours
            else "taps."
        )
    return f"{lead} {_brackets(results)}"


def _brackets(results: Results) -> str:
    reported = labels.describe_intervals(results)
    return reported[0].upper() + reported[1:]


def _recovery(results: Results) -> Markup:
    """The sentence; nothing where no network unshears, or nothing is known of taps."""
    kind = choose_main_kind(results.pose_recovery)
    if kind == "sheared":
        return Markup()
    found, spread = results.pose_recovery[kind], results.spread.pose_recovery[kind]
    if results.simulated:
        undone = [
            f"{labels.name_quantity(q)} {x:.0%}{_span(spread[q], '.0%')}"
            for q, x in found.items()
            if x is not None
        ]
        text = f"Recovery, the part of the slide's damage that is undone, by the {kind} network: "
        return html.soft(f"{text}{', '.join(undone) or 'none'}.")
    reported = "; ".join(
        f"{labels.name_quantity(q)} {_format_recovery(found[q], spread[q])}"
        for q in labels.list_targets(results)
    )
    return Markup(
        "<p>Recovery, (as felt - unsheared) / (as felt - taps), by the {} network: {}. 1 is as good as taps, "
        "0 as bad as slides as felt.</p>{}"
    ).format(kind, reported, html.soft(_describe_paper_recovery(results)))


def _format_recovery(value: float | None, interval: Span) -> str:
    return "none, as slides do no harm" if value is None else f"{value:.2f}{_span(interval, '.2f')}"


def _describe_paper_recovery(results: Results) -> str:
    """Its recoveries: of another sensor and other quantities, they give the scale."""
    error = results.paper["pose_mae"]
    reported = [
        f"{(felt - error[DISENTANGLED][q]) / (felt - error['tap'][q]):.2f} in {labels.name_quantity(q)}"
        for q, felt in error["sheared"].items()
    ]
    return f"The paper's disentangled network, on another sensor and task, has a recovery of {' and '.join(reported)}."


def _span(interval: Span, form: str) -> str:
    return "" if interval is None else f" [{interval[0]:{form}}, {interval[1]:{form}}]"


def _by_part(results: Results, parts: Parts | None, by: str) -> Markup:
    """Each of `parts`, for the network that `build_pose_section` names; folded away. Recovery, or where nothing is known of
    taps errors. Nothing of runs evaluated by an earlier version."""
    names, kind = labels.list_targets(results), choose_main_kind(results.pose_mae)
    recovered, rows = False, []
    for part, found in (parts or {}).items():
        if not found:
            continue
        if kind in found.pose_recovery and kind != "sheared":
            recovered, spread = True, found.spread.pose_recovery[kind]
            rows.append(
                [
                    part,
                    *(
                        format_with_interval(found.pose_recovery[kind].get(q), spread.get(q), 2)
                        for q in names
                    ),
                ]
            )
        elif (
            not results.simulated and {"sheared", kind} <= set(found.pose_mae) and kind != "sheared"
        ):
            errors = (found.pose_mae["sheared"], found.pose_mae[kind])
            cells = [
                " \u2192 ".join(
                    format_number(error[q], labels.choose_digits(results, q)) for error in errors
                )
                for q in names
            ]
            rows.append([part, *cells])
    if not rows:
        return Markup()
    head = (
        [f"recovery, by {by}", *map(labels.name_quantity, names)]
        if recovered
        else [f"as felt \u2192 unsheared, by {by}", *map(labels.format_heading, names)]
    )
    return html.folded(f"By {by}", html.table(head, rows))


def _describe_differences(results: Results) -> list[Markup]:
    """The disentangled network less each other one, contact by contact, a sentence each."""
    if results.simulated:
        units = {
            q: "mm from the edge"
            if q == "edge_mm"
            else f"{labels.get_unit(q)} of {labels.name_quantity(q)}"
            for q in labels.list_main_targets(results)
        }
        shown = ["edge_mm"] if "edge_mm" in units else list(units)
        return [score_sections.describe_differences(results, q, units[q], 3, -1) for q in shown]
    return [
        _against(results, kind)
        for kind, columns in results.difference.items()
        if set(columns) != {"ms_ssim"}
    ]


def _against(results: Results, kind: str) -> Markup:
    found, spread = results.difference[kind], results.spread.difference[kind]
    reported = []
    for name in labels.list_targets(results):
        low, high = spread[name] or (0.0, 0.0)
        verdict = "within chance" if low <= 0 <= high else "better" if high < 0 else "worse"
        form = f"+.{labels.choose_digits(results, name)}f"
        figure = f"{found[name]:{form}}{_span(spread[name], form)} {labels.get_unit(name)}"
        reported.append(
            Markup("{} <b>{}</b> ({})").format(labels.name_quantity(name), verdict, figure)
        )
    other = (
        "a PoseNet that learnt from slides directly"
        if kind == "sheared_learnt"
        else labels.name_kind(results, kind)
    )
    return Markup(
        "<p>Slide by slide, the disentangled network's slides against {}: {}.</p>"
    ).format(other, Markup("; ").join(reported))
