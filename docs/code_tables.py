"""Tables of latent codes: what they leak, and what the decoders make of exchanged ones."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import fmean

from docs.reading import (
    EDGE_TARGETS,
    format_figures,
    format_interval,
    format_line,
    format_ratio,
    format_seeds,
    load_cells,
    start_table,
)
from jaxunshear.evaluation.codes import EXCHANGED, OWN
from jaxunshear.results.sweep import CellResult, Figure, Figures

RECORDED_TARGETS = {"y_mm": 3, "z_mm": 3, "Rz_deg": 2}
LEAKS = ("slide from z_p", "pose from z_s")
PARTS = {"all": "all", "sticking": "not all of the skin slips", "slipped": "all of it slips"}


def tabulate_parted_skin() -> str:
    """Tabulate the leaks of codes of recorded pins."""
    return _tabulate_leaks(load_cells("parted_skin"), "recorded, pins")


def tabulate_parted_skin_images() -> str:
    """Tabulate the leaks of codes of recorded images."""
    return _tabulate_leaks(_load_images(), "recorded, images")


def tabulate_parted_leaks() -> str:
    """Tabulate the leaks of codes of simulated pins."""
    return _tabulate_leaks(load_cells("parted"), "simulated, pins")


def _load_images() -> Sequence[CellResult]:
    """Return the cells over recorded images, with the seeds of their repeats."""
    repeats = {cell.label: cell for cell in load_cells("parted_skin_images_repeats")}
    cells = []
    for cell in load_cells("parted_skin_images"):
        again = repeats.get(cell.label, cell)
        count = len({*cell.seeds, *again.seeds})
        joined = replace(
            cell,
            label=f"{cell.label} ({count} seed{'s' if count > 1 else ''})",
            metrics=_join_seeds(cell.metrics, again.metrics),
            ablation=_join_seeds(cell.ablation, again.ablation),
        )
        cells.append(joined)
    return cells


def _join_seeds(figures: Figures, repeats: Figures) -> Figures:
    """Return those figures that have seeds, with the seeds of both."""
    joined = {}
    for name, figure in figures.items():
        if figure.per_seed:
            seeds = {**figure.per_seed, **(repeats[name].per_seed or {})}
            joined[name] = Figure(fmean(seeds.values()), None, seeds)
    return joined


def _tabulate_leaks(table: Sequence[CellResult], head: str) -> str:
    """Tabulate R2 of the strongest probe for both leaks, beside its ceiling."""
    heads = [
        f"{leak}: {field}"
        for leak in LEAKS
        for field in ("R2", "share of ceiling", "largest share")
    ]
    lines = start_table(format_line(head, heads))
    for cell in table:
        shares = [
            format_seeds(cell.ablation[f"{leak}/{field}"])
            for leak in LEAKS
            for field in ("r2", "share", "largest share")
        ]
        lines.append(format_line(cell.label, shares))
    return "\n".join(lines)


def tabulate_parted_skin_errors() -> str:
    """Tabulate errors of unsheared recorded pins, and the standard scores of their codes."""
    return _tabulate_recorded_errors(load_cells("parted_skin"), "recorded, pins", format_interval)


def tabulate_parted_skin_images_errors() -> str:
    """Tabulate errors of unsheared recorded images, and the standard scores of their codes."""
    return _tabulate_recorded_errors(_load_images(), "recorded, images", format_seeds)


def _tabulate_recorded_errors(
    table: Sequence[CellResult], head: str, format_error: Callable[[Figure, int], str]
) -> str:
    scores = ("MIG", "SAP", "DCI disentanglement")
    heads = ["unsheared: y, mm", "z, mm", "Rz, deg", "slide x, mm", "slide y, mm", *scores]
    lines = start_table(format_line(head, heads))
    for cell in table:
        cells = [
            format_error(cell.metrics[f"pose/disentangled/{target}"], digits)
            for target, digits in RECORDED_TARGETS.items()
        ]
        cells += [format_seeds(cell.ablation[f"slide_{axis}_mm, all/mae"]) for axis in "xy"]
        cells += [f"{cell.ablation[f'standard scores/{name}'].mean:.2f}" for name in scores]
        lines.append(format_line(cell.label, cells))
    return "\n".join(lines)


def tabulate_parted_pins() -> str:
    """Tabulate likeness, pins and edge errors of the simulated networks, and what DS draws."""
    lines = start_table(
        "| | MS-SSIM@4 | pins, px rms | edge distance, mm | edge angle, deg "
        "| DS, codes exchanged, px | of its own, px | exchanged over own |"
    )
    cells = load_cells("parted")
    lines.append(format_line("tap", ["1", "0", *_format_edge(cells[0], "tap"), "", "", ""]))
    lines.append(format_line("sheared", [*_format_images(cells[0], "sheared"), "", "", ""]))
    for cell in cells:
        drawn = [cell.ablation[f"DS, codes {codes}/rms_px"] for codes in (EXCHANGED, OWN)]
        figures = [*map(format_seeds, drawn), format_ratio(*drawn)]
        lines.append(format_line(cell.label, [*_format_images(cell, "disentangled"), *figures]))
    return "\n".join(lines)


def _format_images(cell: CellResult, kind: str) -> list[str]:
    """Format MS-SSIM, pin error and edge errors of images of a kind."""
    likeness = format_interval(cell.metrics[f"ms_ssim/{kind}"], 3)
    pins = format_interval(cell.metrics[f"pins/{kind}"], 2)
    return [likeness, pins, *_format_edge(cell, kind)]


def _format_edge(cell: CellResult, kind: str) -> list[str]:
    return format_figures(cell.metrics, EDGE_TARGETS, f"pose/{kind}/")


def tabulate_slide_read() -> str:
    """Tabulate error and coverage of the slide predicted from codes, by whether it has slipped."""
    lines = start_table(
        "| codes of | slides | error in x, mm | y, mm | twist, deg "
        "| 95 % intervals hold, x | y | twist |"
    )
    for cell in load_cells("slide_read"):
        for part, label in PARTS.items():
            cells = [
                format_seeds(cell.ablation[f"{name}, {part}/{field}"])
                for field in ("mae", "coverage")
                for name in ("slide_x_mm", "slide_y_mm", "slide_twist_deg")
            ]
            lines.append(format_line(cell.label, [label, *cells]))
    return "\n".join(lines)


def tabulate_end_to_end() -> str:
    """Tabulate edges from taps, from unsheared slides, and from slides learnt directly."""
    kinds = {"tap": "tap", "disentangled": "unsheared", "sheared_learnt": "learnt directly"}
    lines = start_table(
        "| poses, pins that are read | MS-SSIM, unsheared | read off | edge distance, mm "
        "| edge angle, deg | over the tap's: mm | deg |"
    )
    for cell in load_cells("end_to_end"):
        for prefix, pins in (("", "true"), ("found: ", "found")):
            for kind, label in kinds.items():
                title = f"{cell.label}, {pins}" if kind == "tap" else ""
                likeness = ""
                if kind == "disentangled":
                    likeness = format_interval(cell.metrics[f"{prefix}ms_ssim/disentangled"], 3)
                errors, ratios = [], []
                for target, digits in EDGE_TARGETS.items():
                    error = cell.metrics[f"{prefix}pose/{kind}/{target}"]
                    tap = cell.metrics[f"{prefix}pose/tap/{target}"]
                    errors.append(format_interval(error, digits))
                    ratios.append("" if kind == "tap" else format_ratio(error, tap))
                lines.append(format_line(title, [likeness, label, *errors, *ratios]))
    return "\n".join(lines)


def tabulate_end_to_end_exchanged() -> str:
    """Tabulate what DS draws of exchanged codes over what it draws of a contact's own, by seed."""
    lines = start_table(
        "| | shear code of | DS, codes exchanged, px | of its own, px | exchanged over own |"
    )
    cell = load_cells("end_to_end")[0]
    for part, label in PARTS.items():
        suffix = "" if part == "all" else f", {part}"
        exchanged = cell.ablation[f"DS, codes {EXCHANGED}{suffix}/rms_px"]
        own = cell.ablation[f"DS, codes {OWN}{suffix}/rms_px"]
        cells = [format_seeds(exchanged), format_seeds(own), format_ratio(exchanged, own)]
        lines.append(format_line(cell.label, [label, *cells]))
    return "\n".join(lines)
