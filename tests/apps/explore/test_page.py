"""The page in a real browser: controls, a wrong file, two tabs, a phone's width, no fetches."""

import os
import shutil
import signal
import socket
import subprocess
import sys
from base64 import b64decode

import numpy as np
import pytest

from tests.helpers.image_files import png_of

pytest.importorskip("nicegui", reason="needs the extra `explore`")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium"),
]
PATIENCE = 120_000  # ms: the first picture of another sensor makes its dome


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    environment = {name: os.environ[name] for name in os.environ if not name.startswith("PYTEST")}
    folder = tmp_path_factory.mktemp("explore")
    words = [sys.executable, "-m", "jaxunshear", "explore", "--port", str(port)]
    with (folder / "errors").open("w") as errors:
        server = subprocess.Popen(
            words, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True
        )
        line = server.stdout.readline()
        assert line.startswith(f"http://127.0.0.1:{port}"), (folder / "errors").read_text()
        yield f"http://127.0.0.1:{port}"
        server.send_signal(signal.SIGINT)
        assert server.wait(30) == 130
    written = (folder / "errors").read_text()
    assert "Traceback" not in written and "stopped" in written
    assert [path.name for path in folder.iterdir()] == ["errors"]


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


class Tab:
    """A tab of a browser, and what a hand does in it."""

    def __init__(self, browser, address, **view):
        self.problems, self.asked = [], []
        self.page = browser.new_page(**view)
        self.page.set_default_timeout(PATIENCE)
        self.page.on("console", self.note_message)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)
        self.page.locator(".time", has_text="computed").wait_for()

    def note_message(self, message):
        if message.type == "error":
            self.problems.append(message.text)

    def images(self):
        names = ("sheared", "unsheared", "tap")
        return {n: self.page.locator(f".{n} img").get_attribute("src") for n in names}

    def pose(self):
        rows = self.page.locator(".q-table tbody tr").all_inner_texts()
        return {row.split("\t")[0]: row.split("\t")[1:] for row in rows}

    def changed(self, do):
        """Return the images after `do` has changed the sheared one."""
        before = self.images()["sheared"]
        do()
        self.page.wait_for_function(
            "before => ![before, '', null].includes("
            "document.querySelector('.sheared img').getAttribute('src'))",
            arg=before,
        )
        self.page.wait_for_timeout(500)
        return self.images()

    def at(self, x, y):
        """Page px of a share of the map."""
        box = self.page.locator(".map").bounding_box()
        return box["x"] + box["width"] * x, box["y"] + box["height"] * y

    def drag(self, *places):
        self.page.mouse.move(*self.at(*places[0]))
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*self.at(*place), steps=3)
        self.page.mouse.up()

    def choose(self, label, name):
        self.page.locator(".q-select", has_text=label).click()
        self.page.locator(".q-menu .q-item", has_text=name).first.click()

    def drop(self, name, data):
        file = {"name": name, "mimeType": "application/octet-stream", "buffer": data}
        self.page.locator("input[type=file]").set_input_files(file)

    def problem(self):
        line = self.page.locator(".problem")
        line.wait_for(state="visible")
        return line.inner_text()

    def close(self, address):
        assert not self.problems
        hosts = {url.split("/")[2] for url in self.asked if "://" in url}
        assert hosts == {address.removeprefix("http://")}
        self.page.close()


@pytest.fixture
def tab(browser, address):
    opened = Tab(browser, address, viewport={"width": 1280, "height": 900})
    yield opened
    opened.close(address)


def test_pressing_and_sliding(tab):
    tab.drag((0.52, 0.5), (0.52, 0.47), (0.56, 0.47))
    place = tab.page.locator(".hint", has_text="pressed at")
    tab.page.locator(".hint", has_text="pressed at x 1.3, y 0.0 mm; slid by 2.6, 1.9 mm").wait_for()
    tab.page.wait_for_timeout(1000)
    images = tab.images()
    assert images["sheared"] != images["tap"] != images["unsheared"]
    # a map of 64 mm; the mouse stands on pixels
    assert float(tab.pose()["x, mm"][0]) == pytest.approx(0.06 * 64, abs=0.1)
    tab.drag((0.5, 0.5), (0.5, 0.9))  # as far as slides go
    tab.page.locator(".hint", has_text="slid by 0.0, -5.0 mm").wait_for()
    tab.page.get_by_text("Lift and tap").click()
    tab.page.wait_for_timeout(1000)
    assert "slid by 0.0, 0.0 mm" in place.inner_text() and "y -5.0" in place.inner_text()


def test_every_control_changes_the_picture(tab):
    seen = [tab.images()["sheared"]]
    tab.drag((0.5, 0.5), (0.54, 0.5))
    tab.page.wait_for_timeout(1500)
    for name in ("depth", "yaw", "friction"):
        slider = tab.page.get_by_role("slider", name=name)
        there = {"x": 0.7 * slider.bounding_box()["width"], "y": 8}
        seen.append(tab.changed(lambda: slider.click(position=there))["sheared"])  # noqa: B023
    seen.append(tab.changed(lambda: tab.page.get_by_label("depth, mm").fill("2"))["sheared"])
    seen.append(tab.changed(lambda: tab.choose("stimulus", "clover"))["sheared"])
    assert len(set(seen)) == len(seen)


def test_another_sensor_is_shown_but_not_unsheared(tab):
    assert tab.changed(lambda: tab.choose("sensor", "tactip127"))["unsheared"] in ("", None)
    assert "does not know this sensor" in tab.problem()


def test_a_depth_that_cannot_be_gives_a_line_and_no_picture(tab):
    depth = tab.page.get_by_label("depth, mm")
    depth.fill("12")
    assert "depth 12 mm cannot be reached" in tab.problem()
    assert set(tab.images().values()) <= {"", None} and not tab.pose()
    tab.changed(lambda: depth.fill("2"))
    assert not tab.page.locator(".problem").is_visible()


def test_recorded_images(tab):
    tab.drop("notes.txt", b"no image")
    assert "notes.txt: no readable image" in tab.problem()
    noise = np.random.default_rng(0).integers(0, 256, (200, 200), np.uint8)
    tab.drop("noise.png", png_of(noise))
    tab.page.locator(".problem", has_text="noise.png").wait_for()
    assert set(tab.images().values()) <= {"", None}
    tab.drag((0.5, 0.5), (0.54, 0.5))
    tab.page.wait_for_timeout(1500)
    shown = tab.images()
    tab.drop("slide.png", b64decode(shown["sheared"].partition(",")[2]))
    tab.page.locator(".hint", has_text="recorded: slide.png").wait_for()
    assert tab.images()["unsheared"] == shown["unsheared"] and tab.images()["tap"] in ("", None)
    assert tab.pose()["x, mm"][0] == "-"


def test_two_tabs_do_not_disturb_each_other(tab, browser, address):
    other = Tab(browser, address)
    assert other.images() == tab.images()
    first = tab.images()
    tab_changed = tab.changed(lambda: tab.choose("stimulus", "clover"))
    assert other.images() == first != tab_changed
    other.drag((0.5, 0.5), (0.54, 0.5))
    other.close(address)  # while its picture is being made
    assert tab.images() == tab_changed


def test_a_phone(browser, address):
    view = {"width": 375, "height": 812}
    phone = Tab(browser, address, viewport=view, has_touch=True, is_mobile=True)
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= 375
    phone.changed(lambda: phone.drag((0.5, 0.5), (0.54, 0.5)))
    phone.close(address)
