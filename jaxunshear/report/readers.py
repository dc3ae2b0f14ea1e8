"""The section on readers of another make than PoseNet: what they read of the same contacts."""

from collections.abc import Mapping

from markupsafe import Markup

from jaxunshear.report import page, words
from jaxunshear.report.page import spanned
from jaxunshear.results.run import Results

TITLE = "Read by readers of another make"
NAMES = {"pixels": "kernel ridge on pixels", "pins": "kernel ridge on pins"}


def readers(results: Results) -> Markup:
    """Nothing of runs without, or evaluated by an earlier version."""
    ours = results.readers
    if not ours:
        return Markup()
    names, spread = words.targets(results), results.spread.readers
    head = ["reader", "given", "images", *map(words.heading, names)]
    rows = [
        [
            NAMES[reader] if not place else "",
            words.kind_of(results, kind),
            _counted(results.reader_images[reader][kind]),
            *(spanned(errors.get(q), spread[reader][kind].get(q), words.digits(results, q)) for q in names),
        ]
        for reader, kinds in ours.items()
        for place, (kind, errors) in enumerate(kinds.items())
    ]
    taps = results.counts.reader_taps or {}
    learnt = "; ".join(f"{NAMES[reader]}: {count} taps" for reader, count in taps.items())
    lead = (
        "A network may please readers of the make that taught it. These are no neural networks: kernel ridges that learnt from "
        f"PoseNet's training taps alone{f' ({learnt})' if learnt else ''}. Mean absolute errors; {words.spread(results)}"
    )
    found = (
        "Kernel ridge on pins learnt from the taps' true pins. It reads the pins that are found in a part of the test images; those "
        "whose pins are not known by name for sure are left out and counted."
        if "pins" in ours and results.simulated and not words.over_pins(results)
        else ""
    )
    return page.section(TITLE, lead, page.table(head, rows), page.soft(found) if found else "")


def _counted(images: Mapping[str, int]) -> str:
    if not images["left_out"]:
        return str(images["read"])
    return Markup("{} <small>{} left out</small>").format(images["read"], images["left_out"])
