"""Sections of a page on recordings: what they are, pairs of contacts and error bounds."""

from typing import cast

from markupsafe import Markup

from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import Target, get_unit
from jaxunshear.evaluation.intervals import ELSEWHERE_NOTE
from jaxunshear.evaluation.recorded_results import describe_test
from jaxunshear.report import html, wording
from jaxunshear.report.html import format_number
from jaxunshear.report.wording import TEXTS, Wording
from jaxunshear.results.run import Recordings, Results, Scores


def build_recordings_section(results: Results) -> Markup:
    """Build the section on the recordings; nothing if there are none."""
    recordings = results.recordings
    if recordings is None:
        return Markup()
    rows = []
    for kind, counts in (("taps", recordings.taps), ("slides", recordings.slides)):
        if any(counts.values()):
            rows.append([kind, *(str(counts[split]) for split in SPLITS)])
    folded = Markup()
    for heading, lines, count in (
        (f"Frames left out ({recordings.dropped})", recordings.dropped_frames, recordings.dropped),
        ("Notes from reading them", recordings.notes, 0),
    ):
        if lines:
            folded += html.folded(heading, html.listed(lines, count - len(lines)))
    facts = map(html.soft, _describe_recordings(results, recordings))
    body = [html.table(["contacts", *SPLITS], rows), *facts, folded]
    return wording.section("recordings", *body, test=describe_test(results))


def _describe_recordings(results: Results, recordings: Recordings) -> list[str]:
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
    if paired.get("unlabelled") == "pseudo_label":
        text = Markup("The poses of slides without a label are those that {} reads off them.")
        facts.append(text.format(network))
    if (taps := paired.get("direct_taps", "none")) != "none":
        facts.append(Markup("{} also learns from {} taps.").format(network, taps))
    return facts


def _describe_range(target: Target) -> str:
    name = wording.name_quantity(target.name)
    if target.is_circular:
        return f"{name} over the full circle"
    if target.classes:
        return f"{name} of {target.classes}"
    low, high = target.centre - target.half_range, target.centre + target.half_range
    return f"{name} {low:.2f} to {high:.2f} {get_unit(target.name)}"


def build_pairing_section(results: Results, words: Wording) -> Markup:
    """Build the section on partners of slides; nothing if there are no pairs."""
    if results.pairing is None or results.pairing.way not in TEXTS["pairing"]:
        return Markup()
    rows = []
    for split, gaps in results.pairing.gaps.items():
        cells = [str(gaps["pairs"])]
        for name in words.digits:
            gap = cast(Scores, gaps[name])
            cells.append(f"{format_number(gap['median'])} ({format_number(gap['p95'])})")
        rows.append([split, *cells])
    head = ["pose of the partner off by", "pairs", *map(wording.format_heading, words.digits)]
    note = html.soft(TEXTS["sections"]["pairing"]["note"])
    pairing = TEXTS["pairing"][results.pairing.way]
    return wording.section("pairing", html.table(head, rows), note, pairing=pairing)


def build_bounds_section(results: Results, words: Wording) -> Markup:
    """Build the section on error bounds; nothing if validation contacts were too few for them."""
    widths, coverage = results.half_width or {}, results.coverage or {}
    bounded = {name for shares in coverage.values() for name in shares}
    names = [name for name in words.digits if name in bounded]
    rows = []
    for kind, shares in coverage.items():
        if kind in widths:
            cells = [f"{format_number(widths[kind][name])} ({shares[name]:.1%})" for name in names]
            rows.append([words.kinds[kind], *cells])
    if not rows:
        return Markup()
    table = html.table(["pose read from", *map(wording.format_heading, names)], rows)
    test = describe_test(results)
    return wording.section("bounds", table, test=test, elsewhere=ELSEWHERE_NOTE)
