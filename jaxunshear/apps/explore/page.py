"""The page of `explore` with NiceGUI: its layout, and its server."""

import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nicegui import app, run, ui

from jaxunshear.apps.explore import tab as tabs
from jaxunshear.apps.explore.drawing import LONGEST_MM, MAP_PX, MM_PER_N, PINS_PX, STRETCH
from jaxunshear.apps.explore.explorer import DEEPEST_MM, FIRST_MOVE, FIRST_POSE, Explorer, Touch
from jaxunshear.apps.explore.tab import COLUMNS, DIFFERENCES, IMAGES, ONE_AT_A_TIME, Tab
from jaxunshear.config.sensor import SENSORS
from jaxunshear.errors import UserError

HOST = "127.0.0.1"
LARGEST_BYTES = 32_000_000  # of a recorded image
STYLE = Path(__file__).with_name("page.css")


@dataclass
class Preparation:
    """How far the programs that touches need are compiled, in words."""

    text: str = ""

    async def compile(self, explorer: Explorer) -> None:
        """Compile them, one touch at a time, so that touches of tabs come between."""
        self.text = "compiling ..."
        touches = await run.io_bound(explorer.list_touches)
        for done, touch in enumerate(touches or ()):
            self.text = f"compiling, {done} of {len(touches)} done: pictures take longer"
            async with ONE_AT_A_TIME:
                with contextlib.suppress(UserError):  # an outline of one's own may be anywhere
                    await run.io_bound(explorer.simulate_picture, touch)
        self.text = ""


def build(explorer: Explorer, preparation: Preparation) -> None:
    """Build one tab."""
    stimulus = (*explorer.own_stimuli, explorer.stimuli["disk"])[0]
    tab = Tab(explorer, Touch(stimulus, explorer.model.sensor, FIRST_POSE, FIRST_MOVE, 0.4))
    tab.start = (FIRST_POSE[0] - FIRST_MOVE[0], FIRST_POSE[1] - FIRST_MOVE[1])
    ui.add_css(STYLE.read_text())
    ui.colors(primary="#1f6feb")
    with ui.element("div").classes("explore"):
        with ui.element("header"):
            ui.label("jaxunshear").classes("name")
            ui.label("Press and slide the dome over a shape").classes("what")
            ui.label().classes("compiling").bind_text_from(preparation, "text")
            tab.parts["time"] = ui.label("").classes("time")
        with ui.element("section").classes("side"):
            _build_map(tab)
            _build_controls(tab)
        tab.parts["results"] = ui.element("section").classes("results")
        with tab.parts["results"]:
            tab.parts["problem"] = ui.label("").classes("problem").props('role="alert"')
            tab.parts["problem"].set_visibility(False)
            _build_pictures(tab)
    ui.timer(0.05, lambda: tabs.on_change(tab), once=True)


def _build_map(tab: Tab) -> None:
    mouse_events = ["pointerdown", "pointermove", "pointerup", "pointercancel", "pointerleave"]
    with ui.element("div").classes("card"):
        tab.parts["map"] = ui.interactive_image(
            size=(MAP_PX, MAP_PX),
            events=mouse_events,
            on_mouse=lambda event: tabs.on_map(tab, event),
            sanitize=False,
        ).classes("map")
        tab.parts["place"] = ui.label("").classes("hint")
        with ui.element("div").classes("buttons"):
            ui.button("Lift and tap", on_click=lambda: tabs.lift(tab)).props(
                "outline dense no-caps"
            )
            ui.button("Play the slide", on_click=lambda: tabs.play(tab)).props(
                "outline dense no-caps"
            )
        ui.label(f"red: the force sideways, {MM_PER_N:g} mm per N").classes("hint")


def _build_controls(tab: Tab) -> None:
    touch = tab.touch
    with ui.element("div").classes("card controls"):
        tab.parts["stimulus"] = ui.select(
            list(tab.explorer.stimuli),
            value=touch.stimulus.name,
            label="stimulus",
            on_change=lambda event: tabs.on_stimulus(tab, event.value),
        ).props("dense outlined options-dense")
        ui.select(
            [name for name, sensor in SENSORS.items() if not sensor.is_flat],
            value=touch.sensor.name,
            label="sensor",
            on_change=lambda event: tabs.on_change(tab, sensor=SENSORS[event.value]),
        ).props("dense outlined options-dense")
        depth, yaw, friction = touch.pose[3], touch.pose[2], touch.friction
        _add_number("depth, mm", depth, (0, DEEPEST_MM), 0.1, lambda mm: tabs.on_pose(tab, 3, mm))
        _add_number("yaw, deg", yaw, (-180, 180), 1, lambda deg: tabs.on_pose(tab, 2, deg))
        _add_number(
            "friction", friction, (0, 1.5), 0.05, lambda mu: tabs.on_change(tab, friction=mu)
        )


def _add_number(
    label: str,
    value: float,
    limits: tuple[float, float],
    step: float,
    change: Callable[[float], object],
) -> None:
    """Add a number, whose field may be empty for a while, and a slider for it."""
    number = ui.number(
        label,
        value=value,
        step=step,
        on_change=lambda event: event.value is None or change(float(event.value)),
    )
    number.props("dense outlined")
    slider = ui.slider(min=limits[0], max=limits[1], step=step)
    slider.props(f'aria-label="{label.partition(",")[0]}" dense').bind_value(number, "value")


def _add_image(tab: Tab, name: str, text: str) -> ui.label:
    with ui.element("figure").classes("card"):
        ui.label(name).classes("title")
        tab.parts[name] = ui.interactive_image(size=(1, 1)).classes(
            f"pixels {name.replace(' ', '-')}"
        )
        return ui.label(text).classes("hint")


def _build_pictures(tab: Tab) -> None:
    with ui.element("div").classes("pictures"):
        for name, text in IMAGES.items():
            _add_image(tab, name, text)
        for heading in DIFFERENCES.values():
            tab.parts[f"likeness {heading}"] = _add_image(tab, heading, "")
        with ui.element("figure").classes("card"):
            ui.label("dome from below").classes("title")
            tab.parts["dome"] = ui.interactive_image(
                size=(PINS_PX, PINS_PX), sanitize=False
            ).classes("pins")
            ui.label(f"forces on the skin, the largest {LONGEST_MM:g} mm long").classes("hint")
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
                ui.label("pose, true and estimated").classes("title")
                tab.parts["poses"] = _add_table({"quantity": ""} | COLUMNS)
            with ui.element("div").classes("card"):
                ui.label("contact, slip and shear").classes("title")
                tab.parts["touch"] = _add_table({"quantity": "", "value": ""}).props("hide-header")
            with ui.element("div").classes("card"):
                ui.label("a recorded image").classes("title")
                ui.upload(
                    label="drop one here, or +",
                    auto_upload=True,
                    max_file_size=LARGEST_BYTES,
                    on_upload=lambda event: tabs.on_file(tab, event),
                    on_rejected=lambda: tabs.show(
                        tab, None, f"this file is larger than {LARGEST_BYTES // 10**6} MB"
                    ),
                ).props("flat bordered hide-upload-btn").classes("drop")


def _add_table(headings: dict[str, str]) -> ui.table:
    columns = [
        {"name": key, "label": text, "field": key, "align": "right"}
        for key, text in headings.items()
    ]
    table = ui.table(rows=[], columns=columns, row_key="quantity")
    return table.props("flat dense hide-bottom")


def serve(explorer: Explorer, port: int) -> None:
    """Serve the page until it is stopped."""
    logging.getLogger("nicegui").setLevel(logging.ERROR)
    preparation = Preparation()
    app.on_startup(lambda: preparation.compile(explorer))
    ui.run(
        lambda: build(explorer, preparation),
        host=HOST,
        port=port,
        title="jaxunshear explore",
        show=False,
        reload=False,
        tailwind=False,
        show_welcome_message=False,
    )
