"""Helpers for tests in a real Chromium, drawing in software.

Software drawing takes about 2 s per frame and million points: keep clouds in browser tests below 100 000 points, and
take the fixture `chromium`, which is one browser for all test files::

    page = browser.open_page(chromium, server.url)
    browser.wait_for_points(page, 60_000)
    page.mouse.click(*browser.pixel_of(page, (0, 0, 1.3)))
    assert browser.page_errors(page) == []
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from fakeclient import until_ended

LAUNCH_ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
TIMEOUT_MS = 120_000
_serials = itertools.count(1)

_PIXEL = """point => {
  const m = window.__viserMutable, camera = m.camera, box = m.canvas.getBoundingClientRect();
  camera.updateMatrixWorld();
  const v = new camera.position.constructor(...point);
  m.nodeRefFromName[''].localToWorld(v);
  v.project(camera);
  return [box.x + (v.x + 1) / 2 * box.width, box.y + (1 - v.y) / 2 * box.height];
}"""

# What the page has told since it was loaded: a note closes by itself after seconds, in which a busy machine may not
# have drawn a single frame.
_REMEMBER_NOTES = """
window.dbhNotes = [];
new MutationObserver(changes => changes.forEach(change => change.addedNodes.forEach(added => {
  if (added.nodeType !== 1) return;
  const notes = [added, ...added.querySelectorAll('*')].filter(each => each.matches('.mantine-Notification-root'));
  window.dbhNotes.push(...notes.map(each => each.textContent));
}))).observe(document, {childList: true, subtree: true});
"""


@contextlib.contextmanager
def chromium(executable: str) -> Iterator[Any]:
    """A running Playwright browser; `executable` comes from the fixture `chromium_path`."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=executable, args=list(LAUNCH_ARGUMENTS))
        try:
            yield running
        finally:
            running.close()


def open_page(browser: Any, url: str, *, size: tuple[int, int] = (1100, 700), wait: bool = True) -> Any:
    """Open `url` in a profile of its own (no cookies) and, with `wait`, wait until the page talks to the server.

    Errors of the page are collected for `page_errors`.
    """
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=True)
    page = context.new_page()
    page.set_default_timeout(TIMEOUT_MS)
    page.add_init_script(_REMEMBER_NOTES)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.studio_errors = errors
    page.goto(url)
    if wait:
        page.wait_for_function("() => window.__viserMutable && window.__viserMutable.cameraControl")
    return page


def page_errors(page: Any) -> list[str]:
    """Uncaught exceptions and console errors since the page was opened; refusals by the content policy among them."""
    return list(page.studio_errors)


def wait_for_points(page: Any, n_points: int) -> None:
    """Wait until a frame with at least so many points was drawn."""
    page.wait_for_function("n => window.__viserTestpoints.rendererInfo.render.points >= n", arg=n_points)


def wait_for_frames(page: Any, n_frames: int) -> None:
    """Wait until the picture was drawn so many times more: what moves in it follows with the next one."""
    later = """n => new Promise(done => {
      const next = () => n-- > 0 ? requestAnimationFrame(next) : done();
      next();
    })"""
    page.evaluate(later, n_frames)


def unfold(page: Any, title: str) -> None:
    """Open a folder of the panel, and wait until it has unfolded.

    Until then what is in it moves, also between a press and its release, which is no click then.
    """
    page.get_by_text(title, exact=True).first.click()
    wait_for_frames(page, 3)  # it begins with the second
    page.wait_for_function("() => !document.getAnimations().some(each => each instanceof CSSTransition)", polling=50)


def settle(page: Any, studio: Any) -> None:
    """Wait until the studio has dealt with all that was done in the page, and the page has drawn what came of it."""
    until_ended("stream")
    serial = next(_serials)
    for tab in list(studio._tabs.values()):

        def answer(payload: Any, tab: Any = tab) -> None:
            tab.bridge.run(f"window.dbhSettled = {int(payload)};")
            tab.client.flush()

        tab.bridge.on("settled?", answer)  # it takes its turn in the tab's queue
    page.evaluate("serial => window.dbh('settled?', serial)", serial)
    page.wait_for_function("serial => window.dbhSettled === serial", arg=serial)
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))")


def pixel_of(page: Any, point: Sequence[float]) -> tuple[float, float]:
    """Where a world point is on the page, in CSS pixels."""
    x, y = page.evaluate(_PIXEL, [float(c) for c in point])
    return float(x), float(y)


def wait_for_note(page: Any, text: str) -> None:
    """Wait until a note with this text was shown, since the page was loaded; it may have gone again."""
    told = "text => window.dbhNotes.some(note => note.includes(text))"
    page.wait_for_function(told, arg=text, polling=100)


def close_notifications(page: Any) -> None:
    """Close what covers the upper left corner (the page warns of software drawing there)."""
    close = """() => {
      document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click());
      return document.querySelectorAll('.mantine-Notification-closeButton').length === 0;
    }"""
    page.wait_for_function(close, polling=100)  # they fade


def handle_selector(handle: Any) -> str:
    """CSS selector of a viser input: the page uses the handle's uuid as the element's id."""
    return f"[id='{handle._impl.uuid}']"
