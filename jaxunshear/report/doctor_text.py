"""What `jaxunshear doctor` says, in lines."""

from jaxunshear.doctor.doctor import Diagnosis, Part
from jaxunshear.doctor.halves import Column, Pairing
from jaxunshear.doctor.sampled import Seen

MOST_LISTED = 30  # problems
AXES = ("x", "y", "z", "Rx", "Ry", "Rz")


def text_of(diagnosis: Diagnosis) -> list[str]:
    """The full diagnosis."""
    parts = diagnosis.parts
    posed = sum(part.posed for part in parts)
    lines = [
        f"{diagnosis.path}: {_count(diagnosis.images, 'image')} in {_count(len(parts), 'folder')}, {posed} with a pose"
    ]
    for part in parts:
        lines += ["", *_part(part)]
    lines += ["", f"pairs: {_pairing(diagnosis.pairing)}"]
    lines += [f"lacking: {line}" for line in diagnosis.lacks]
    lines += [f"broken: {problem}" for problem in diagnosis.problems[:MOST_LISTED]]
    if len(diagnosis.problems) > MOST_LISTED:
        lines.append(f"broken: {len(diagnosis.problems) - MOST_LISTED} more problems, listed by --json")
    if not diagnosis.problems:
        lines.append("broken: nothing")
    lines += ["", *(f"works: {use.command}" for use in diagnosis.uses if use.works)]
    lines += [f"note: {note}" for note in dict.fromkeys(use.note for use in diagnosis.uses if use.note)]
    return lines + [f"does not work: {use.command} ({use.why_not})" for use in diagnosis.uses if not use.works]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _part(part: Part) -> list[str]:
    lines = [f"{part.name}: {part.layout}", f"  images: {_images(part)}"]
    if part.seen:
        lines.append(f"  pins: {_pins(part.seen)}")
    if part.posed or part.moved:
        kinds = f"{_count(part.taps, 'tap')}, {_count(part.slides, 'slide')}" if part.moved else "moves not known"
        lines.append(f"  contacts: {kinds}, {part.posed} with a pose")
    if part.columns:
        lines.append(f"  labels: {', '.join(_column(each) for each in part.columns if each.varies) or 'none varies'}")
        fixed = [f"{_named(each)} {each.low:.4g} {each.unit}" for each in part.columns if not each.varies and each.low]
        zero = [_named(each) for each in part.columns if not each.varies and not each.low]
        lines += [f"  constant: {', '.join(fixed)}"] if fixed else []
        lines += [f"  always 0: {', '.join(zero)}"] if zero else []
    return lines


def _images(part: Part) -> str:
    size = f"{part.images} of {part.size[0]} x {part.size[1]} px" if part.images else "none can be read"
    if part.seen is None:
        return size
    pixels = part.seen.pixels
    ground = ", negatives (dark pins on a light ground)" if pixels.negative else ""
    return f"{size}, {pixels.kind}{ground}, {100 * pixels.white:.0f} % white"


def _pins(seen: Seen) -> str:
    pins = seen.pins
    counts = f"{pins.median:.0f} ({pins.least} to {pins.most}) in {_count(pins.images, 'image')}"
    pitch = f", {pins.pitch_px:.1f} px apart ({pins.pitch:.3f} of the image)" if pins.pitch and pins.pitch_px else ""
    if pins.sensor is None or pins.sure is None:
        return f"{counts}{pitch}, of no known sensor"
    return f"{counts}{pitch}, {pins.sensor}, identities sure in {100 * pins.sure:.0f} % of these images"


def _column(column: Column) -> str:
    circle = " (full circle)" if column.circle else ""
    return f"{_named(column)} {column.low:.4g} to {column.high:.4g} {column.unit}{circle}"


def _named(column: Column) -> str:
    """The column's name, with its axis where that is but a number."""
    kind, _, axis = column.name.partition("_")
    return f"{column.name} = {AXES[int(axis) - 1]}" if axis.isdigit() else column.name


def _pairing(pairs: Pairing) -> str:
    if not pairs.taps or not pairs.slides:
        return "none, as there are not both taps and slides with known moves"
    text = f"{pairs.by_id} of {_count(pairs.slides, 'slide')} have a tap of the same pose_id and pose"
    if pairs.gap_mm is None:
        return f"{text}; poses are not known"
    return f"{text}; the tap nearest in pose is {pairs.gap_mm:.2g} mm and {pairs.gap_deg:.2g} deg away (medians)"
