"""Sheared, unsheared and tapped images side by side: for the report, and as one picture."""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from PIL import Image

from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import BROKEN_NPZ, read_npz
from jaxunshear.report import html, labels
from jaxunshear.results.run import Results
from jaxunshear.style import encode_png

MISSING, SURPLUS = (
    (255, 122, 26),
    (64, 150, 255),
)  # orange: the tap alone has it; blue: the image alone
MAX_LETTERS = 22  # letters that do not fit above an image
MontageImages = dict[str, np.ndarray]  # as `evaluation.evaluate.montage` keeps it


class Terms(NamedTuple):
    """What stands beside and above the images."""

    heads: tuple[str, ...]  # of the five columns
    depth: str
    truth: str


def read_montage(path: Path) -> MontageImages:
    """Raises `UserError` where montage.npz is missing or damaged."""
    try:
        shown = read_npz(path)
        judged = choose_main_kind(shown)
        needed = (
            "stimulus",
            "pose",
            "move",
            "tap",
            "sheared",
            f"ms_ssim_{judged}",
            "ms_ssim_sheared",
        )
        return {name: shown[name] for name in needed} | shown
    except BROKEN_NPZ as error:
        raise UserError(f"{path} is missing or damaged: run `jaxunshear evaluate` again") from error


def make_terms(results: Results) -> Terms:
    truth = labels.name_target(results)
    shown = "tap (truth)" if truth == "tap" else truth
    heads = (
        "sheared (input)",
        "unsheared",
        shown,
        f"sheared against {truth}",
        f"unsheared against {truth}",
    )
    return Terms(heads, "depth" if results.simulated else "z", truth)


def build_section(shown: MontageImages, results: Results) -> Markup:
    """Of the report: one typical contact of each stimulus, and folded away those that went badly and well."""
    middle, others = select_typical(shown)
    said = make_terms(results)
    colours = ((MISSING, "missing from the image"), (SURPLUS, "should not be there"))
    body = [_table(shown, middle, said), html.caption(colours, said.truth)]
    if others:
        summary = "Contacts that went badly, and well (10th and 90th percentile)"
        body.append(html.folded(summary, _table(shown, others, said)))
    lead = "One contact of each shape that is typical of its test set: what was felt, what the network made of it, and the truth."
    if not results.simulated:
        lead = f"A held-out slide that is typical: what was felt, what the network made of it, and its {said.truth}."
    if labels.reads_pins(results):
        lead += " The network reads pins and gives pins: the images are these pins, drawn."
    return html.section("What it does", lead, *body)


def plot_montage(shown: MontageImages, results: Results) -> bytes:
    """The typical contacts as one PNG; the same contacts give the same bytes."""
    rows, _ = select_typical(shown)
    said = make_terms(results)
    height = 1.85 * len(rows) + 0.15 * any(len(head) >= MAX_LETTERS for head in said.heads)
    figure = Figure(figsize=(8.2, height), layout="constrained", dpi=100)
    for line, row in zip(
        figure.subplots(len(rows), len(said.heads), squeeze=False), rows, strict=True
    ):
        for axes, (image, text), head in zip(line, _cells(shown, row), said.heads, strict=True):
            axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(text, fontsize=8)
            if row == rows[0]:
                axes.set_title(
                    head if len(head) < MAX_LETTERS else head.replace(" against", "\nagainst"),
                    fontsize=9,
                )
        line[0].set_ylabel(
            "\n".join(describe_contact(shown, row, said)),
            rotation=0,
            ha="right",
            va="center",
            fontsize=8,
        )
    return encode_png(figure)


def select_typical(shown: MontageImages) -> tuple[list[int], list[int]]:
    """Rows of the middle contact of every stimulus, and the others."""
    middle, others = [], []
    for name in dict.fromkeys(shown["stimulus"].tolist()):
        inside = np.flatnonzero(shown["stimulus"] == name).tolist()
        middle.append(inside.pop(len(inside) // 2))
        others += inside
    return middle, others


def _cells(shown: MontageImages, row: int) -> list[tuple[np.ndarray, str]]:
    """Images and likenesses under them, in the order of the heads."""
    network = choose_main_kind(shown)
    sheared, unsheared, tap = (shown[kind][row] for kind in ("sheared", network, "tap"))
    return [
        (sheared, f"{shown['ms_ssim_sheared'][row]:.2f}"),
        (unsheared, f"{shown[f'ms_ssim_{network}'][row]:.2f}"),
        (tap, ""),
        (difference(sheared, tap), ""),
        (difference(unsheared, tap), ""),
    ]


def describe_contact(shown: MontageImages, row: int, said: Terms) -> list[str]:
    """What the contact is; of a recorded one neither slide nor depth need be known."""
    slide, depth = float(np.hypot(*shown["move"][row][:2])), float(shown["pose"][row][3])
    known = [(f"slide {slide:.1f} mm", slide), (f"{said.depth} {depth:.1f} mm", depth)]
    return [str(shown["stimulus"][row]), *(text for text, value in known if np.isfinite(value))]


def _table(shown: MontageImages, rows: list[int], said: Terms) -> Markup:
    lines = []
    for row in rows:
        name, *about = describe_contact(shown, row, said)
        cells = zip(_cells(shown, row), said.heads, strict=True)
        lines.append(
            (name, about, [(png_address(image), head, text) for (image, text), head in cells])
        )
    return html.montage(said.heads, lines)


def png_address(pixels: np.ndarray) -> str:
    """Return a `data:` address of a PNG of pixels (H, W) or (H, W, 3) uint8."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png", optimize=True)
    return html.address_of(buffer.getvalue())


def difference(image: np.ndarray, tap: np.ndarray) -> np.ndarray:
    """Colour (H, W, 3) uint8 what two images (H, W) uint8 share in grey, and the rest by MISSING and SURPLUS."""
    a, b = image.astype(np.float32)[..., None] / 255, tap.astype(np.float32)[..., None] / 255
    shared = np.minimum(a, b) * 90
    missing = np.clip(b - a, 0, 1) * np.array(MISSING, np.float32)
    surplus = np.clip(a - b, 0, 1) * np.array(SURPLUS, np.float32)
    return np.clip(np.rint(shared + missing + surplus), 0, 255).astype(np.uint8)
