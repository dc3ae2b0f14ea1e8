"""The report of a run: one HTML page, made from the files that evaluation wrote."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from markupsafe import Markup

from jaxunshear.config.networks import UNSHEARING
from jaxunshear.config.targets import get_unit
from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import write_text
from jaxunshear.progress import format_duration
from jaxunshear.report import (
    applications,
    contact_figures,
    html,
    montage,
    pose_section,
    recordings_section,
    score_sections,
    training_sections,
    wording,
)
from jaxunshear.report.html import format_number
from jaxunshear.report.tasks_page import write_tasks_page
from jaxunshear.report.wording import Wording
from jaxunshear.results.record_files import read_record, read_times
from jaxunshear.results.run import EVALUATE_REMEDY, Results

QUANTITIES = {"edge_mm": "distance to the edge"}  # with names of their own on cards


def write_report(run_dir: Path) -> Path:
    """Write `report.html` into `run_dir` and return its path.

    A missing log leaves out its curves. Runs that unshear nothing have no montage. Raises UserError
    if the run has not been evaluated or its files are damaged.
    """
    run_dir = Path(run_dir)
    results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
    if results.frames:
        return write_tasks_page(run_dir / "report.html", results)
    results = replace(results, time_s={**results.time_s, **read_times(run_dir)})
    try:
        words = wording.describe(results)
        images = montage.read_montage(run_dir / "montage.npz") if results.ms_ssim else None
        head = build_headlines(results, words)
        sections = _build_sections(run_dir, results, words)
        if images:
            sections.insert(0, montage.build_section(images, words))
        lead, made = wording.write_lead(results, words), wording.describe_source(results)
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: {EVALUATE_REMEDY}") from error
    path = run_dir / "report.html"
    opening = html.opening(results.experiment, results.claim, lead, made)
    contents = html.build_contents(sections)
    page = html.page(f"jaxunshear: {results.experiment}", opening, contents, head, *sections)
    write_text(path, page)
    return path


def _build_sections(run_dir: Path, results: Results, words: Wording) -> list[Markup]:
    """Build the sections below the montage in the order of the page, without empty ones."""
    trainings = training_sections.read_trainings(run_dir)
    applied = applications.build_sections(run_dir)
    sections = [
        applied.pop("servo", Markup()),  # first, as it shows best what unsheared images are for
        score_sections.build_similarity_section(results, words),
        pose_section.build_pose_section(results, words),
        contact_figures.build_contact_section(run_dir, words),
        score_sections.build_estimators_section(results, words),
        score_sections.build_further_tests(results, words),
        score_sections.build_pin_section(results, words),
        recordings_section.build_recordings_section(results),
        recordings_section.build_pairing_section(results, words),
        recordings_section.build_bounds_section(results, words),
        score_sections.build_swap_section(results, words),
        *applied.values(),
        training_sections.build_training_section(trainings),
        training_sections.build_times_section(results, words, trainings),
        training_sections.build_contacts_section(results),
        training_sections.build_provenance_section(results),
    ]
    return [section for section in sections if section]


def build_headlines(results: Results, words: Wording) -> Markup:
    """Build the cards at the top of a run's page."""
    build = {
        "likeness": _build_similarity_cards,
        "errors": _build_error_cards,
        "pins": _build_pin_cards,
        "recovery": _build_recovery_cards,
    }
    cards = [card for name in words.cards for card in build[name](results, words)]
    machine, total = results.machine, format_duration(sum(results.time_s.values()))
    note = f"sum of its stages; {machine.cores} cores, {machine.device.split(':')[0]}"
    return html.cards(*cards, html.card("Entire run", "", total, note))


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
        after = f"{after} {get_unit(quantity)}"
        yield html.card(f"Error in {name}", before, after, ", ".join(notes), ok)


def _format_error(value: float | None, quantity: str) -> str:
    return format_number(value, 2 if get_unit(quantity) == "mm" else 1)


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
        note = f"{names}; 1 is as good as taps, 0 as bad as sheared images"
        yield html.card("Recovery", "", values, note)
