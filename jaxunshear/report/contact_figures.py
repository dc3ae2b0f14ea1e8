"""The section of a run's page on single contacts: predicted against true poses, and error by slide.

It is made from scores.npz, which holds each test contact.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.networks import UNSHEARING
from jaxunshear.config.targets import get_unit
from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import TARGET_KIND, TRUE_KIND, choose_main_kind
from jaxunshear.files import BROKEN_NPZ, read_npz
from jaxunshear.report import html, wording
from jaxunshear.report.wording import Wording
from jaxunshear.results.run import EVALUATE_REMEDY
from jaxunshear.style import COLOURS, DPI, FAINT, INK, PANEL_IN, STYLE, encode_png, make_panels

BINS = 5  # of equally many slides
SHEARED = "sheared"
KINDS = ("tap", TARGET_KIND, SHEARED, *UNSHEARING)
SIZES = ("slide_mm", "depth_mm")
Contacts = Mapping[str, np.ndarray]  # (N,) by name


def build_contact_section(run_dir: Path, words: Wording) -> Markup:
    """Build the section; nothing if the scores have no poses, as those of earlier versions.

    Raises UserError if they are damaged.
    """
    path = run_dir / "scores.npz"
    if not path.is_file():
        return Markup()
    try:
        contacts = read_npz(path)
    except BROKEN_NPZ as error:
        raise UserError(f"{path} is damaged ({error}): {EVALUATE_REMEDY}") from error
    names = [name for name in words.main_targets if f"pose.{SHEARED}.{name}" in contacts]
    if not names:
        return Markup()
    address = html.make_png_address(plot_contacts(contacts, names, words))
    text = "predicted over true values, and errors over slide and depth, of " + ", ".join(names)
    return wording.section("contacts_one_by_one", html.figure(address, text))


def plot_contacts(contacts: Contacts, names: list[str], words: Wording) -> bytes:
    """Plot a row for each quantity as a PNG: a scatter, and errors over each known size."""
    predicted = {name.split(".")[1] for name in contacts if name.startswith("pose.")}
    kinds = list(dict.fromkeys((SHEARED, choose_main_kind(predicted))))
    sizes = [size for size in SIZES if np.isfinite(contacts.get(size, np.nan)).any()]
    columns = 1 + len(sizes)
    with rc_context(STYLE):
        figure, panels = make_panels(len(names) * columns, columns, (PANEL_IN, 3.0), 0.4, DPI)
        for row, name in enumerate(names):
            scatter, *others = panels[row * columns : (row + 1) * columns]
            _plot_scatter(scatter, contacts, name, kinds)
            for axes, size in zip(others, sizes, strict=True):
                _plot_errors(axes, contacts, name, size)
                quantity = words.depth if size == "depth_mm" else "length of the slide"
                axes.set(xlabel=f"{quantity}, mm", ylabel=f"mean error, {get_unit(name)}")
        handles, shown = panels[columns - 1].get_legend_handles_labels()
        titles = [words.kinds.get(kind, kind) for kind in shown]
        figure.legend(handles, titles, loc="outside upper center", ncols=len(titles))
        return encode_png(figure)


def _plot_scatter(axes: Axes, contacts: Contacts, name: str, kinds: list[str]) -> None:
    true = contacts[f"pose.{TRUE_KIND}.{name}"]
    for kind in kinds:
        predicted = contacts[f"pose.{kind}.{name}"]
        if get_unit(name) == "deg":  # the short way round
            predicted = true + wrap_degrees(predicted - true)
        axes.plot(true, predicted, ".", color=_get_colour(kind), label=kind, alpha=0.5, ms=3)
    ends = [true.min(), true.max()]
    axes.plot(ends, ends, color=INK, linewidth=0.8)
    quantity, unit = wording.name_quantity(name), get_unit(name)
    axes.set(xlabel=f"true {quantity}, {unit}", ylabel=f"predicted, {unit}")


def _plot_errors(axes: Axes, contacts: Contacts, name: str, size: str) -> None:
    """Plot mean errors over `size` of all kinds of `KINDS` that there are."""
    known = np.flatnonzero(np.isfinite(contacts[size]))
    parts = np.array_split(known[np.argsort(contacts[size][known], kind="stable")], BINS)
    parts = [part for part in parts if len(part)]
    middle = [contacts[size][part].mean() for part in parts]
    for kind in KINDS:
        if (errors := contacts.get(f"pose/{kind}/{name}")) is not None:
            means = [errors[part].mean() for part in parts]
            axes.plot(middle, means, "o-", color=_get_colour(kind), label=kind, markersize=4)
    axes.set_ylim(bottom=0)


def _get_colour(kind: str) -> str:
    return COLOURS.get(kind, FAINT if kind == SHEARED else INK)
