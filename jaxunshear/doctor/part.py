"""One folder of examined recordings."""

from dataclasses import dataclass
from pathlib import Path

from jaxunshear.doctor.halves import Column
from jaxunshear.doctor.sampled import Seen


@dataclass(frozen=True)
class Part:
    """What was found in it."""

    path: Path
    name: str  # below the examined path
    layout: str
    images: int  # that can be used
    size: tuple[int, int]  # px, width and height of most
    posed: int  # images whose pose is known
    moved: int  # and whose move is
    taps: int
    slides: int
    columns: tuple[Column, ...]
    seen: Seen | None  # None where no image can be used
