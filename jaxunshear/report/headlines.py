"""The cards at the top of a run's page."""

from collections.abc import Iterator

from markupsafe import Markup

from jaxunshear.config.networks import UNSHEARING
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.progress import format_duration
from jaxunshear.report import html, wording
from jaxunshear.report.html import format_number
from jaxunshear.report.wording import Wording
from jaxunshear.results.run import Results

QUANTITIES = {"edge_mm": "distance to the edge"}  # with names of their own on cards


def build_headlines(results: Results, words: Wording) -> Markup:
    """Build the cards of a run."""
    cards = [card for name in words.cards for card in CARDS[name](results, words)]
    return html.cards(*cards, _build_time_card(results))


def _build_similarity_cards(results: Results, words: Wording) -> Iterator[Markup]:
    """Build the card of likeness; only a run with a network that unshears has a bar to clear."""
    if not results.ms_ssim:
        return
    kind = choose_main_kind(results.ms_ssim)
    sheared, after = results.ms_ssim["sheared"]["overall"], results.ms_ssim[kind]["overall"]
    note = "; ".join(filter(None, (words.modality.drawn, words.likeness_note)))
    ok = None
    low = results.bars.get(f"ms_ssim.{kind}.overall")
    high = results.bars.get("ms_ssim.sheared.overall")
    if low and high and kind != "sheared":
        note = f"at least {low.bar:.2f} unsheared, at most {high.bar:.2f} sheared"
        ok = low.is_met(after) and high.is_met(sheared)
    title = f"Likeness to the {words.target} ({results.metric['ms_ssim']})"
    yield html.card(title, format_number(sheared), format_number(after), note, ok)


def _build_error_cards(results: Results, words: Wording) -> Iterator[Markup]:
    """Build a card for each main quantity; notes compare taps and direct prediction, or a bar."""
    pose = results.pose_mae
    kinds = (*reversed(UNSHEARING), "sheared_learnt", "sheared", "tap")
    kind = next((kind for kind in kinds if kind in pose), None)
    if kind is None:
        return
    for quantity in words.main_targets:
        before, after = "", _format_error(pose[kind][quantity], quantity)
        if kind not in ("sheared", "tap") and "sheared" in pose:
            before = _format_error(pose["sheared"][quantity], quantity)
        notes = [words.card_notes[kind]] if kind in words.card_notes else []
        for other in ("tap", "sheared_learnt"):
            if other in words.card_notes and other in pose and other != kind:
                error = _format_error(pose[other][quantity], quantity)
                notes.append(f"{words.card_notes[other]}: {error}")
        ok = None
        if bar := results.bars.get(f"pose_ratio.{kind}.{quantity}"):
            notes = [f"at most {bar.bar:g} of the sheared error"]
            ok = bar.is_met(results.pose_ratio[kind][quantity])
        name = QUANTITIES.get(quantity) or wording.name_quantity(quantity)
        after = f"{after} {wording.get_unit(quantity)}"
        yield html.card(f"Error in {name}", before, after, ", ".join(notes), ok)


def _format_error(value: float | None, quantity: str) -> str:
    return format_number(value, 2 if wording.get_unit(quantity) == "mm" else 1)


def _build_pin_cards(results: Results, words: Wording) -> Iterator[Markup]:
    pins, kind = results.pin_error, choose_main_kind(results.ms_ssim)
    before = format_number(pins["true_slide"]["rms_px"], 1)
    after = f"{format_number(pins[kind]['rms_px'], 2)} px"
    note = f"of {results.metric['image_px']} px; root mean square"
    yield html.card(f"Pins away from the {words.target}'s", before, after, note)


def _build_recovery_cards(results: Results, words: Wording) -> Iterator[Markup]:
    recovery = results.pose_recovery.get(choose_main_kind(results.pose_recovery))
    if recovery:
        quantities = words.main_targets
        values = ", ".join(format_number(recovery[quantity]) for quantity in quantities)
        names = ", ".join(map(wording.name_quantity, quantities))
        note = f"{names}; 1 is as good as taps, 0 as bad as slides as felt"
        yield html.card("Recovery", "", values, note)


def _build_time_card(results: Results) -> Markup:
    machine, total = results.machine, format_duration(sum(results.time_s.values()))
    note = f"sum of its stages; {machine.cores} cores, {machine.device.split(':')[0]}"
    return html.card("Entire run", "", total, note)


CARDS = {
    "likeness": _build_similarity_cards,
    "errors": _build_error_cards,
    "pins": _build_pin_cards,
    "recovery": _build_recovery_cards,
}
