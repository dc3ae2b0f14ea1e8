"""The cards that a run's page opens with."""

from markupsafe import Markup

from jaxunshear.evaluation.measurements import build_measurements
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.progress import format_duration
from jaxunshear.report import html, labels
from jaxunshear.report.html import format_number
from jaxunshear.results.run import Results, Table

# of a recorded run: the first of these that it has is what it is about
ESTIMATED_KINDS = ("unsheared", "sheared_learnt", "sheared", "tap")


def build_headlines(results: Results) -> Markup:
    shown = _build_simulated_cards(results) if results.simulated else _build_recorded_cards(results)
    return html.cards(*shown, _run_total(results))


def _build_simulated_cards(results: Results) -> list[Markup]:
    rows = {row.name: row for row in build_measurements(results).rows}
    similar, pose, pins = results.ms_ssim, results.pose_mae, results.pin_error
    name, kind = results.metric["ms_ssim"], choose_main_kind(similar)
    row, first = rows[f"ms_ssim.{kind}.overall"], rows["ms_ssim.sheared.overall"]
    held = (
        row.bar and kind != "sheared"
    )  # a run without a network that unshears has nothing to hold against a bar
    note = f"at least {row.bar:.2f} unsheared, at most {first.bar:.2f} sheared" if held else ""
    before, after = (
        format_number(similar["sheared"]["overall"]),
        format_number(similar[kind]["overall"]),
    )
    met = row.ok and first.ok if held else None
    shown = [html.card(f"Likeness to the tap ({name})", before, after, note, met)]
    for quantity in labels.list_main_targets(results) if kind in pose else ():
        ratio = rows.get(f"pose_ratio.{kind}.{quantity}")
        before, after = (_error(pose[image][quantity], quantity) for image in ("sheared", kind))
        note = f"at most {ratio.bar:g} of the sheared error" if ratio and ratio.bar else ""
        label = "distance to the edge" if quantity == "edge_mm" else labels.name_quantity(quantity)
        shown.append(
            html.card(
                f"Error in {label}",
                before,
                f"{after} {labels.get_unit(quantity)}",
                note,
                ratio.ok if ratio else None,
            )
        )
    moved = html.card(
        "Pins away from the tap's",
        format_number(pins["true_slide"]["rms_px"], 1),
        f"{format_number(pins[kind]['rms_px'], 2)} px",
        f"of {results.metric['image_px']} px; root mean square",
    )
    return [*shown, moved]


def _build_recorded_cards(results: Results) -> list[Markup]:
    pose, similar, chief = results.pose_mae, results.ms_ssim, labels.list_main_targets(results)
    shown = [_read(pose, quantity) for quantity in chief if pose]
    if similar:
        before, after = (
            format_number(similar[kind]["overall"])
            for kind in ("sheared", choose_main_kind(similar))
        )
        label = f"Likeness to the {labels.name_target(results)} ({results.metric['ms_ssim']})"
        shown.append(
            html.card(
                label,
                before,
                after,
                "of drawn pins; 1 is equal" if labels.reads_pins(results) else "1 is equal",
            )
        )
    recovery = results.pose_recovery.get("unsheared")
    if recovery:
        values = ", ".join(format_number(recovery[quantity]) for quantity in chief)
        note = f"{', '.join(labels.name_quantity(quantity) for quantity in chief)}; 1 is as good as taps, 0 as bad as slides as felt"
        shown.append(html.card("Recovery", "", values, note))
    return shown


def _read(pose: Table, quantity: str) -> Markup:
    """The error in one quantity: of slides before and after, of taps and of the direct way beside it."""
    kind = next(kind for kind in ESTIMATED_KINDS if kind in pose)
    before = (
        _error(pose["sheared"][quantity], quantity)
        if kind in ESTIMATED_KINDS[:2] and "sheared" in pose
        else ""
    )
    beside = {"tap": "taps: ", "sheared_learnt": "learnt from slides directly: "}
    notes = [
        f"{text}{_error(pose[k][quantity], quantity)}"
        for k, text in beside.items()
        if k in pose and k != kind
    ]
    if kind != "unsheared":
        notes.insert(
            0,
            {
                "tap": "taps",
                "sheared": "slides, as felt",
                "sheared_learnt": "learnt from slides directly",
            }[kind],
        )
    after = f"{_error(pose[kind][quantity], quantity)} {labels.get_unit(quantity)}"
    return html.card(f"Error in {labels.name_quantity(quantity)}", before, after, ", ".join(notes))


def _error(value: float | None, quantity: str) -> str:
    return format_number(value, 2 if labels.get_unit(quantity) == "mm" else 1)


def _run_total(results: Results) -> Markup:
    machine, total = results.machine, format_duration(sum(results.time_s.values()))
    return html.card(
        "Entire run",
        "",
        total,
        f"sum of its stages; {machine.cores} cores, {machine.device.split(':')[0]}",
    )
