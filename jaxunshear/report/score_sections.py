"""Sections of a run's page on its scores, image by image, beside the paper's figures."""

from collections.abc import Mapping

from markupsafe import Markup

from jaxunshear.report import html, labels
from jaxunshear.report.html import format_cells, format_number, format_paper_heading
from jaxunshear.results.run import FurtherTest, Results, Table

ESTIMATORS = {"pixels": "kernel ridge on pixels", "pins": "kernel ridge on pins"}
PIN_HEADINGS = {
    "rms_px": "error, px rms",
    "rms_mm": "error, mm rms",
    "missed_per_image": "missed per image",
    "extra_per_image": "extra per image",
}
PIN_DIGITS = {"rms_px": 2, "rms_mm": 3, "missed_per_image": 1, "extra_per_image": 1}
WIDE_RANGES = {"twist_deg": "slides that twist", "tilt_deg": "sensors that lean"}


def build_similarity_section(results: Results) -> Markup:
    """Build the section on likeness; nothing if no network unshears."""
    likeness, spread, paper = results.ms_ssim, results.spread.ms_ssim, results.paper["ms_ssim"]
    if not likeness:
        return Markup()
    groups = list(next(iter(likeness.values())))
    paper_groups = []
    if labels.is_comparable(results):
        paper_groups = [group for group in groups if group in paper["sheared"]]
    target = labels.name_target(results)
    paper_headings = map(format_paper_heading, paper_groups)
    head = [f"image compared with its {target}", *groups, *paper_headings]
    rows = []
    for kind, values in likeness.items():
        cells = format_cells(values, spread[kind], dict.fromkeys(groups, 3))
        paper_cells = html.format_paper_cells(paper.get(kind, {}), paper_groups)
        rows.append([labels.name_kind(results, kind), *cells, *paper_cells])
    name, size = results.metric["ms_ssim"], results.metric["image_px"]
    images = " of drawn pins" if labels.uses_pins(results) else ""
    lead = f"{name}{images} at {size} px, 1 is equal; {labels.describe_intervals(results)}"
    if paper_groups and name != "ms_ssim":
        lead += " The paper's has five scales at 256 px: near, but not the same quantity."
    paper_columns = range(1 + len(groups), len(head))
    return html.section(
        "How alike the images are",
        lead,
        html.table(head, rows, paper_columns, [len(rows) - 1]),
        describe_differences(results, "ms_ssim", "likeness", 4, 1),
    )


def describe_differences(
    results: Results, column: str, subject: str, digits: int, better: int
) -> Markup:
    """Describe the disentangled network less each other one, contact by contact.

    `better` is the sign of a gain.
    """
    parts = []
    for kind, columns in results.difference.items():
        value, interval = columns.get(column), results.spread.difference[kind].get(column)
        if value is None or interval is None:
            continue
        low, high = interval
        verdict = "better" if low * better > 0 else "worse"
        if low <= 0 <= high:
            verdict = "not distinguishable"
        name = labels.KINDS[kind].removeprefix("unsheared, ").removeprefix("sheared, ")
        form = f"+.{digits}f"
        parts.append(f"{name} {value:{form}} [{low:{form}}, {high:{form}}] ({verdict})")
    if not parts:
        return Markup()
    others = "; ".join(parts)
    return html.soft(f"Contact by contact, disentangled less other networks, {subject}: {others}.")


def build_further_tests(results: Results) -> Markup:
    """Build a section for each further test, such as other shapes or taps at other depths."""
    sections = [_build_further_test(results, name, test) for name, test in results.tests.items()]
    return Markup().join(sections)


def _build_further_test(results: Results, name: str, test: FurtherTest) -> Markup:
    likeness, pose, spread = test.ms_ssim, test.pose_mae, test.spread
    groups = dict.fromkeys(next(iter(likeness.values())), 3)
    quantities = dict.fromkeys(labels.list_targets(results), 2)
    pose_headings = map(labels.format_heading, quantities if pose else ())
    rows = []
    for kind, title in labels.KINDS.items():
        if kind not in pose and kind not in likeness:
            continue
        cells = format_cells(likeness.get(kind, {}), spread.ms_ssim.get(kind, {}), groups)
        if kind in pose:
            cells += format_cells(pose[kind], spread.pose_mae[kind], quantities)
        rows.append([title, *cells])
    shapes = "shapes that no network has seen" if name == "unseen" else "the shapes trained on"
    lead = (
        f"{test.contacts} slides over {shapes}, {_describe_contacts(test)}: likeness of the "
        f"images, then errors of pose; {labels.describe_intervals(test)}"
    )
    table = html.table(["image", *groups, *pose_headings], rows, (), [len(rows) - 1])
    return html.section(f"Test of its own: {name}", lead, table)


def _describe_contacts(test: FurtherTest) -> str:
    text = "taps as deep as the slide"
    if jitter := test.tap_depth_jitter_mm:
        text += f", but for up to {jitter:g} mm either way"
    if test.followed:
        text += f", their pins found in the images ({_describe_tracking(test.followed)})"
    for field, contacts in WIDE_RANGES.items():
        if size := (test.ranges or {}).get(field):
            text += f", {contacts} by up to {size:g} deg"
    return text


def _describe_tracking(pins: Table) -> str:
    parts = [
        f"{pins[kind]['followed']:.1%} of {name} followed, {pins[kind]['rms_px']:.2f} px off"
        for kind, name in (("tap", "taps"), ("sheared", "slides"))
    ]
    return "; ".join(parts)


def build_pin_section(results: Results) -> Markup:
    """Build the section on errors of pins; nothing if there are no pairs.

    A column of which a recorded run has no value is left out.
    """
    errors = results.pin_error
    if not errors:
        return Markup()
    digits = {"rms_px": PIN_DIGITS["rms_px"]}
    for name, count in PIN_DIGITS.items():
        if results.simulated or any(row.get(name) is not None for row in errors.values()):
            digits[name] = count
    rows = [
        [_name_pin_kind(results, kind), *format_cells(errors[kind], {}, digits)]
        for kind in labels.KINDS
        if kind in errors
    ]
    truth = "tap's true pins" if results.simulated else f"{labels.name_target(results)}'s pins"
    lead = (
        f"Centroids found in each image, matched one to one with the {truth} within half a pitch. "
        "The first row is what finding pins costs by itself; the last is how far the slide really "
        "moved them."
    )
    if labels.uses_pins(results) and not results.simulated:
        lead = (
            f"How far each pin, known by name, is from the {truth}; the last row is how far the "
            "slide moved them."
        )
    head = ["image", *(PIN_HEADINGS[name] for name in digits)]
    return html.section("Where the pins are", lead, html.table(head, rows))


def _name_pin_kind(results: Results, kind: str) -> str:
    if kind == "tap" and not results.simulated:
        return labels.name_target(results)
    return labels.name_kind(results, kind)


def build_swap_section(results: Results) -> Markup:
    """Build the section on swapped codes; nothing for networks without two codes."""
    paper, name = results.paper["swap"], results.metric["ms_ssim"]
    if not results.swap:
        return Markup()
    paper_metrics = {"mse": "MSE", "ms_ssim": "MS-SSIM"} if labels.is_comparable(results) else {}
    rows = []
    for cell, score in results.swap.items():
        target = labels.name_target(results) if score.target == "tap" else score.target
        values = (score.mse, score.ssim, score.ms_ssim, *(paper[cell][m] for m in paper_metrics))
        rows.append([cell, target, *(format_number(value, 3) for value in values)])
    title = "The two decoders"
    lead = (
        "Each decoder fed the codes it was trained on (z_p: pose code, z_s: shear code), its pins "
        "drawn."
    )
    if len(rows) > 2:  # codes of pin networks have two widths and cannot be swapped
        title = "Swapped codes"
        lead = (
            "Each decoder fed the code it was trained on, and the wrong one (z_p: pose code, z_s: "
            "shear code). A bad image from the wrong code shows that the decoder uses its code, "
            "not that the code is free of the other factor."
        )
    paper_headings = map(format_paper_heading, paper_metrics.values())
    head = ["decoder(codes)", "should draw", "MSE", "SSIM", name, *paper_headings]
    return html.section(title, lead, html.table(head, rows, (5, 6)))


def build_estimators_section(results: Results) -> Markup:
    """Build the section on pose estimators that are no neural networks; nothing without them."""
    if not results.readers:
        return Markup()
    spread, digits = results.spread.readers, labels.choose_target_digits(results)
    rows = []
    for estimator, kinds in results.readers.items():
        title = ESTIMATORS[estimator]
        for kind, errors in kinds.items():
            count = _format_image_count(results.reader_images[estimator][kind])
            cells = format_cells(errors, spread[estimator][kind], digits)
            rows.append([title, labels.name_kind(results, kind), count, *cells])
            title = ""  # only the first row of an estimator bears its name
    taps = results.counts.reader_taps or {}
    learnt = "; ".join(f"{ESTIMATORS[name]}: {count} taps" for name, count in taps.items())
    lead = (
        "A network may please readers of the make that taught it. These are no neural networks: "
        f"kernel ridges that learnt from PoseNet's training taps alone{learnt and f' ({learnt})'}. "
        f"Mean absolute errors; {labels.describe_intervals(results)}"
    )
    note = Markup()
    if "pins" in results.readers and results.simulated and not labels.uses_pins(results):
        note = html.soft(
            "Kernel ridge on pins learnt from the taps' true pins. It reads the pins that are "
            "found in a part of the test images; those whose pins are not known by name for sure "
            "are left out and counted."
        )
    head = ["reader", "given", "images", *map(labels.format_heading, digits)]
    return html.section("Read by readers of another make", lead, html.table(head, rows), note)


def _format_image_count(images: Mapping[str, int]) -> str:
    if not images["left_out"]:
        return str(images["read"])
    return Markup("{} <small>{} left out</small>").format(images["read"], images["left_out"])
