"""The cards at the top of a run's page."""

from collections.abc import Mapping

from markupsafe import Markup

from jaxunshear.evaluation.measurements import build_measurements
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.progress import format_duration
from jaxunshear.report import html, labels
from jaxunshear.report.html import format_number
from jaxunshear.results.measurement import Measurement
from jaxunshear.results.run import Results, Table

# the main kind of a recorded run is the first of these that it has
ESTIMATED_KINDS = ("unsheared", "sheared_learnt", "sheared", "tap")
KIND_NOTES = {
    "tap": "taps",
    "sheared": "slides, as felt",
    "sheared_learnt": "learnt from slides directly",
}


def build_headlines(results: Results) -> Markup:
    """Build the cards of a run."""
    build = _build_simulated_cards if results.simulated else _build_recorded_cards
    return html.cards(*build(results), _build_time_card(results))


def _build_simulated_cards(results: Results) -> list[Markup]:
    rows = {row.name: row for row in build_measurements(results).rows}
    kind, pins = choose_main_kind(results.ms_ssim), results.pin_error
    cards = [_build_similarity_card(results, rows, kind)]
    for quantity in labels.list_main_targets(results) if kind in results.pose_mae else ():
        ratio = rows.get(f"pose_ratio.{kind}.{quantity}")
        before = _format_error(results.pose_mae["sheared"][quantity], quantity)
        after = _format_error(results.pose_mae[kind][quantity], quantity)
        note = f"at most {ratio.bar:g} of the sheared error" if ratio and ratio.bar else ""
        name = "distance to the edge" if quantity == "edge_mm" else labels.name_quantity(quantity)
        after = f"{after} {labels.get_unit(quantity)}"
        ok = ratio.ok if ratio else None
        cards.append(html.card(f"Error in {name}", before, after, note, ok))
    before = format_number(pins["true_slide"]["rms_px"], 1)
    after = f"{format_number(pins[kind]['rms_px'], 2)} px"
    note = f"of {results.metric['image_px']} px; root mean square"
    return [*cards, html.card("Pins away from the tap's", before, after, note)]


def _build_similarity_card(results: Results, rows: Mapping[str, Measurement], kind: str) -> Markup:
    """Build the card of likeness; only a run with a network that unshears has a bar to clear."""
    row, sheared = rows[f"ms_ssim.{kind}.overall"], rows["ms_ssim.sheared.overall"]
    note, ok = "", None
    if row.bar and kind != "sheared":
        note = f"at least {row.bar:.2f} unsheared, at most {sheared.bar:.2f} sheared"
        ok = row.ok and sheared.ok
    before = format_number(results.ms_ssim["sheared"]["overall"])
    after = format_number(results.ms_ssim[kind]["overall"])
    return html.card(f"Likeness to the tap ({results.metric['ms_ssim']})", before, after, note, ok)


def _build_recorded_cards(results: Results) -> list[Markup]:
    pose, likeness = results.pose_mae, results.ms_ssim
    quantities = labels.list_main_targets(results)
    cards = [_build_error_card(pose, quantity) for quantity in quantities if pose]
    if likeness:
        before = format_number(likeness["sheared"]["overall"])
        after = format_number(likeness[choose_main_kind(likeness)]["overall"])
        title = f"Likeness to the {labels.name_target(results)} ({results.metric['ms_ssim']})"
        note = "of drawn pins; 1 is equal" if labels.uses_pins(results) else "1 is equal"
        cards.append(html.card(title, before, after, note))
    if recovery := results.pose_recovery.get("unsheared"):
        values = ", ".join(format_number(recovery[quantity]) for quantity in quantities)
        names = ", ".join(map(labels.name_quantity, quantities))
        note = f"{names}; 1 is as good as taps, 0 as bad as slides as felt"
        cards.append(html.card("Recovery", "", values, note))
    return cards


def _build_error_card(pose: Table, quantity: str) -> Markup:
    """Build the card of a recorded run's error; its notes compare taps and direct prediction."""
    kind = next(kind for kind in ESTIMATED_KINDS if kind in pose)
    before = ""
    if kind in ("unsheared", "sheared_learnt") and "sheared" in pose:
        before = _format_error(pose["sheared"][quantity], quantity)
    notes = [] if kind == "unsheared" else [KIND_NOTES[kind]]
    for other in ("tap", "sheared_learnt"):
        if other in pose and other != kind:
            error = _format_error(pose[other][quantity], quantity)
            notes.append(f"{KIND_NOTES[other]}: {error}")
    after = f"{_format_error(pose[kind][quantity], quantity)} {labels.get_unit(quantity)}"
    return html.card(f"Error in {labels.name_quantity(quantity)}", before, after, ", ".join(notes))


def _format_error(value: float | None, quantity: str) -> str:
    return format_number(value, 2 if labels.get_unit(quantity) == "mm" else 1)


def _build_time_card(results: Results) -> Markup:
    machine, total = results.machine, format_duration(sum(results.time_s.values()))
    note = f"sum of its stages; {machine.cores} cores, {machine.device.split(':')[0]}"
    return html.card("Entire run", "", total, note)
