"""A tab of the page of `explore`: its state, what its controls do, and what it shows."""

import asyncio
import math
import time
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from nicegui import events, run, ui

from jaxunshear.apps.explore.drawing import (
    encode_data_url,
    render_dome_svg,
    render_map_svg,
    render_pins_svg,
    to_mm,
)
from jaxunshear.apps.explore.explorer import (
    MOST_SLIDE_MM,
    SHEARED,
    TAP,
    TRUE,
    UNSHEARED,
    Explorer,
    Picture,
    Touch,
)
from jaxunshear.errors import UserError
from jaxunshear.perception.drawing import compare_images

IMAGES = {SHEARED: "as the camera sees it", UNSHEARED: "by the networks", TAP: "without the slide"}
DIFFERENCES = {SHEARED: "sheared against tap", UNSHEARED: "unsheared against tap"}
COLUMNS = {TRUE: "true", SHEARED: "sheared", UNSHEARED: "unsheared"}
PLAYED_STEPS, STEP_S = 10, 0.15  # of a slide that is played, and how long each is shown at least
Part = TypeVar("Part", bound=ui.element)
ONE_AT_A_TIME = asyncio.Lock()  # two tabs that compute at once would make each other slow


@dataclass
class Tab:
    """State of one tab; tabs share nothing."""

    explorer: Explorer
    touch: Touch
    start: tuple[float, float] = (0.0, 0.0)  # mm: where the sensor was pressed down
    pressed: bool = False
    next_touch: Touch | None = None  # whose picture comes next
    busy: bool = False
    parts: dict[str, ui.element] = field(default_factory=dict)

    def request(self, **changes: object) -> None:
        """Draw the touch at once, and request its pictures; only the last request counts."""
        self.touch = self.next_touch = replace(self.touch, **changes)  # type: ignore[arg-type]
        self.draw_map()

    def part(self, name: str, kind: type[Part]) -> Part:
        """Return one of `parts`, of this kind."""
        part = self.parts[name]
        assert isinstance(part, kind)
        return part

    def draw_map(self, force_n: np.ndarray | None = None) -> None:
        self.part("map", ui.interactive_image).set_content(render_map_svg(self.touch, force_n))
        x, y, dx, dy = *self.start, *self.touch.move
        self.part("place", ui.label).set_text(
            f"pressed at x {x:.1f}, y {y:.1f} mm; slid by {dx:.1f}, {dy:.1f} mm"
        )


async def compute(tab: Tab) -> None:
    """Compute and show pictures until no touch is left."""
    if tab.busy:
        return
    tab.busy = True
    try:
        while tab.next_touch is not None:
            touch, tab.next_touch = tab.next_touch, None
            tab.part("results", ui.element).classes(add="old")
            tab.part("time", ui.label).set_text("computing ...")
            async with ONE_AT_A_TIME:
                start = time.perf_counter()
                try:
                    picture = await run.io_bound(tab.explorer.simulate_picture, touch)
                except UserError as error:
                    show(tab, None, str(error))
                    continue
            if picture is not None:  # None: the server is going
                show(tab, picture, picture.note, f"{1000 * (time.perf_counter() - start):.0f} ms")
    finally:
        tab.busy = False


def show(tab: Tab, picture: Picture | None, problem: str, duration: str = "") -> None:
    """Show a picture, or only the line that says why there is none."""
    images = dict(picture.images) if picture else {}
    for name, heading in DIFFERENCES.items():
        if name in images and TAP in images:
            images[heading] = compare_images(images[name], images[TAP])
    for name in (*IMAGES, *DIFFERENCES.values()):
        tab.part(name, ui.interactive_image).set_source(
            encode_data_url(images[name]) if name in images else ""
        )
    for name, heading in DIFFERENCES.items():
        likeness = picture.likeness.get(name) if picture else None
        text = "" if likeness is None else f"MS-SSIM {likeness:.3f}"
        tab.part(f"likeness {heading}", ui.label).set_text(text)
    _show_contact(tab, picture)
    tab.part("results", ui.element).classes(remove="old")
    tab.part("time", ui.label).set_text(duration and f"computed in {duration}")
    problem_line = tab.part("problem", ui.label)
    problem_line.set_text(problem)
    problem_line.set_visibility(bool(problem))
    tab.part("poses", ui.table).rows = _make_rows(picture.poses) if picture else []
    tab.part("touch", ui.table).rows = [
        {"quantity": _name_quantity(name), "value": f"{value:.2f}"}
        for name, value in (picture.touch if picture else {}).items()
    ]


def _show_contact(tab: Tab, picture: Picture | None) -> None:
    pins = dome = force = ""
    result = picture.result if picture else None
    if picture and result and picture.pins is not None:
        size = len(picture.images[SHEARED])
        pins = render_pins_svg(picture.pins, result.state, size)
        dome = render_dome_svg(result)
        sideways_n = math.hypot(*result.force_n[:2])
        force = f"force {result.force_n[2]:.2f} N down, {sideways_n:.2f} N sideways"
    tab.part("pins", ui.interactive_image).set_content(pins)
    tab.part("dome", ui.interactive_image).set_content(dome)
    tab.part("force", ui.label).set_text(force)
    tab.draw_map(result.force_n if result and tab.next_touch is None else None)


def _make_rows(poses: dict[str, dict[str, float]]) -> list[dict[str, str]]:
    names = next(iter(poses.values()), {})
    rows = []
    for name in names:
        cells = {key: poses.get(key, {}).get(name, math.nan) for key in COLUMNS}
        texts = {key: "-" if math.isnan(value) else f"{value:.2f}" for key, value in cells.items()}
        rows.append({"quantity": _name_quantity(name)} | texts)
    return rows


def _name_quantity(name: str) -> str:
    quantity, _, unit = name.rpartition("_")
    return f"{quantity.replace('_', ' ')}, {unit}" if quantity else name


async def on_map(tab: Tab, event: events.MouseEventArguments) -> None:
    """Set the sensor down when pressed, slide it when moved."""
    here = to_mm(event.image_x, event.image_y)
    if event.type == "pointerdown":
        tab.pressed, tab.start = True, here
    elif not tab.pressed:
        return
    tab.pressed = event.type in ("pointerdown", "pointermove") and bool(event.buttons)
    move = np.subtract(here, tab.start)
    move = move * min(1.0, MOST_SLIDE_MM / max(float(np.hypot(*move)), 1e-9))
    place(tab, (float(move[0]), float(move[1])))
    await compute(tab)


def place(tab: Tab, move: tuple[float, float]) -> None:
    """Slide the sensor by `move` from where it was pressed down."""
    pose = (tab.start[0] + move[0], tab.start[1] + move[1], *tab.touch.pose[2:])
    if (pose, move) != (tab.touch.pose, tab.touch.move):
        tab.request(pose=pose, move=move)


async def on_stimulus(tab: Tab, name: str) -> None:
    if name != tab.touch.stimulus.name:
        tab.request(stimulus=tab.explorer.stimuli[name])
        await compute(tab)


async def on_pose(tab: Tab, index: int, value: float) -> None:
    """Change the yaw (index 2) or the depth (3)."""
    if value != tab.touch.pose[index]:
        pose = list(tab.touch.pose)
        pose[index] = value
        tab.request(pose=tuple(pose))
        await compute(tab)


async def on_change(tab: Tab, **changes: object) -> None:
    tab.request(**changes)
    await compute(tab)


async def on_file(tab: Tab, event: events.UploadEventArguments) -> None:
    data = await event.file.read()
    name = event.file.name
    try:
        async with ONE_AT_A_TIME:
            picture = await run.io_bound(tab.explorer.infer_recording, name, data)
    except UserError as error:
        event.sender.reset()  # without a tick beside a file that was refused
        show(tab, None, str(error))
        return
    if picture is not None:
        show(tab, picture, picture.note)
        tab.part("force", ui.label).set_text(f"recorded: {name}")


async def lift(tab: Tab) -> None:
    """Tap where the slide ended."""
    x, y, *_ = tab.touch.pose
    tab.start = (x, y)
    await on_change(tab, move=(0.0, 0.0))


async def play(tab: Tab) -> None:
    """Show the slide step by step, until the sensor is moved by hand."""
    end = shown = tab.touch
    for share in np.linspace(0, 1, PLAYED_STEPS + 1).tolist():
        if tab.touch is not shown:
            return
        move = (share * end.move[0], share * end.move[1])
        tab.request(pose=(tab.start[0] + move[0], tab.start[1] + move[1], *end.pose[2:]), move=move)
        shown = tab.touch
        await compute(tab)
        await asyncio.sleep(STEP_S)
