"""Which commands can use examined recordings, with the command line; and what the recordings lack."""

import os
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxunshear.dataset.labels import table_of
from jaxunshear.dataset.preparing import LEAST_FRAMES
from jaxunshear.dataset.recordings import IMAGE_FOLDERS
from jaxunshear.doctor.halves import Pairing
from jaxunshear.doctor.part import Part
from jaxunshear.doctor.sampled import LEAST_PINS, SENSORS, Pins
from jaxunshear.settings.sensor import TACTIP_331

FEW = 0.1  # of a folder's contacts: taps among slides, or slides among taps, that make it neither
SIMULATED = (
    "`unshear` and `pose` use released networks that learnt from simulated touches: `jaxunshear evaluate skin --recordings DIR` "
    "compares them with labels of an edge"
)


@dataclass(frozen=True)
class Use:
    """A command line that works, or one that does not and why."""

    command: str
    why_not: str = ""
    note: str = ""

    @property
    def works(self) -> bool:
        return not self.why_not


def lacks_of(parts: tuple[Part, ...], pairs: Pairing) -> tuple[str, ...]:
    """What recordings lack, in a line each."""
    lacks = []
    if not any(part.posed for part in parts):
        beside = next((home for part in parts if (home := _beside(part)) is not None), None)
        where = f"; those of these images lie above, in {beside}: examine that folder" if beside else ""
        lacks.append(f"no labels: no image's pose is known{where}")
    elif not any(part.moved for part in parts):
        lacks.append("no moves: whether a contact is a tap or a slide is not known")
    elif not pairs.slides:
        lacks.append("no slides: every known move is 0")
    elif not pairs.taps:
        lacks.append("no taps: no known move is 0")
    return (*lacks, *(line for part in parts for line in _sensor_lacks(part)))


def _beside(part: Part) -> Path | None:
    """The folder of the labels, where only that of the images was named."""
    above = part.path.absolute().parent
    return above if part.path.name in IMAGE_FOLDERS and table_of(above) else None


def _sensor_lacks(part: Part) -> list[str]:
    if part.seen is None:
        return [f"no usable images in {part.name}"]
    pins, lacks = part.seen.pins, []
    if part.seen.pixels.negative:
        lacks.append(f"negatives in {part.name}: dark pins on a light ground; invert these images first")
    if pins.median < LEAST_PINS:
        lacks.append(f"no pins in {part.name}: {pins.median:.0f} are found in an image")
    elif pins.sensor is None:
        known = " and ".join(f"the {sensor.pins} of {sensor.name}" for sensor in SENSORS)
        lacks.append(f"no known sensor in {part.name}: about {pins.median:.0f} pins, which do not match {known}")
    return lacks


def uses_of(path: Path, parts: tuple[Part, ...]) -> tuple[Use, ...]:
    """Of recordings at `path`, the command lines to give next."""
    ready = [part for part in parts if part.seen and not part.seen.pixels.negative]
    alike = len(ready) == len(parts) and len({_camera(part) for part in ready}) == 1
    shown = ready[:1] if alike else ready
    places = [(path if alike else part.path, part.seen.pins) for part in shown if part.seen]
    if places:
        images = [sum(part.images for part in ready)] if alike else [part.images for part in ready]
        uses = [_pins(*place) for place in places]
        uses += [use for place, count in zip(places, images, strict=True) for use in _released(*place, count)]
    else:
        why = "the pins are dark: invert the images first" if any(part.seen for part in parts) else "no usable images"
        uses = [Use(_line("pins", path), why), Use(_line("unshear", path, "--out", "unsheared"), why)]
    return (*uses, *_trained(parts))


def _line(*words: str | Path) -> str:
    return shlex.join(["jaxunshear", *map(str, words)])


def _pins(place: Path, pins: Pins) -> Use:
    if pins.median < LEAST_PINS:
        return Use(_line("pins", place), "no pins are found")
    if pins.sensor is None:
        return Use(_line("pins", place, "--layout", "FILE"), note="FILE: x and y of each pin, a line each")
    return Use(_line("pins", place, *([] if pins.sensor == TACTIP_331.name else ["--sensor", pins.sensor])))


def _released(place: Path, pins: Pins, images: int) -> tuple[Use, ...]:
    """What the released networks, of 331 pins, can do."""
    why = ""
    if pins.sensor != TACTIP_331.name:
        why = f"the released networks know {TACTIP_331.pins} pins; train a --model of this sensor"
    elif images < LEAST_FRAMES:
        why = f"the mean of {LEAST_FRAMES} contacts or more shows where pins stand: name a folder of them by --like"
    lines = _line("unshear", place, "--out", "unsheared"), _line("pose", place)
    return tuple(Use(line, why, "" if why else SIMULATED) for line in lines)


def learnt_from(parts: Sequence[Part]) -> list[Part]:
    """The folders that training would take: of known poses, moves and pins, and of the one camera that has most contacts."""
    known = [part for part in parts if part.posed and part.taps + part.slides and _of_sensor(part)]
    contacts: Counter[tuple[object, ...]] = Counter()
    for part in known:
        contacts[_camera(part)] += part.taps + part.slides
    return [part for part in known if _camera(part) == contacts.most_common(1)[0][0]]


def _of_sensor(part: Part) -> bool:
    return part.seen is not None and not part.seen.pixels.negative and part.seen.pins.sensor is not None


def _camera(part: Part) -> tuple[object, ...]:
    return part.size, part.seen and part.seen.pins.sensor


def _trained(parts: Sequence[Part]) -> tuple[Use, Use]:
    """What learns from taps and slides with poses."""
    kept = learnt_from(parts)
    if not kept:
        why = _not_learnt_from(parts)
        run = _line("run", "experiments/recorded.py", "--recordings", "DIR")
        return Use(_line("fit", "--taps", "DIR", "--slides", "DIR"), why), Use(run, why)
    mixed = any(FEW < part.taps / (part.taps + part.slides) < 1 - FEW for part in kept)
    taps = [part for part in kept if mixed or part.taps > part.slides]
    slides = [part for part in kept if mixed or part.taps <= part.slides]
    named = [(option, _folder(half, parts)) for option, half in (("--taps", taps), ("--slides", slides)) if half]
    note = "" if taps and slides else "of taps or slides alone networks learn to read poses, not to unshear"
    if not slides and all(part.seen and part.seen.pins.sensor == TACTIP_331.name for part in taps):
        note += "; with --unshear.input pins --paired.pairing simulated they unshear by simulated slides"
    above = _above(kept)
    why = "" if _alone(above, kept, parts) else f"{above} holds recordings of another kind too: use `fit`"
    return (
        Use(_line("fit", *(word for words in named for word in words)), note=note),
        Use(_line("run", "experiments/recorded.py", "--recordings", above), why, note),
    )


def _folder(some: Sequence[Part], parts: Sequence[Part]) -> Path:
    """What to name for some of the parts: the folder above them, if it holds no others; else the largest of them."""
    above = _above(some)
    return above if _alone(above, some, parts) else max(some, key=lambda part: part.images).path


def _above(parts: Sequence[Part]) -> Path:
    return Path(os.path.commonpath([part.path for part in parts]))


def _alone(folder: Path, some: Sequence[Part], parts: Sequence[Part]) -> bool:
    """Whether a folder holds none but some of the parts."""
    return {part.path for part in parts if part.path.is_relative_to(folder)} <= {part.path for part in some}


def _not_learnt_from(parts: Sequence[Part]) -> str:
    if not any(_of_sensor(part) for part in parts):
        return "there are no usable images of a known sensor"
    if not any(part.posed for part in parts):
        return "no poses are known"
    return "which contacts are taps is not known: name the folders of both yourself"
