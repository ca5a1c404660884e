"""Photos as a forester sees them, in a real Chromium: added, clicked in the scene, looked around in, clicked into."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import browser
import numpy as np
import photo_plots
import plots
import pytest
from PIL import Image

from dbh_studio.app.opening import open_plot
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1280, 720)
LONG_S = 120.0
VIEW = "#dbh-photo .view"


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    running = Studio(start_server(port=0), uploads_folder=tmp_path / "uploads", display_points=40_000)
    running.adopt(open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh"))
    yield running
    running.close()


def until(condition: Callable[[], Any], timeout_s: float = LONG_S) -> Any:
    """Ask again and again until the answer is true."""
    deadline = time.monotonic() + timeout_s
    while not (answer := condition()):
        assert time.monotonic() < deadline, "did not come to pass"
        time.sleep(0.1)
    return answer


def frame(page: Any) -> int:
    return int(page.get_attribute(VIEW, "data-frame") or 0)


def settled(page: Any, studio: Studio) -> np.ndarray:
    """(H, W, 3) the photo as it is on the page once nothing more comes."""
    assert studio.wait_idle(LONG_S)
    seen = -1
    while seen != frame(page):
        # The page asks for the next view when one arrives, so what it asks for is known by the second time.
        browser.settle(page, studio)
        seen = frame(page)
        browser.settle(page, studio)
    page.evaluate("view => document.querySelector(view + ' img').decode()", VIEW)
    shot = page.screenshot(clip=page.locator(VIEW).bounding_box())
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def dot(page: Any, studio: Studio) -> tuple[float, float]:
    """Where the white dot of the photos is on the page."""
    picture, box = settled(page, studio), page.locator(VIEW).bounding_box()
    inner = picture[6:-6, 6:-6]  # the corners of the view are round, and the page behind them is white
    rows, columns = np.nonzero(inner.min(axis=2) > 140)
    assert len(rows)
    return box["x"] + 6 + columns.mean() + 0.5, box["y"] + 6 + rows.mean() + 0.5


def show_photos(page: Any, studio: Studio, folder: Path) -> None:
    """Type where the photos are, and read them."""
    page.get_by_text("Data check").wait_for()
    page.click("button[data-step=scale]")
    page.click("[data-way=markers]")
    cameras = page.locator(
        "//label[normalize-space()='Cameras']/ancestor::div[contains(@class,'mantine-Flex-root')][1]//input"
    )
    cameras.first.fill(str(folder))
    page.get_by_role("button", name="Add photos", exact=True).click()
    page.click("button[data-do=photos]")
    page.get_by_text(f"{photo_plots.N_PHOTOS} photos (COLMAP), all on disk. They fit the cloud.").wait_for()
    assert studio.wait_idle(LONG_S)


def test_from_a_camera_in_the_scene_to_a_pixel_of_its_photo(chromium: Any, studio: Studio, tmp_path: Path) -> None:
    photos = photo_plots.write_photos(tmp_path / "elsewhere" / "photos")
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    page.wait_for_selector(".dbh-steps")
    browser.close_notifications(page)
    show_photos(page, studio, photos)
    (tab,) = studio._tabs.values()
    centre = tab.cameras.glyphs.centres[2]
    camera = tab.client.camera
    camera.position = centre + np.array([0.6, 0.6, 1.5])
    camera.look_at = centre
    browser.settle(page, studio)
    until(lambda: abs(browser.pixel_of(page, centre)[1] - LAPTOP[1] / 2) < 3)
    page.wait_for_function("() => window.__viserTestpoints.rendererInfo.render.triangles > 0")
    page.mouse.click(*browser.pixel_of(page, centre))
    page.wait_for_selector(f"{VIEW}[data-frame]")
    browser.settle(page, studio)
    assert tab.photos.image == photo_plots.name(2)
    page.get_by_text(photo_plots.name(2)).first.wait_for()
    until(lambda: np.linalg.norm(np.asarray(camera.position) - centre) < 1e-3)

    picked: list[tuple[str, float, float]] = []
    tab.worker.post(setattr, tab.photos, "on_pick", lambda *pick: picked.append(pick))
    tab.worker.post(tab.photos.refresh)
    page.wait_for_selector(f"{VIEW}[data-picks=true]")
    x, y = dot(page, studio)
    page.mouse.click(x, y)
    name, u, v = until(lambda: picked.pop() if picked else None)
    assert name == photo_plots.name(2)
    assert (u, v) == pytest.approx(photo_plots.DOT, abs=1.0)

    # Held and drawn aside it follows the pointer; a drag is no click.
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 20, y + 10, steps=3)
    page.mouse.move(x + 70, y + 40, steps=5)
    page.mouse.up()
    assert dot(page, studio) == pytest.approx((x + 70, y + 40), abs=1.5)
    assert picked == []
    for _ in range(5):
        page.mouse.wheel(0, -200)
        page.wait_for_timeout(50)
    nearer = dot(page, studio)
    # The dot was found to half a pixel before it was enlarged ten times.
    assert nearer == pytest.approx((x + 70, y + 40), abs=8)
    assert tab.photos._look.zoom > 2
    page.mouse.click(*nearer)
    assert until(lambda: picked.pop() if picked else None)[1:] == pytest.approx(photo_plots.DOT, abs=0.4)

    # Larger over the cloud, where the next one is looked at; then away.
    page.click("#dbh-photo [data-photo=large]")
    until(lambda: tab.photos._look.width_px > 600)
    page.click("#dbh-photo [data-photo=after]")
    page.get_by_text(photo_plots.name(3)).first.wait_for()
    settled(page, studio)
    page.click("#dbh-photo [data-photo=close]")
    page.wait_for_selector("#dbh-photo", state="detached")
    until(lambda: tab.photos.image is None)
    assert browser.page_errors(page) == []
    page.context.close()
