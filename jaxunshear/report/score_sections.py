"""Sections of a run's page on its scores, image by image, beside the paper's figures."""

from markupsafe import Markup

from jaxunshear.report import html, wording
from jaxunshear.report.html import format_cells, format_number
from jaxunshear.report.wording import TEXTS, Wording
from jaxunshear.results.run import FurtherTest, Results, Span

ESTIMATORS = {"pixels": "kernel ridge on pixels", "pins": "kernel ridge on pins"}
PIN_HEADINGS = {
    "rms_px": "error, px rms",
    "rms_mm": "error, mm rms",
    "missed_per_image": "missed per image",
    "extra_per_image": "extra per image",
}
PIN_DIGITS = {"rms_px": 2, "rms_mm": 3, "missed_per_image": 1, "extra_per_image": 1}
WIDE_RANGES = {"twist_deg": "slides that twist", "tilt_deg": "sensors that lean"}


def build_similarity_section(results: Results, words: Wording) -> Markup:
    """Build the section on likeness; nothing if no network unshears."""
    if not results.ms_ssim:
        return Markup()
    groups = list(next(iter(results.ms_ssim.values())))
    paper = words.paper.get("ms_ssim", {})
    paper_groups = [group for group in groups if group in paper.get("sheared", ())]
    rows = []
    for kind, values in results.ms_ssim.items():
        cells = format_cells(values, results.spread.ms_ssim[kind], dict.fromkeys(groups, 3))
        paper_cells = html.format_paper_cells(paper.get(kind, {}), paper_groups)
        rows.append([words.kinds[kind], *cells, *paper_cells])
    name, size = results.metric["ms_ssim"], results.metric["image_px"]
    has_other_scales = bool(paper_groups) and name != "ms_ssim"
    paper_headings = html.format_paper_headings(paper_groups)
    head = [f"image compared with its {words.target}", *groups, *paper_headings]
    return wording.section(
        "similarity",
        html.table(head, rows, range(1 + len(groups), len(head)), [len(rows) - 1]),
        describe_differences(results, "ms_ssim", "likeness", 4, 1),
        quantity=f"{name} {words.modality.drawn}".rstrip(),
        size=size,
        intervals=wording.describe_intervals(results),
        note=TEXTS["sections"]["similarity"]["note"] if has_other_scales else "",
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
        verdict = _judge_difference(interval, better) or "not distinguishable"
        name = wording.KINDS[kind].removeprefix("unsheared, ").removeprefix("sheared, ")
        form = f"+.{digits}f"
        parts.append(f"{name} {value:{form}} [{low:{form}}, {high:{form}}] ({verdict})")
    if not parts:
        return Markup()
    others = "; ".join(parts)
    return html.soft(f"Contact by contact, disentangled less other networks, {subject}: {others}.")


def _judge_difference(interval: Span, better: int) -> str:
    """Say whether a difference is "better" or "worse"; empty if its interval includes zero."""
    low, high = interval or (0.0, 0.0)
    if low <= 0 <= high:
        return ""
    return "better" if low * better > 0 else "worse"


def build_further_tests(results: Results, words: Wording) -> Markup:
    """Build a section for each further test, such as other shapes or taps at other depths."""
    tests = results.tests.items()
    return Markup().join(_build_further_test(name, test, words) for name, test in tests)


def _build_further_test(name: str, test: FurtherTest, words: Wording) -> Markup:
    groups = dict.fromkeys(next(iter(test.ms_ssim.values())), 3)
    quantities = dict.fromkeys(words.digits, 2) if test.pose_mae else {}
    rows = []
    for kind, title in words.kinds.items():
        likeness, errors = test.ms_ssim.get(kind, {}), test.pose_mae.get(kind)
        if not likeness and errors is None:
            continue
        cells = format_cells(likeness, test.spread.ms_ssim.get(kind, {}), groups)
        if errors is not None:
            cells += format_cells(errors, test.spread.pose_mae[kind], quantities)
        rows.append([title, *cells])
    head = ["image", *groups, *map(wording.format_heading, quantities)]
    return wording.section(
        "further_test",
        html.table(head, rows, (), [len(rows) - 1]),
        test=name,
        contacts=test.contacts,
        shapes="shapes that no network has seen" if name == "unseen" else "the shapes trained on",
        settings=_describe_contacts(test),
        intervals=wording.describe_intervals(test),
    )


def _describe_contacts(test: FurtherTest) -> str:
    text = "taps as deep as the slide"
    if jitter := test.tap_depth_jitter_mm:
        text += f", but for up to {jitter:g} mm either way"
    if pins := test.followed:
        parts = [
            f"{pins[kind]['followed']:.1%} of {name} followed, {pins[kind]['rms_px']:.2f} px off"
            for kind, name in (("tap", "taps"), ("sheared", "slides"))
        ]
        text += f", their pins found in the images ({'; '.join(parts)})"
    for field, contacts in WIDE_RANGES.items():
        if size := (test.ranges or {}).get(field):
            text += f", {contacts} by up to {size:g} deg"
    return text


def build_pin_section(results: Results, words: Wording) -> Markup:
    """Build the section on errors of pins; nothing if there are no pairs.

    Pins of recordings are compared in px, and pins that networks give are neither missed nor extra:
    these columns are left out.
    """
    errors = results.pin_error
    if not errors:
        return Markup()
    digits = {}
    for name, count in PIN_DIGITS.items():
        if name == "rms_px" or any(row.get(name) is not None for row in errors.values()):
            digits[name] = count
    titles = {**words.kinds, "tap": words.pin_row}
    rows = [
        [titles[kind], *format_cells(errors[kind], {}, digits)] for kind in titles if kind in errors
    ]
    head = ["image", *(PIN_HEADINGS[name] for name in digits)]
    kind = "found_pins" if "missed_per_image" in digits else "known_pins"
    return wording.section(kind, html.table(head, rows), truth=words.pin_truth)


def build_swap_section(results: Results, words: Wording) -> Markup:
    """Build the section on swapped codes; nothing for networks without two codes."""
    if not results.swap:
        return Markup()
    paper = words.paper.get("swap")
    paper_metrics = {"mse": "MSE", "ms_ssim": "MS-SSIM"} if paper else {}
    rows = []
    for cell, score in results.swap.items():
        target = words.target if score.target == "tap" else score.target
        values = [score.mse, score.ssim, score.ms_ssim]
        if paper:
            values += [paper[cell][metric] for metric in paper_metrics]
        rows.append([cell, target, *(format_number(value, 3) for value in values)])
    paper_headings = html.format_paper_headings(paper_metrics.values())
    metrics = ["MSE", "SSIM", str(results.metric["ms_ssim"])]
    head = ["decoder(codes)", "should draw", *metrics, *paper_headings]
    name = "swap" if len(rows) > 2 else "decoders"  # codes of two widths cannot be swapped
    return wording.section(name, html.table(head, rows, (5, 6)))


def build_estimators_section(results: Results, words: Wording) -> Markup:
    """Build the section on pose estimators that are no neural networks; nothing without them."""
    if not results.readers:
        return Markup()
    digits = words.digits
    rows = []
    for estimator, kinds in results.readers.items():
        title = ESTIMATORS[estimator]
        for kind, errors in kinds.items():
            images = results.reader_images[estimator][kind]
            count = str(images["read"])
            if images["left_out"]:
                form = Markup("{} <small>{} left out</small>")
                count = form.format(images["read"], images["left_out"])
            cells = format_cells(errors, results.spread.readers[estimator][kind], digits)
            rows.append([title, words.kinds[kind], count, *cells])
            title = ""  # only the first row of an estimator bears its name
    taps = results.counts.reader_taps or {}
    learnt = "; ".join(f"{ESTIMATORS[name]}: {count} taps" for name, count in taps.items())
    note = Markup()
    if results.readers.keys() == ESTIMATORS.keys():  # pins are those that are found in the images
        note = html.soft(TEXTS["sections"]["estimators"]["note"])
    head = ["reader", "given", "images", *map(wording.format_heading, digits)]
    intervals = wording.describe_intervals(results)
    body = html.table(head, rows), note
    return wording.section("estimators", *body, taps=learnt and f" ({learnt})", intervals=intervals)
