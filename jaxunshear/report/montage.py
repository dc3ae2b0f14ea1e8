"""Sheared, unsheared and tapped images side by side, for the report."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import BROKEN_NPZ, read_npz
from jaxunshear.perception.drawing import MISSING, SURPLUS, compare_images
from jaxunshear.report import html
from jaxunshear.report.wording import Wording, section

MontageImages = dict[str, np.ndarray]  # as `evaluation.evaluate.collect_montage` gives it


class Cell(NamedTuple):
    head: str  # of the column
    image: np.ndarray  # (H, W) or (H, W, 3) uint8
    text: str = ""  # below the image


def read_montage(path: Path) -> MontageImages:
    """Read montage.npz. Raises UserError if it is missing or damaged."""
    try:
        images = read_npz(path)
        scores = ("ms_ssim_sheared", f"ms_ssim_{choose_main_kind(images)}")
        required = ("stimulus", "pose", "move", "tap", "sheared", *scores)
        return {name: images[name] for name in required} | images
    except BROKEN_NPZ as error:
        raise UserError(f"{path} is missing or damaged: run `jaxunshear evaluate` again") from error


def build_section(images: MontageImages, words: Wording) -> Markup:
    """Build the section with a typical contact of each stimulus, and others folded away."""
    typical, others = _select_typical(images)
    colours = ((MISSING, "missing from the image"), (SURPLUS, "should not be there"))
    body = [_build_table(images, typical, words), html.caption(colours, words.target)]
    if others:
        summary = "Contacts that went badly, and well (10th and 90th percentile)"
        body.append(html.folded(summary, _build_table(images, others, words)))
    return section("montage", *body, montage=words.montage)


def _build_table(images: MontageImages, rows: list[int], words: Wording) -> Markup:
    lines, heads = [], []
    for row in rows:
        name, *facts = _describe_contact(images, row, words)
        cells = _make_cells(images, row, words)
        heads = [cell.head for cell in cells]
        pictures = [(html.encode_pixels(cell.image), cell.head, cell.text) for cell in cells]
        lines.append((name, facts, pictures))
    return html.montage(heads, lines)


def _select_typical(images: MontageImages) -> tuple[list[int], list[int]]:
    """Select the rows of the middle contact of every stimulus, and the other rows."""
    middle, others = [], []
    for name in dict.fromkeys(images["stimulus"].tolist()):
        rows = np.flatnonzero(images["stimulus"] == name).tolist()
        middle.append(rows.pop(len(rows) // 2))
        others += rows
    return middle, others


def _make_cells(images: MontageImages, row: int, words: Wording) -> list[Cell]:
    network, target = choose_main_kind(images), words.target
    sheared, unsheared, tap = images["sheared"][row], images[network][row], images["tap"][row]
    truth = "tap (truth)" if target == "tap" else target
    return [
        Cell("sheared (input)", sheared, f"{images['ms_ssim_sheared'][row]:.2f}"),
        Cell("unsheared", unsheared, f"{images[f'ms_ssim_{network}'][row]:.2f}"),
        Cell(truth, tap),
        Cell(f"sheared against {target}", compare_images(sheared, tap)),
        Cell(f"unsheared against {target}", compare_images(unsheared, tap)),
    ]


def _describe_contact(images: MontageImages, row: int, words: Wording) -> list[str]:
    """Describe a contact in lines; slide and depth of a recorded one may be unknown."""
    lines = [str(images["stimulus"][row])]
    slide, depth = float(np.hypot(*images["move"][row][:2])), float(images["pose"][row][3])
    for name, value in (("slide", slide), (words.depth, depth)):
        if np.isfinite(value):
            lines.append(f"{name} {value:.1f} mm")
    return lines
