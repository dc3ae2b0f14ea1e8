"""Sections of a recorded run's page: its recordings, pairs of contacts and error bounds."""

from collections.abc import Sequence

from markupsafe import Markup

from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import Target
from jaxunshear.evaluation.conformal import ELSEWHERE_NOTE
from jaxunshear.evaluation.recorded_results import describe_test
from jaxunshear.report import html, labels
from jaxunshear.report.html import format_number
from jaxunshear.results.run import Results, Scores

PAIRING_TEXTS = {
    "rendered": (
        "A slide's partner is what a renderer, a network that learnt from the taps, draws at the "
        "slide's pose: no tap need be recorded there, and the two poses are equal. How true the "
        "drawings are, the errors of pose on partners show."
    ),
    "nearest": (
        "A slide's partner is the recorded tap whose pose is nearest, in units of the labels' "
        "ranges. In training, a pair counts the less the further the two poses are apart."
    ),
    "pose_id": (
        "A slide's partner is the tap that was recorded at the same pose, under the same pose_id."
    ),
    "simulated": (
        "No recorded slide teaches: training slides are recorded taps whose pins are dragged as "
        "the contact simulator says, each paired with its tap. Recorded slides are for the test "
        "alone; there a slide's partner is what a renderer draws at its pose."
    ),
    "file": "A slide's partner is the tap that a table of pairs names.",
}


def build_sections(results: Results) -> list[Markup]:
    """Build the sections in the order of the page."""
    return [
        _build_recordings_section(results),
        _build_pairing_section(results),
        _build_intervals_section(results),
    ]


def _build_recordings_section(results: Results) -> Markup:
    recordings, _ = results.recorded_facts
    rows = []
    for kind, counts in (("taps", recordings.taps), ("slides", recordings.slides)):
        if any(counts.values()):
            rows.append([kind, *(str(counts[split]) for split in SPLITS)])
    lead = (
        "Frames of a real sensor: networks learn from train, their best step is chosen on "
        f"validation, all figures are of test ({describe_test(results)})."
    )
    dropped, notes = recordings.dropped, recordings.notes
    return html.section(
        "The recordings",
        lead,
        html.table(["contacts", *SPLITS], rows),
        *map(html.soft, _describe_recordings(results)),
        _fold_list(f"Frames left out ({dropped})", recordings.dropped_frames, dropped),
        _fold_list("Notes from reading them", notes, len(notes)),
    )


def _describe_recordings(results: Results) -> list[str]:
    recordings, _ = results.recorded_facts
    paired = results.settings["paired"]
    folders = dict.fromkeys((paired["tap_folder"], paired["slide_folder"]))
    codes = [Markup("<code>{}</code>").format(folder) for folder in folders if folder]
    ranges = "; ".join(map(_describe_range, results.targets or ()))
    facts = [
        Markup("Folder: {} (digest {}); sensor {}, {} pins.").format(
            Markup(", ").join(codes), recordings.digest, recordings.sensor, recordings.pins
        ),
        f"Contacts: {recordings.contacts}, {recordings.dropped} of them left out. Pins are "
        f"followed for sure in {recordings.pins_sure:.1%} of the others, in {recordings.unsure} "
        "they are not.",
        f"Labels used, by their range in training: {ranges or 'none'}.",
    ]
    if recordings.labelled < 1:
        facts.append(f"Labels of {recordings.labelled:.0%} of the training slides teach.")
    network = Markup("<code>posenet_sheared</code>")
    if paired.get("unlabelled") == "read":
        text = Markup("The poses of slides without a label are those that {} reads off them.")
        facts.append(text.format(network))
    if (taps := paired.get("direct_taps", "none")) != "none":
        facts.append(Markup("{} also learns from {} taps.").format(network, taps))
    return facts


def _describe_range(target: Target) -> str:
    name = labels.name_quantity(target.name)
    if target.is_circular:
        return f"{name} over the full circle"
    low, high = target.centre - target.half_range, target.centre + target.half_range
    return f"{name} {low:.2f} to {high:.2f} {labels.get_unit(target.name)}"


def _fold_list(heading: str, lines: Sequence[str], count: int) -> Markup:
    """Fold the first lines of `count` away under a heading; nothing if there are none."""
    if not lines:
        return Markup()
    return html.folded(heading, html.listed(lines, count - len(lines)))


def _build_pairing_section(results: Results) -> Markup:
    """Build the section on partners of slides; nothing if there are no pairs."""
    if results.pairing is None or results.pairing.way not in PAIRING_TEXTS:
        return Markup()
    names, rows = labels.list_targets(results), []
    for split, gaps in results.pairing.gaps.items():
        cells = [_format_gap(gaps[name]) for name in names]
        rows.append([split, str(gaps["pairs"]), *cells])
    head = ["pose of the partner off by", "pairs", *map(labels.format_heading, names)]
    note = html.soft("Median, and in brackets the 95th percentile.")
    lead = PAIRING_TEXTS[results.pairing.way]
    return html.section("How slides are paired", lead, html.table(head, rows), note)


def _format_gap(gap: Scores | int) -> str:
    assert not isinstance(gap, int)
    return f"{format_number(gap['median'])} ({format_number(gap['p95'])})"


def _build_intervals_section(results: Results) -> Markup:
    """Build the section on error bounds.

    There is none for runs of an earlier version, or with few validation contacts.
    """
    widths, coverage = results.half_width or {}, results.coverage or {}
    bounded = {name for shares in coverage.values() for name in shares}
    names = [name for name in labels.list_targets(results) if name in bounded]
    rows = []
    for kind, shares in coverage.items():
        if kind in widths:
            cells = [f"{format_number(widths[kind][name])} ({shares[name]:.1%})" for name in names]
            rows.append([labels.name_kind(results, kind), *cells])
    if not rows:
        return Markup()
    lead = (
        "Half-widths that hold 95 % of the errors on validation contacts of the same session; in "
        f"brackets the share of test contacts that they hold ({describe_test(results)}). "
        f"{ELSEWHERE_NOTE}. For yours: jaxunshear evaluate RUN --recordings DIR."
    )
    head = ["pose read from", *map(labels.format_heading, names)]
    return html.section("How far an answer may be off", lead, html.table(head, rows))
