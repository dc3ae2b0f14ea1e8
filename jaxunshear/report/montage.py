"""Sheared, unsheared and tapped images side by side, for the report and as one picture."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import BROKEN_NPZ, read_npz
from jaxunshear.report import html, labels
from jaxunshear.results.run import Results
from jaxunshear.style import encode_png

MISSING = (255, 122, 26)  # orange: only the tap is bright
SURPLUS = (64, 150, 255)  # blue: only the image is bright
MAX_LETTERS = 22  # in one line of a heading above an image
MontageImages = dict[str, np.ndarray]  # as `evaluation.evaluate.encode_montage` writes it


class Terms(NamedTuple):
    """Words beside and above the images."""

    heads: tuple[str, ...]  # of the five columns
    depth: str
    truth: str


class Cell(NamedTuple):
    image: np.ndarray  # (H, W) or (H, W, 3) uint8
    text: str  # below the image


def read_montage(path: Path) -> MontageImages:
    """Read montage.npz. Raises UserError if it is missing or damaged."""
    try:
        images = read_npz(path)
        scores = ("ms_ssim_sheared", f"ms_ssim_{choose_main_kind(images)}")
        required = ("stimulus", "pose", "move", "tap", "sheared", *scores)
        return {name: images[name] for name in required} | images
    except BROKEN_NPZ as error:
        raise UserError(f"{path} is missing or damaged: run `jaxunshear evaluate` again") from error


def make_terms(results: Results) -> Terms:
    """Choose the words for the target and the quantities of a run."""
    truth = labels.name_target(results)
    heads = (
        "sheared (input)",
        "unsheared",
        "tap (truth)" if truth == "tap" else truth,
        f"sheared against {truth}",
        f"unsheared against {truth}",
    )
    return Terms(heads, "depth" if results.simulated else "z", truth)


def build_section(images: MontageImages, results: Results) -> Markup:
    """Build the section with a typical contact of each stimulus, and others folded away."""
    typical, others = select_typical(images)
    terms = make_terms(results)
    colours = ((MISSING, "missing from the image"), (SURPLUS, "should not be there"))
    body = [_build_table(images, typical, terms), html.caption(colours, terms.truth)]
    if others:
        summary = "Contacts that went badly, and well (10th and 90th percentile)"
        body.append(html.folded(summary, _build_table(images, others, terms)))
    lead = (
        "One contact of each shape that is typical of its test set: what was felt, what the "
        "network made of it, and the truth."
    )
    if not results.simulated:
        lead = (
            "A held-out slide that is typical: what was felt, what the network made of it, and its "
            f"{terms.truth}."
        )
    if labels.uses_pins(results):
        lead += " The network reads pins and gives pins: the images are these pins, drawn."
    return html.section("What it does", lead, *body)


def _build_table(images: MontageImages, rows: list[int], terms: Terms) -> Markup:
    lines = []
    for row in rows:
        name, *facts = describe_contact(images, row, terms)
        cells = [
            (html.encode_pixels(cell.image), head, cell.text)
            for cell, head in zip(_make_cells(images, row), terms.heads, strict=True)
        ]
        lines.append((name, facts, cells))
    return html.montage(terms.heads, lines)


def plot_montage(images: MontageImages, results: Results) -> bytes:
    """Plot the typical contacts as one PNG; the same contacts give the same bytes."""
    rows, _ = select_typical(images)
    terms = make_terms(results)
    height = 1.85 * len(rows) + 0.15 * any(len(head) >= MAX_LETTERS for head in terms.heads)
    figure = Figure(figsize=(8.2, height), layout="constrained", dpi=100)
    panels = figure.subplots(len(rows), len(terms.heads), squeeze=False)
    for line, row in zip(panels, rows, strict=True):
        for axes, cell in zip(line, _make_cells(images, row), strict=True):
            axes.imshow(cell.image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(cell.text, fontsize=8)
        text = "\n".join(describe_contact(images, row, terms))
        line[0].set_ylabel(text, rotation=0, ha="right", va="center", fontsize=8)
    for axes, head in zip(panels[0], terms.heads, strict=True):
        if len(head) >= MAX_LETTERS:
            head = head.replace(" against", "\nagainst")
        axes.set_title(head, fontsize=9)
    return encode_png(figure)


def select_typical(images: MontageImages) -> tuple[list[int], list[int]]:
    """Select the rows of the middle contact of every stimulus, and the other rows."""
    middle, others = [], []
    for name in dict.fromkeys(images["stimulus"].tolist()):
        rows = np.flatnonzero(images["stimulus"] == name).tolist()
        middle.append(rows.pop(len(rows) // 2))
        others += rows
    return middle, others


def _make_cells(images: MontageImages, row: int) -> list[Cell]:
    """Make the images of a contact, and the likenesses below them, in the order of the heads."""
    network = choose_main_kind(images)
    sheared, unsheared, tap = images["sheared"][row], images[network][row], images["tap"][row]
    return [
        Cell(sheared, f"{images['ms_ssim_sheared'][row]:.2f}"),
        Cell(unsheared, f"{images[f'ms_ssim_{network}'][row]:.2f}"),
        Cell(tap, ""),
        Cell(compare_images(sheared, tap), ""),
        Cell(compare_images(unsheared, tap), ""),
    ]


def describe_contact(images: MontageImages, row: int, terms: Terms) -> list[str]:
    """Describe a contact in lines; slide and depth of a recorded one may be unknown."""
    lines = [str(images["stimulus"][row])]
    slide, depth = float(np.hypot(*images["move"][row][:2])), float(images["pose"][row][3])
    for name, value in (("slide", slide), (terms.depth, depth)):
        if np.isfinite(value):
            lines.append(f"{name} {value:.1f} mm")
    return lines


def compare_images(image: np.ndarray, tap: np.ndarray) -> np.ndarray:
    """Colour the differences of two images (H, W) uint8; returns (H, W, 3) uint8.

    What both share is grey, and the rest has the colours `MISSING` and `SURPLUS`.
    """
    a, b = image.astype(np.float32)[..., None] / 255, tap.astype(np.float32)[..., None] / 255
    shared = np.minimum(a, b) * 90
    missing = np.clip(b - a, 0, 1) * np.array(MISSING, np.float32)
    surplus = np.clip(a - b, 0, 1) * np.array(SURPLUS, np.float32)
    return np.clip(np.rint(shared + missing + surplus), 0, 255).astype(np.uint8)
