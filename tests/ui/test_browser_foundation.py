"""The foundation in a real browser: login, connection, bridge, clicks, and a content policy that breaks nothing."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import browser
import numpy as np
import pytest

from dbh_studio.ui.bind import SceneClick, TabWorker, for_each_tab
from dbh_studio.ui.bridge import Bridge, call, esc
from dbh_studio.ui.server import StudioServer, start_server

pytestmark = pytest.mark.browser

HOSTILE = """oak "1" <img src=x onerror="window.broken=1">'"""
TARGET = (0.0, 0.0, 1.0)
LOAD_IMAGE = """address => new Promise(done => {
  const image = new Image();
  image.onload = () => done(image.naturalWidth);
  image.onerror = () => done(0);
  image.src = address;
})"""


class Studio:
    """A small panel: a clickable row, an upload, a scene to click."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, Any]] = []
        self.arrived = threading.Condition()
        self.tabs: list[TabWorker] = []
        self.server: StudioServer = start_server(port=0)
        self.server.routes["/frame.svg"] = lambda _: (
            200,
            "image/svg+xml",
            b"<svg xmlns='http://www.w3.org/2000/svg' width='64' height='32'/>",
        )
        points = np.random.default_rng(0).normal(0, 0.5, (5000, 3)) + TARGET
        self.server.viser.scene.add_point_cloud("/points", points.astype(np.float32), (90, 80, 60), precision="float32")
        for_each_tab(self.server.viser, self.open_tab)

    def note(self, kind: str, value: Any) -> None:
        with self.arrived:
            self.seen.append((kind, value))
            self.arrived.notify_all()

    def wait(self, kind: str) -> Any:
        with self.arrived:
            assert self.arrived.wait_for(lambda: any(k == kind for k, _ in self.seen), 120), f"{kind} never came"
            return next(value for k, value in self.seen if k == kind)

    def open_tab(self, worker: TabWorker) -> None:
        gui = worker.client.gui
        bridge = Bridge(worker)
        bridge.on("row", lambda payload: self.note("row", payload))
        bridge.on("script", lambda payload: self.note("script", payload))
        gui.add_html(f'<table><tr class="row" onclick="{call("row", HOSTILE)}"><td>{esc(HOSTILE)}</td></tr></table>')
        self.upload = gui.add_upload_button("Upload", mime_type=".ply")
        worker.on_upload(
            self.upload, lambda f: self.note("upload", (f.name, f.path.read_bytes())), allowed_suffixes=(".ply",)
        )
        worker.on_scene_click(worker.client, lambda click: self.note("click", click))
        worker.add_command("Merge", lambda: self.note("hotkey", True), hotkey="M")
        self.tabs.append(worker)


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    made = Studio()
    yield made
    made.server.stop()


def until(page: Any, condition: Callable[[], bool]) -> None:
    """Ask again and again; the page's own events come in between."""
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline, "did not come to pass"
        page.wait_for_timeout(50)


def test_the_page_works_behind_the_guard(studio: Studio, chromium: Any) -> None:
    """One page for everything: each step is a thing a person does."""
    # Without the link there is no page.
    stranger = browser.open_page(chromium, f"http://127.0.0.1:{studio.server.port}/", wait=False)
    assert "full link" in stranger.inner_text("body")
    stranger.context.close()

    # The link logs in, leaves the address bar, and the page connects.
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1")
    page.wait_for_selector("tr.row")
    assert studio.server.guard.token not in page.url
    (cookie,) = page.context.cookies()
    assert cookie["httpOnly"] and cookie["sameSite"] == "Strict"
    assert page.evaluate("() => document.cookie") == ""

    # Page -> Python, from a script and from a row with a hostile name, which stays text.
    page.evaluate("() => window.dbh('script', {a: [1, 'é']})")
    assert studio.wait("script") == {"a": [1, "é"]}
    page.click("tr.row")
    assert studio.wait("row") == HOSTILE
    assert HOSTILE in page.inner_text("tr.row") and page.evaluate("() => window.broken") is None

    # The studio's own pages are images the page may show.
    assert page.evaluate(LOAD_IMAGE, "/frame.svg") == 64

    # A file, a hotkey, and a click whose ray meets the point that was clicked.
    page.set_input_files(
        f"[id='file_upload_{studio.upload._impl.uuid}']",
        [{"name": "a.ply", "mimeType": "", "buffer": b"x" * 600_000}],
    )
    assert studio.wait("upload") == ("a.ply", b"x" * 600_000)
    browser.wait_for_points(page, 5000)
    browser.close_notifications(page)
    page.mouse.move(300, 600)
    page.keyboard.press("m")
    assert studio.wait("hotkey")
    page.mouse.click(*browser.pixel_of(page, TARGET))
    click: SceneClick = studio.wait("click")
    offset = np.array(TARGET) - click.ray_origin
    distance = np.linalg.norm(np.cross(offset, click.ray_direction))
    assert distance < 2 * click.view.pixel_angle_rad * np.linalg.norm(offset)
    np.testing.assert_allclose(click.view.ray(click.screen_xy), click.ray_direction, atol=2e-3)

    # A foreign address is not reachable from the page.
    blocked = "() => fetch('http://192.0.2.1/').then(() => 'sent', e => String(e))"
    assert "sent" not in page.evaluate(blocked)
    until(page, lambda: any(re.search("Content Security Policy", error) for error in browser.page_errors(page)))
    errors = [error for error in browser.page_errors(page) if "192.0.2.1" not in error]
    assert errors == []

    # A dropped connection comes back as a new tab with a new bridge.
    studio.seen.clear()
    page.evaluate("() => { document.querySelector('tr.row').dataset.old = true; }")
    studio.server.viser._websock_server.disconnect_all_clients()
    page.wait_for_selector("tr.row:not([data-old])")
    page.evaluate("() => window.dbh('script', 'again')")
    assert studio.wait("script") == "again"
    until(page, lambda: [tab.closed for tab in studio.tabs] == [True, False])
    page.context.close()
