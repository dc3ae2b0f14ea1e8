"""How exactly a contact is solved, and what is left out of it, by the name of a level."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jaxunshear.errors import UserError

# What `auto` leaves out, in the words of the command that shows a plan.
OMISSIONS = ("untouched", "friction", "nodes", "steps", "grouping")
# Above this friction over-relaxed ADMM runs in circles: P is steep where nodes part, and the steps
# of ADMM must be short.
STRONG_FRICTION = 1.0


@dataclass(frozen=True)
class Level:
    """How exactly a path is followed, and what is left out of it.

    A leg between two way points is cut into increments of at most `press_mm` in depth and
    `slide_mm` along the surface. A leg has at least `press` or `slide` of them, unless "steps" is
    among the omissions. `tolerance`, `limit`, `strong_friction` and `method` are as in
    `friction.Solver`. `reference` leaves out only what provably changes nothing.
    """

    press: int
    slide: int
    press_mm: float
    slide_mm: float
    tolerance: float
    limit: int
    precision: str = "float32"
    omit: tuple[str, ...] = OMISSIONS
    wide_margin: bool = False  # leave out fewer nodes
    strong_friction: float | None = 0.7
    method: Callable[..., Any] | None = None


LEVELS = {
    "fast": Level(press=1, slide=4, press_mm=3.0, slide_mm=0.9, tolerance=0.25, limit=300),
    "default": Level(
        press=2, slide=8, press_mm=3.0, slide_mm=0.45, tolerance=0.15, limit=600, omit=()
    ),
    "auto": Level(press=2, slide=8, press_mm=3.0, slide_mm=0.45, tolerance=0.15, limit=600),
    "reference": Level(
        press=6,
        slide=24,
        press_mm=1.0,
        slide_mm=0.15,
        tolerance=0.02,
        limit=8000,
        precision="float64",
        omit=("untouched", "nodes", "grouping"),
        wide_margin=True,
        strong_friction=None,
    ),
}
# the level at which a contact that did not converge is solved again
STRONGER_LEVELS = {"fast": "auto", "default": "reference", "auto": "reference"}


def get_level(name_or_level: str | Level) -> Level:
    if isinstance(name_or_level, Level):
        return name_or_level
    if name_or_level not in LEVELS:
        raise UserError(f"level '{name_or_level}' is unknown: use one of {', '.join(LEVELS)}")
    return LEVELS[name_or_level]
