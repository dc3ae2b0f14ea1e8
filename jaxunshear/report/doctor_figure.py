"""Some examined images, with the pins that were found in them."""

from matplotlib.figure import Figure

from jaxunshear.doctor.doctor import Diagnosis
from jaxunshear.evenly import evenly
from jaxunshear.style import png_of

COLUMNS = 4
DRAWN = 12


def doctor_figure(diagnosis: Diagnosis) -> bytes | None:
    """A PNG; None where no image could be used."""
    parts = [part for part in diagnosis.parts if part.seen and part.seen.samples]
    if not parts:
        return None
    share = max(1, DRAWN // len(parts))
    shown = []
    for part in parts[:DRAWN]:
        samples = part.seen.samples if part.seen else ()
        shown += [(part.name, samples[row]) for row in evenly(len(samples), share)]
    width, height = min(COLUMNS, len(shown)), -(-len(shown) // COLUMNS)
    figure = Figure(figsize=(3.6 * width, 4.0 * height), layout="constrained", dpi=110)
    panels = figure.subplots(height, width, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, (name, sample) in zip(panels, shown, strict=False):
        axes.imshow(sample.image, cmap="gray", vmin=0, vmax=400, interpolation="nearest")
        axes.scatter(*sample.pins.T, s=4, c="#ff7a1a")
        title = f"{name[-28:]}\n{sample.name[-20:]}: {len(sample.pins)} pins"
        axes.set_title(title.replace("$", r"\$"), fontsize=8)
    return png_of(figure)
