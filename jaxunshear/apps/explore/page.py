"""The page of `explore` with NiceGUI: state and events of a tab, and its layout."""

import asyncio
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from nicegui import events, run, ui

from jaxunshear.apps.explore.drawing import (
    MAP_PX,
    PINS_PX,
    STRETCH,
    encode_data_url,
    render_map_svg,
    render_pins_svg,
    to_mm,
)
from jaxunshear.apps.explore.explorer import (
    DEEPEST_MM,
    MOST_SLIDE_MM,
    SHEARED,
    TAP,
    TRUE,
    UNSHEARED,
    Explorer,
    Picture,
    Touch,
)
from jaxunshear.config.sensor import SENSORS
from jaxunshear.errors import UserError

HOST = "127.0.0.1"
LARGEST_BYTES = 32_000_000  # of a recorded image
STYLE = Path(__file__).with_name("page.css")
IMAGES = {SHEARED: "as the camera sees it", UNSHEARED: "by the networks", TAP: "without the slide"}
COLUMNS = {TRUE: "true", SHEARED: "sheared", UNSHEARED: "unsheared"}
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

    def draw_map(self) -> None:
        self.part("map", ui.interactive_image).set_content(render_map_svg(self.touch))
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
    images = picture.images if picture else {}
    for name in IMAGES:
        tab.part(name, ui.interactive_image).set_source(
            encode_data_url(images[name]) if name in images else ""
        )
    pins = force = ""
    if picture and len(picture.state):
        pins = render_pins_svg(picture.pins, picture.state, len(images[SHEARED]))
        sideways_n = math.hypot(*picture.force_n[:2])
        force = f"force {picture.force_n[2]:.2f} N down, {sideways_n:.2f} N sideways"
    tab.part("pins", ui.interactive_image).set_content(pins)
    tab.part("force", ui.label).set_text(force)
    tab.part("time", ui.label).set_text(duration and f"computed in {duration}")
    problem_line = tab.part("problem", ui.label)
    problem_line.set_text(problem)
    problem_line.set_visibility(bool(problem))
    tab.part("poses", ui.table).rows = _make_rows(picture.poses) if picture else []


def _make_rows(poses: dict[str, dict[str, float]]) -> list[dict[str, str]]:
    names = next(iter(poses.values()), {})
    rows = []
    for name in names:
        quantity, _, unit = name.rpartition("_")
        cells = {key: poses.get(key, {}).get(name, math.nan) for key in COLUMNS}
        texts = {key: "-" if math.isnan(value) else f"{value:.2f}" for key, value in cells.items()}
        rows.append({"quantity": f"{quantity.replace('_', ' ')}, {unit}"} | texts)
    return rows


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


async def on_pose(tab: Tab, index: int, value: float | None) -> None:
    """Change the yaw (index 2) or the depth (3); the value is None while a field is empty."""
    if value is not None and value != tab.touch.pose[index]:
        pose = list(tab.touch.pose)
        pose[index] = float(value)
        tab.request(pose=tuple(pose))
        await compute(tab)


async def on_friction(tab: Tab, value: float | None) -> None:
    if value is not None:
        await on_change(tab, friction=float(value))


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


def build(explorer: Explorer) -> None:
    """Build one tab."""
    stimulus = (*explorer.own_stimuli, explorer.stimuli["disk"])[0]
    tab = Tab(
        explorer, Touch(stimulus, explorer.model.sensor, (0.0, 0.0, 0.0, 3.0), (0.0, 0.0), 0.4)
    )
    ui.add_css(STYLE.read_text())
    ui.colors(primary="#1f6feb")
    with ui.element("div").classes("explore"):
        with ui.element("header"):
            ui.label("jaxunshear").classes("name")
            ui.label("Press and slide the dome over a shape").classes("what")
            tab.parts["time"] = ui.label("").classes("time")
        with ui.element("section").classes("side"):
            _build_map(tab)
            _build_controls(tab)
        with ui.element("section").classes("results"):
            tab.parts["problem"] = ui.label("").classes("problem").props('role="alert"')
            _build_pictures(tab)
    ui.timer(0.05, lambda: on_change(tab, move=(0.0, 0.0)), once=True)


def _build_map(tab: Tab) -> None:
    mouse_events = ["pointerdown", "pointermove", "pointerup", "pointercancel", "pointerleave"]
    with ui.element("div").classes("card"):
        tab.parts["map"] = ui.interactive_image(
            size=(MAP_PX, MAP_PX),
            events=mouse_events,
            on_mouse=lambda event: on_map(tab, event),
            sanitize=False,
        ).classes("map")
        tab.parts["place"] = ui.label("").classes("hint")
        with ui.element("div").classes("buttons"):
            ui.button("Lift and tap", on_click=lambda: lift(tab)).props("outline dense no-caps")


def _build_controls(tab: Tab) -> None:
    touch = tab.touch
    with ui.element("div").classes("card controls"):
        tab.parts["stimulus"] = ui.select(
            list(tab.explorer.stimuli),
            value=touch.stimulus.name,
            label="stimulus",
            on_change=lambda event: on_stimulus(tab, event.value),
        ).props("dense outlined options-dense")
        ui.select(
            list(SENSORS),
            value=touch.sensor.name,
            label="sensor",
            on_change=lambda event: on_change(tab, sensor=SENSORS[event.value]),
        ).props("dense outlined options-dense")
        depth, yaw, friction = touch.pose[3], touch.pose[2], touch.friction
        _add_number("depth, mm", depth, (0.1, DEEPEST_MM), 0.1, lambda mm: on_pose(tab, 3, mm))
        _add_number("yaw, deg", yaw, (-180, 180), 1, lambda deg: on_pose(tab, 2, deg))
        _add_number("friction", friction, (0, 1.5), 0.05, lambda mu: on_friction(tab, mu))


def _add_number(
    label: str,
    value: float,
    limits: tuple[float, float],
    step: float,
    change: Callable[[float | None], object],
) -> None:
    """Add a number and a slider for it; the number is None while its field is empty."""
    number = ui.number(label, value=value, step=step, on_change=lambda event: change(event.value))
    number.props("dense outlined")
    slider = ui.slider(min=limits[0], max=limits[1], step=step)
    slider.props(f'aria-label="{label.partition(",")[0]}" dense').bind_value(number, "value")


def _build_pictures(tab: Tab) -> None:
    with ui.element("div").classes("pictures"):
        for name, text in IMAGES.items():
            with ui.element("figure").classes("card"):
                ui.label(name).classes("title")
                tab.parts[name] = ui.interactive_image(size=(1, 1)).classes(f"pixels {name}")
                ui.label(text).classes("hint")
    with ui.element("div").classes("below"):
        with ui.element("figure").classes("card"):
            ui.label("pins and skin").classes("title")
            tab.parts["pins"] = ui.interactive_image(
                size=(PINS_PX, PINS_PX), sanitize=False
            ).classes("pins")
            with ui.element("div").classes("legend"):
                for kind in ("stick", "slip", "free"):
                    ui.label(kind).classes(kind)
            tab.parts["force"] = ui.label("").classes("hint")
            ui.label(f"motions drawn {STRETCH:g} times as long").classes("hint")
        with ui.element("div").classes("stack"):
            with ui.element("div").classes("card"):
                ui.label("pose, as it is and as it is read").classes("title")
                heads = {"quantity": ""} | COLUMNS
                columns = [
                    {"name": key, "label": text, "field": key, "align": "right"}
                    for key, text in heads.items()
                ]
                tab.parts["poses"] = ui.table(rows=[], columns=columns, row_key="quantity").props(
                    "flat dense hide-bottom"
                )
            with ui.element("div").classes("card"):
                ui.label("a recorded image").classes("title")
                ui.upload(
                    label="drop one here, or +",
                    auto_upload=True,
                    max_file_size=LARGEST_BYTES,
                    on_upload=lambda event: on_file(tab, event),
                    on_rejected=lambda: show(
                        tab, None, f"this file is larger than {LARGEST_BYTES // 10**6} MB"
                    ),
                ).props("flat bordered hide-upload-btn").classes("drop")


def serve(explorer: Explorer, port: int) -> None:
    """Serve the page until it is stopped."""
    logging.getLogger("nicegui").setLevel(logging.ERROR)
    ui.run(
        lambda: build(explorer),
        host=HOST,
        port=port,
        title="jaxunshear explore",
        show=False,
        reload=False,
        tailwind=False,
        show_welcome_message=False,
    )
