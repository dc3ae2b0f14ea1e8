"""Sections of a run's report: what was measured, image by image, with the paper's figures beside."""

from collections.abc import Mapping

from markupsafe import Markup

from jaxunshear.report import html, labels
from jaxunshear.report.html import format_number, format_with_interval
from jaxunshear.results.run import Results, Table

READERS = {"pixels": "kernel ridge on pixels", "pins": "kernel ridge on pins"}
PIN_COLUMNS = (  # heading, name, digits
    ("error, px rms", "rms_px", 2),
    ("error, mm rms", "rms_mm", 3),
    ("missed per image", "missed_per_image", 1),
    ("extra per image", "extra_per_image", 1),
)


def build_similarity_section(results: Results) -> Markup:
    """Nothing where nothing is unsheared."""
    ours, spread, paper = results.ms_ssim, results.spread.ms_ssim, results.paper["ms_ssim"]
    if not ours:
        return Markup()
    groups = list(next(iter(ours.values())))
    known = [
        group for group in groups if group in paper["sheared"] and labels.is_comparable(results)
    ]
    head = [
        f"image compared with its {labels.name_target(results)}",
        *groups,
        *(Markup("{}<br>paper").format(group) for group in known),
    ]
    rows = [
        [
            labels.name_kind(results, kind),
            *(format_with_interval(ours[kind][group], spread[kind][group], 3) for group in groups),
            *(format_number(paper.get(kind, {}).get(group)) for group in known),
        ]
        for kind in ours
    ]
    name, size = results.metric["ms_ssim"], results.metric["image_px"]
    drawn = " of drawn pins" if labels.reads_pins(results) else ""
    lead = f"{name}{drawn} at {size} px, 1 is equal; {labels.describe_intervals(results)}"
    if known and name != "ms_ssim":
        lead += " The paper's has five scales at 256 px: near, but not the same quantity."
    real = range(1 + len(groups), len(head))
    return html.section(
        "How alike the images are",
        lead,
        html.table(head, rows, real, [len(rows) - 1]),
        describe_differences(results, "ms_ssim", "likeness", 4, 1),
    )


def describe_differences(
    results: Results, column: str, what: str, digits: int, better: int
) -> Markup:
    """The disentangled network less each other one, contact by contact; `better` is the sign of a gain."""
    said = []
    for kind, columns in results.difference.items():
        less, span = columns.get(column), results.spread.difference[kind].get(column)
        if less is None or span is None:
            continue
        low, high = span
        verdict = (
            "not distinguishable" if low <= 0 <= high else "better" if low * better > 0 else "worse"
        )
        name = labels.KINDS[kind].removeprefix("unsheared, ").removeprefix("sheared, ")
        said.append(
            f"{name} {columns[column]:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}] ({verdict})"
        )
    if not said:
        return Markup()
    return html.soft(
        f"Contact by contact, disentangled less other networks, {what}: {'; '.join(said)}."
    )


def build_further_tests(results: Results) -> Markup:
    """The tests of their own: shapes that no network has seen, taps at other depths."""
    parts, names = [], labels.list_targets(results)
    for name, test in results.tests.items():
        ours, pose, spread = test.ms_ssim, test.pose_mae, test.spread
        groups = list(next(iter(ours.values())))
        head = ["image", *groups, *(labels.format_heading(q) for q in names if pose)]
        rows = [
            [
                labels.KINDS[kind],
                *(
                    format_with_interval(
                        ours.get(kind, {}).get(g), spread.ms_ssim.get(kind, {}).get(g), 3
                    )
                    for g in groups
                ),
                *(
                    format_with_interval(pose[kind].get(q), spread.pose_mae[kind].get(q), 2)
                    for q in names
                    if kind in pose
                ),
            ]
            for kind in labels.KINDS
            if kind in pose or kind in ours
        ]
        what = "shapes that no network has seen" if name == "unseen" else "the shapes trained on"
        jitter = test.tap_depth_jitter_mm
        depth = (
            f"taps as deep as the slide, but for up to {jitter:g} mm either way"
            if jitter
            else "taps as deep as the slide"
        )
        if test.followed:
            depth = f"{depth}, their pins found in the images ({_describe_tracking(test.followed)})"
        ways = {"twist_deg": "slides that twist", "tilt_deg": "sensors that lean"}
        wide = {
            reported: size
            for field, reported in ways.items()
            if (size := (test.ranges or {}).get(field))
        }
        depth += "".join(f", {reported} by up to {size:g} deg" for reported, size in wide.items())
        lead = f"{test.contacts} slides over {what}, {depth}: likeness of the images, then errors of pose; {labels.describe_intervals(test)}"
        parts.append(
            html.section(
                f"Test of its own: {name}", lead, html.table(head, rows, (), [len(rows) - 1])
            )
        )
    return Markup().join(parts)


def _describe_tracking(pins: Table) -> str:
    kinds = {"tap": "taps", "sheared": "slides"}
    said = [
        f"{pins[k]['followed']:.1%} of {name} followed, {pins[k]['rms_px']:.2f} px off"
        for k, name in kinds.items()
    ]
    return "; ".join(said)


def build_pin_section(results: Results) -> Markup:
    """Columns that nothing is known for are left out, and so is all of it where there are no pairs."""
    errors = results.pin_error
    if not errors:
        return Markup()
    shown = [
        (head, name, digits)
        for head, name, digits in PIN_COLUMNS
        if name == "rms_px"
        or results.simulated
        or any(row.get(name) is not None for row in errors.values())
    ]
    rows = [
        [
            _name_pin_kind(results, kind),
            *(format_number(errors[kind].get(name), digits) for _, name, digits in shown),
        ]
        for kind in labels.KINDS
        if kind in errors
    ]
    truth = "tap's true pins" if results.simulated else f"{labels.name_target(results)}'s pins"
    lead = (
        f"Centroids found in each image, matched one to one with the {truth} within half a pitch. The first row is "
        "what finding pins costs by itself; the last is how far the slide really moved them."
    )
    if labels.reads_pins(results) and not results.simulated:
        lead = f"How far each pin, known by name, is from the {truth}; the last row is how far the slide moved them."
    return html.section(
        "Where the pins are", lead, html.table(["image", *(head for head, _, _ in shown)], rows)
    )


def _name_pin_kind(results: Results, kind: str) -> str:
    """Images are compared with one partner or tap, which has a row, too."""
    return (
        labels.name_target(results)
        if kind == "tap" and not results.simulated
        else labels.name_kind(results, kind)
    )


def build_swap_section(results: Results) -> Markup:
    """Nothing of networks without two codes."""
    paper, name = results.paper["swap"], results.metric["ms_ssim"]
    if not results.swap:
        return Markup()
    known = ("mse", "ms_ssim") if labels.is_comparable(results) else ()
    rows = [
        [
            cell,
            labels.name_target(results) if entry.target == "tap" else entry.target,
            *(format_number(value, 3) for value in (entry.mse, entry.ssim, entry.ms_ssim)),
            *(format_number(paper[cell][m], 3) for m in known),
        ]
        for cell, entry in results.swap.items()
    ]
    both = len(rows) > 2  # networks over pins have codes of two widths, which cannot be swapped
    lead = (
        "Each decoder fed the code it was trained on, and the wrong one (z_p: pose code, z_s: shear code). A bad image from the "
        "wrong code shows that the decoder uses its code, not that the code is free of the other factor."
        if both
        else "Each decoder fed the codes it was trained on (z_p: pose code, z_s: shear code), its pins drawn."
    )
    head = [
        "decoder(codes)",
        "should draw",
        "MSE",
        "SSIM",
        name,
        *(Markup("{}<br>paper").format(metric) for metric in ("MSE", "MS-SSIM") if known),
    ]
    return html.section(
        "Swapped codes" if both else "The two decoders", lead, html.table(head, rows, (5, 6))
    )


def readers(results: Results) -> Markup:
    """Nothing of runs without, or evaluated by an earlier version."""
    ours = results.readers
    if not ours:
        return Markup()
    names, spread = labels.list_targets(results), results.spread.readers
    head = ["reader", "given", "images", *map(labels.format_heading, names)]
    rows = [
        [
            READERS[reader] if not place else "",
            labels.name_kind(results, kind),
            _counted(results.reader_images[reader][kind]),
            *(
                format_with_interval(
                    errors.get(q), spread[reader][kind].get(q), labels.choose_digits(results, q)
                )
                for q in names
            ),
        ]
        for reader, kinds in ours.items()
        for place, (kind, errors) in enumerate(kinds.items())
    ]
    taps = results.counts.reader_taps or {}
    learnt = "; ".join(f"{READERS[reader]}: {count} taps" for reader, count in taps.items())
    lead = (
        "A network may please readers of the make that taught it. These are no neural networks: kernel ridges that learnt from "
        f"PoseNet's training taps alone{f' ({learnt})' if learnt else ''}. Mean absolute errors; {labels.describe_intervals(results)}"
    )
    found = (
        "Kernel ridge on pins learnt from the taps' true pins. It reads the pins that are found in a part of the test images; those "
        "whose pins are not known by name for sure are left out and counted."
        if "pins" in ours and results.simulated and not labels.reads_pins(results)
        else ""
    )
    return html.section(
        "Read by readers of another make",
        lead,
        html.table(head, rows),
        html.soft(found) if found else "",
    )


def _counted(images: Mapping[str, int]) -> str:
    if not images["left_out"]:
        return str(images["read"])
    return Markup("{} <small>{} left out</small>").format(images["read"], images["left_out"])
