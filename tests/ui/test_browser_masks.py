"""Masks as a forester uses them, in a real Chromium: brought, voted with, seen as colours, mended with the brush."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import browser
import mask_plots
import numpy as np
import pytest
from tests import maskplot

from dbh_studio.io.masks import MaskStore
from dbh_studio.io.models import ModelStore
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1366, 768)
LONG_S = 120.0
VIEW = "#dbh-photo .view"
POLE, PHOTOS = 9, ("01.jpg", "05.jpg")


@pytest.fixture
def plot(tmp_path: Path) -> maskplot.MaskPlot:
    return mask_plots.write(tmp_path / "plot")


@pytest.fixture
def studio(tmp_path: Path, plot: maskplot.MaskPlot) -> Iterator[Studio]:
    running = Studio(start_server(port=0), uploads_folder=tmp_path / "uploads", display_points=40_000)
    running.masks.use_models(ModelStore(folder=tmp_path / "no models", offline=True))
    running.adopt(mask_plots.open_session(plot, tmp_path / "plot.dbh"))
    yield running
    running.close()


def until(condition: Callable[[], Any]) -> Any:
    """Ask again and again until the answer is true."""
    deadline = time.monotonic() + LONG_S
    while not (answer := condition()):
        assert time.monotonic() < deadline, "did not come to pass"
        time.sleep(0.1)
    return answer


def press(page: Any, label: str) -> None:
    page.get_by_role("button", name=label, exact=True).click()


def fill(page: Any, label: str, text: str) -> None:
    field = f"//label[normalize-space()='{label}']/ancestor::div[contains(@class,'mantine-Flex-root')][1]//input"
    page.locator(field).first.fill(text)


def find_trunks(page: Any, studio: Studio, n_trunks: int) -> None:
    page.click("button[data-step=trunks]")
    press(page, "Find trunks from the masks")
    until(lambda: studio.session is not None and len(studio.session.document.trunks) == n_trunks)
    assert studio.wait_idle(LONG_S)


def test_a_pole_that_masks_call_trunk_is_painted_away(
    chromium: Any, studio: Studio, plot: maskplot.MaskPlot, tmp_path: Path
) -> None:
    brought = tmp_path / "brought"
    brought.mkdir()
    for name in PHOTOS:  # two only, so that one of them decides
        shutil.copy(plot.masks / f"{Path(name).stem}.png", brought)
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    page.wait_for_selector(".dbh-steps")
    browser.close_notifications(page)
    page.click("button[data-step=trunks]")

    # The masks are looked at, and used when a person says so.
    page.get_by_text("Trunks by geometry alone").wait_for()
    browser.unfold(page, "Bring masks")
    fill(page, "Masks in", str(brought))
    press(page, "Look at them")
    page.wait_for_selector(".dbh-masklook img")
    press(page, "Use these masks")
    page.get_by_text("2 of 8 photos have a mask.").first.wait_for()
    assert studio.wait_idle(LONG_S)
    find_trunks(page, studio, 4)

    # The cloud shows how often each point was called trunk.
    page.click("#dbh-view [data-mode='Label count']")
    page.get_by_text("Masks that call a point trunk").wait_for()
    assert page.locator("#dbh-counts .cells i").count() == 3  # none, one, two
    (tab,) = studio._tabs.values()
    until(lambda: tab.scene._frames["/count"].visible)

    # The pole is painted away in one of the two photos.
    page.click("button[data-step=trunks]")
    press(page, "Look through the masks")
    page.wait_for_selector(f"{VIEW}[data-frame]")
    page.click("[data-photo=large]")
    until(lambda: tab.photos._look is not None and tab.photos._look.width_px > 600)
    name, truth = PHOTOS[0], maskplot.labels()[PHOTOS[0]]
    assert tab.photos.image == name
    rows, columns = np.nonzero(truth == POLE)
    middle = float(np.median(columns)) + 0.5, float(np.median(rows)) + 0.5
    tab.worker.post(lambda: tab.photos.open(name, at_px=middle, zoom_px=2.0))
    assert studio.wait_idle(LONG_S)
    page.click("[data-mask=paint]")
    page.wait_for_selector(f"{VIEW}[data-tool=add]")
    page.click("[data-mask=erase]")
    page.wait_for_selector(f"{VIEW}[data-tool=erase]")
    page.locator("[data-mask=size]").fill("40")
    ends, _ = tab.photos._look.view_from_photo([(middle[0], rows.min()), (middle[0], rows.max())])
    box = page.locator(VIEW).bounding_box()
    on_page = np.clip(ends, 2, [box["width"] - 2, box["height"] - 2]) + [box["x"], box["y"]]
    before = np.asarray(tab.client.camera.position).copy()
    page.mouse.move(*on_page[0])
    page.mouse.down()
    page.mouse.move(*on_page[1], steps=25)
    page.mouse.up()
    assert tab.studio.session is not None
    folder = tab.studio.session.saver.folder / "masks"
    until(lambda: MaskStore(folder).entry(name).review == "repainted")
    assert studio.wait_idle(LONG_S)
    painted = MaskStore(folder).get(name).labels
    assert np.count_nonzero(painted == POLE) < 0.3 * np.count_nonzero(truth == POLE)
    assert all(np.array_equal(painted == stem, truth == stem) for stem in (2, 3))
    page.wait_for_selector(".maskrow .state[data-level=ok]")
    page.keyboard.press("Escape")
    page.wait_for_selector(f"{VIEW}[data-tool='']")
    page.keyboard.press("a")  # accepts, and moves no camera
    page.get_by_text(PHOTOS[1]).first.wait_for()
    page.click("[data-photo=close]")
    assert np.allclose(np.asarray(tab.client.camera.position), before)

    # Found again, the pole is no trunk any more: one photo alone does not make one.
    find_trunks(page, studio, 3)
    assert browser.page_errors(page) == []
    page.context.close()
