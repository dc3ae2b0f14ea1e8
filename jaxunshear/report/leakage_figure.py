"""What each code holds, as bars; and where poses share slides, what DS draws of exchanged codes, beside the contacts of just these."""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxunshear.files import Json
from jaxunshear.style import encode_png

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

    from jaxunshear.evaluation.code_exchange import ExchangedCodes

BARS = {
    "r2": "code",
    "untrained": "code of an untrained network",
    "ceiling": "ceiling: what the input shows",
    "shuffled": "shuffled labels",
}


def plot_leakage(results: Json, exchanged: "ExchangedCodes | None") -> bytes:
    """PNG."""
    from matplotlib.figure import Figure

    side = 0 if exchanged is None else len(exchanged.true)
    figure = Figure(
        figsize=(6 + 1.5 * side, 1.2 + max(3.2, 1.6 * side)), layout="constrained", dpi=110
    )
    parts: Any = figure.subfigures(1, 2, width_ratios=(6, 1.6 * side)) if side else (figure,)
    _bars(parts[0], results)
    if exchanged is not None:
        _matrix(parts[1], exchanged)
    return encode_png(figure)


def _bars(figure: "FigureBase", results: Json) -> None:
    rows = [row for row in results["summary"] if row["quantities"]]
    axes = figure.subplots()
    shown = [name for name in BARS if rows and name in rows[0]]
    height = 0.8 / max(1, len(shown))
    for index, name in enumerate(shown):
        place = np.arange(len(rows)) + (index - (len(shown) - 1) / 2) * height
        axes.barh(place, [row[name] for row in rows], height, label=BARS[name])
        if name == "r2":
            off = np.array(
                [
                    [row[name] - row["r2 interval"][0], row["r2 interval"][1] - row[name]]
                    for row in rows
                ]
            ).T
            axes.errorbar(
                [row[name] for row in rows],
                place,
                xerr=np.maximum(off, 0),
                fmt="none",
                color="black",
                lw=1,
            )
    axes.set_yticks(
        np.arange(len(rows)), [row["name"] + (" (a leak)" if row["leak"] else "") for row in rows]
    )
    axes.set(
        xlabel="R2 on test poses, strongest probe",
        xlim=(min([-0.1, *(row["r2"] for row in rows)]), 1.05),
    )
    axes.invert_yaxis()
    axes.axvline(0, color="black", lw=0.8)
    figure.legend(
        *axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=2
    )


def _matrix(figure: "FigureBase", exchanged: "ExchangedCodes") -> None:
    side = len(exchanged.true)
    images = exchanged.true.ndim == 5
    panels = figure.subplots(side, side, squeeze=False)
    for i, row in enumerate(panels):
        for j, axes in enumerate(row):
            (_image if images else _pins)(axes, exchanged, i, j)
            axes.set(xticks=[], yticks=[], aspect="equal")
            if j == 0:
                axes.set_ylabel(f"z_p of pose {i + 1}", fontsize=7)
            if i == side - 1:
                axes.set_xlabel(f"z_s of slide {j + 1}", fontsize=7)
    title = (
        "DS of exchanged codes (red), of a contact's own (blue);\ncircles: the simulated contact"
    )
    if images:
        title = "What DS draws too bright (red) and too dark (blue),\nbeside the simulated contact; the diagonal: of its own codes"
    figure.suptitle(title, fontsize=8)


def _pins(axes: Any, exchanged: "ExchangedCodes", i: int, j: int) -> None:
    middle, reach = (
        exchanged.true.mean(axis=(0, 1, 2)),
        1.05 * np.ptp(exchanged.true, axis=(0, 1, 2)).max() / 2,
    )
    true, drawn = exchanged.true[i, j], exchanged.decoded[i, j]
    axes.scatter(*true.T, s=5, facecolors="none", edgecolors="0.5", lw=0.6)
    axes.scatter(*drawn.T, s=1.2, color="tab:blue" if i == j else "tab:red")
    axes.set(
        xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] + reach, middle[1] - reach)
    )
    rms = float(np.sqrt(np.mean(np.sum((true - drawn) ** 2, axis=-1))))
    axes.set_title(f"{rms:.2f} px", fontsize=7, pad=2)


def _image(axes: Any, exchanged: "ExchangedCodes", i: int, j: int) -> None:
    """White where both are bright, red where only what is drawn is, blue where only the contact is."""
    true, drawn = exchanged.true[i, j, ..., 0], exchanged.decoded[i, j, ..., 0]
    axes.imshow(np.stack([drawn, np.minimum(drawn, true), true], axis=-1), interpolation="nearest")
    axes.set_title(f"{np.sqrt(np.mean((true - drawn) ** 2)):.3f}", fontsize=7, pad=2)
