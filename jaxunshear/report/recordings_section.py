"""Sections of a recorded run's page: what it learnt from and was scored on, and how its slides are paired."""

from collections.abc import Sequence

from markupsafe import Markup

from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import Target
from jaxunshear.evaluation.conformal import ELSEWHERE_NOTE
from jaxunshear.evaluation.recorded_descriptions import describe_test
from jaxunshear.report import html, labels
from jaxunshear.report.html import format_number
from jaxunshear.results.run import Results, Scores

PAIRING_TEXTS = {
    "rendered": "A slide's partner is what a renderer, a network that learnt from the taps, draws at the slide's pose: no tap "
    "need be recorded there, and the two poses are equal. How true the drawings are, the errors of pose on partners show.",
    "nearest": "A slide's partner is the recorded tap whose pose is nearest, in units of the labels' ranges. In training, a "
    "pair counts the less the further the two poses are apart.",
    "pose_id": "A slide's partner is the tap that was recorded at the same pose, under the same pose_id.",
    "simulated": "No recorded slide teaches: training slides are recorded taps whose pins are dragged as the contact simulator says, each "
    "paired with its tap. Recorded slides are for the test alone; there a slide's partner is what a renderer draws at its pose.",
    "file": "A slide's partner is the tap that a table of pairs names.",
}


def build_recordings_section(results: Results) -> Markup:
    reported, _ = results.recorded_facts
    rows = [
        [kind, *(str(counted[split]) for split in SPLITS)]
        for kind, counted in (("taps", reported.taps), ("slides", reported.slides))
        if any(counted.values())
    ]
    folders = dict.fromkeys(
        results.settings["paired"][kind] for kind in ("tap_folder", "slide_folder")
    )
    named = Markup(", ").join(
        Markup("<code>{}</code>").format(folder) for folder in folders if folder
    )
    facts = [
        Markup("Folder: {} (digest {}); sensor {}, {} pins.").format(
            named, reported.digest, reported.sensor, reported.pins
        ),
        f"Contacts: {reported.contacts}, {reported.dropped} of them left out. Pins are followed for sure in "
        f"{reported.pins_sure:.1%} of the others, in {reported.unsure} they are not.",
        f"Labels used, by their range in training: {'; '.join(map(_range, results.targets or ())) or 'none'}.",
    ]
    if reported.labelled < 1:
        facts.append(f"Labels of {reported.labelled:.0%} of the training slides teach.")
    if results.settings["paired"].get("unlabelled") == "read":
        facts.append(
            Markup(
                "The poses of slides without a label are those that <code>posenet_sheared</code> reads off them."
            )
        )
    if (taps := results.settings["paired"].get("direct_taps", "none")) != "none":
        taught = Markup("<code>posenet_sheared</code> also learns from {} taps.").format(taps)
        facts.append(taught)
    lead = (
        "Frames of a real sensor: networks learn from train, their best step is chosen on "
        f"validation, all figures are of test ({describe_test(results)})."
    )
    return html.section(
        "The recordings",
        lead,
        html.table(["contacts", *SPLITS], rows),
        *map(html.soft, facts),
        _fold_list(
            f"Frames left out ({reported.dropped})", reported.dropped_frames, reported.dropped
        ),
        _fold_list("Notes from reading them", reported.notes, len(reported.notes)),
    )


def build_intervals_section(results: Results) -> Markup:
    """Nothing of runs evaluated by an earlier version, or with few validation contacts."""
    widths, held = results.half_width or {}, results.coverage or {}
    names = [
        name
        for name in labels.list_targets(results)
        if any(name in reported for reported in held.values())
    ]
    rows = [
        [
            labels.name_kind(results, way),
            *(f"{format_number(widths[way][name])} ({reported[name]:.1%})" for name in names),
        ]
        for way, reported in held.items()
        if way in widths
    ]
    if not rows:
        return Markup()
    lead = (
        "Half-widths that hold 95 % of the errors on validation contacts of the same session; in "
        f"brackets the share of test contacts that they hold ({describe_test(results)}). "
        f"{ELSEWHERE_NOTE}. For yours: jaxunshear evaluate RUN --recordings DIR."
    )
    return html.section(
        "How far an answer may be off",
        lead,
        html.table(["pose read from", *map(labels.format_heading, names)], rows),
    )


def _range(target: Target) -> str:
    name = target.name
    if target.is_circular:
        return f"{labels.name_quantity(name)} over the full circle"
    low, high = target.centre - target.half_range, target.centre + target.half_range
    return f"{labels.name_quantity(name)} {low:.2f} to {high:.2f} {labels.get_unit(name)}"


def _fold_list(heading: str, lines: Sequence[str], count: int) -> Markup:
    """Folded away; nothing of no lines."""
    if not lines:
        return Markup()
    return html.folded(heading, html.listed(lines, count - len(lines)))


def build_pairing_section(results: Results) -> Markup:
    """Nothing where there are no pairs."""
    if results.pairing is None or (way := results.pairing.way) not in PAIRING_TEXTS:
        return Markup()
    names = labels.list_targets(results)
    rows = [
        [split, str(gap["pairs"]), *(_gap(gap[name]) for name in names)]
        for split, gap in results.pairing.gaps.items()
    ]
    head = ["pose of the partner off by", "pairs", *map(labels.format_heading, names)]
    note = html.soft("Median, and in brackets the 95th percentile.")
    return html.section("How slides are paired", PAIRING_TEXTS[way], html.table(head, rows), note)


def _gap(gap: Scores | int) -> str:
    assert not isinstance(gap, int)
    return f"{format_number(gap['median'])} ({format_number(gap['p95'])})"
