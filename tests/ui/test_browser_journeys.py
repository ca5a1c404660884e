"""What a forester does, in a real Chromium: clicks go through the page, numbers are compared with the session.

One page and one measured plot for the file, which every test leaves as it was. The plot is small: the browser
draws in software here.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import browser
import numpy as np
import plots
import pytest
from PIL import Image

from dbh_studio.app.session import Session
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.io.inventory_csv import inventory_csv
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1280, 720)
LONG_S = 120.0


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    uploads = tmp_path_factory.mktemp("uploads")
    running = Studio(start_server(port=0), uploads_folder=uploads, display_points=40_000)
    yield running
    running.close()


@pytest.fixture(scope="module")
def shared_page(studio: Studio, chromium: Any) -> Any:
    """The studio's page on a small laptop."""
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    page.wait_for_selector(".dbh-steps")
    browser.close_notifications(page)  # the page warns of software drawing
    return page


@pytest.fixture
def page(shared_page: Any) -> Iterator[Any]:
    """Whatever a test does, the page must not complain."""
    yield shared_page
    errors = browser.page_errors(shared_page)
    shared_page.studio_errors.clear()
    assert errors == []


@pytest.fixture(scope="module")
def session(studio: Studio, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The plot of this file, with its trunks found and measured; every test gets it as it is now."""
    studio.adopt(plots.measured_session(tmp_path_factory.mktemp("plot")))
    assert studio.session is not None
    return studio.session


@pytest.fixture
def measured(studio: Studio, session: Session, page: Any) -> Iterator[Any]:
    """The page with that plot, none of its trees chosen, trunks in red. What the test does to the plot is undone."""
    before = session.document
    for tab in studio._tabs.values():
        tab.worker.post(tab.adopt_session)
    page.wait_for_selector("button[data-step=inspect][data-active=true]")
    page.get_by_text("No tree is chosen.").wait_for()
    page.click("#dbh-view button[data-mode='Segmentation (red)']")
    page.click("#dbh-view button[data-look=plot]")
    wait_until_painted(page, studio)
    assert studio.wait_idle(LONG_S)
    browser.settle(page, studio)
    yield page
    browser.settle(page, studio)
    while session.document is not before:
        session.undo()


def wait_until_painted(page: Any, studio: Studio) -> None:
    assert studio.display is not None
    browser.wait_for_points(page, int((~studio.display.is_crown).sum()))


def until(condition: Callable[[], Any], timeout_s: float = LONG_S) -> Any:
    """Ask again and again until the answer is true: for what the page cannot tell by itself."""
    deadline = time.monotonic() + timeout_s
    while not (answer := condition()):
        assert time.monotonic() < deadline, "did not come to pass"
        time.sleep(0.1)
    return answer


def field(page: Any, label: str) -> Any:
    """An input of the panel by the label in front of it."""
    return page.locator(
        f"//label[normalize-space()='{label}']/ancestor::div[contains(@class,'mantine-Flex-root')][1]//input"
    ).first


def step(page: Any, name: str) -> None:
    page.click(f"button[data-step={name}]")
    page.wait_for_selector(f"button[data-step={name}][data-active=true]")


def rows(page: Any) -> list[int]:
    return [int(i) for i in page.eval_on_selector_all(".dbh-table tr[data-id]", "all => all.map(r => r.dataset.id)")]


def picture(page: Any) -> np.ndarray:
    """(H, W, 3) what is on the canvas."""
    box = page.evaluate("() => {const b = __viserMutable.canvas.getBoundingClientRect(); return [b.width, b.height];}")
    shot = page.screenshot(clip={"x": 0, "y": 0, "width": box[0], "height": box[1] - 60})  # above the view bar
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def n_red(page: Any) -> int:
    """How many pixels are red: much more red than anything else, as no bark or leaf is."""
    red, green, blue = np.moveaxis(picture(page), 2, 0)
    return int(((red > 80) & (green < 0.35 * red) & (blue < 0.35 * red)).sum())


def breast_height_points(studio: Studio, trunk_id: int) -> np.ndarray:
    """(N, 3) points of a trunk about breast height, world."""
    assert studio.session is not None
    stem = studio.session.measurement(trunk_id)
    points = studio.session.points_world()[studio.session.document.trunks[trunk_id].points]
    return points[np.abs(points[:, 2] - stem.z_ground_m - 1.3) < 0.3].astype(float)


def test_from_an_empty_studio_to_measured_trees(chromium: Any, tmp_path: Path) -> None:
    studio = Studio(start_server(port=0), uploads_folder=tmp_path / "uploads", display_points=40_000)
    try:
        page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
        page.wait_for_selector(".dbh-steps")
        open_find_and_measure(page, studio, plots.write_laz(tmp_path))
        assert browser.page_errors(page) == []
        page.context.close()
    finally:
        studio.close()


def open_find_and_measure(page: Any, studio: Studio, path: Path) -> None:
    assert page.get_attribute("button[data-active=true]", "data-step") == "open"
    field(page, "File or folder").fill(str(path))
    page.get_by_role("button", name="Open", exact=True).click()
    page.wait_for_selector("button[data-step=scale][data-state=done]")
    # The data check warns that the plot is sparse; the way on is a button beside the hint.
    page.get_by_text("Data check: look at the lines marked !").wait_for()
    page.click("button[data-do=next]")
    wait_until_painted(page, studio)
    assert n_red(page) < 50
    page.get_by_role("button", name="Find trunks", exact=True).click()
    page.wait_for_selector(".dbh-job button[data-do=cancel]")
    page.wait_for_selector("button[data-step=trunks][data-state=done]")
    page.wait_for_selector("button[data-step=inspect][data-active=true]")
    page.wait_for_selector(".dbh-table tr[data-id]")
    page.wait_for_function("() => !document.body.innerText.includes('not measured yet')")
    assert studio.wait_idle(LONG_S)
    browser.settle(page, studio)
    assert studio.session is not None
    assert rows(page) == list(studio.session.document.trunks.ids)
    shown = page.eval_on_selector_all("td[data-column=dbh]", "all => all.map(cell => Number(cell.innerText))")
    assert np.sort(shown) == pytest.approx(plots.true_diameters_cm(), rel=0.04)
    until(lambda: n_red(page) > 500)


def test_cancel_stops_the_search_while_its_bar_moves(
    measured: Any, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The box is brought up to date fifty times a second here, and its button must still be there to be pressed."""
    monkeypatch.setattr("dbh_studio.app.pipeline.segment_plot", plots.endless_search)
    assert studio.session is not None
    before = studio.session.document
    step(measured, "trunks")
    measured.get_by_role("button", name="Find trunks", exact=True).click()
    measured.get_by_text("Looking behind tree").wait_for()
    measured.get_by_role("button", name="Find trunks", exact=True, disabled=True).wait_for()
    measured.click("button[data-do=cancel]")
    browser.wait_for_note(measured, "nothing was changed")
    measured.wait_for_selector(".dbh-job", state="hidden")
    assert studio.session.document is before
    browser.close_notifications(measured)


def test_trunks_are_red_in_the_picture_and_not_in_the_original_colours(measured: Any) -> None:
    until(lambda: n_red(measured) > 500)
    measured.click("#dbh-view button[data-mode='Original']")
    measured.wait_for_selector("#dbh-view button[data-mode='Original'][aria-pressed=true]")
    until(lambda: n_red(measured) < 50)
    measured.click("#dbh-view button[data-mode='Segmentation (red)']")
    until(lambda: n_red(measured) > 500)


def test_a_click_on_a_trunk_shows_its_diameter(measured: Any, studio: Studio) -> None:
    assert studio.session is not None
    (client,) = studio.server.viser.get_clients().values()
    for trunk_id in studio.session.document.trunks.ids[:2]:
        middle = np.median(breast_height_points(studio, trunk_id), axis=0)
        client.camera.position = middle + np.array([0.5, -3.0, 0.5])
        client.camera.look_at = middle
        browser.settle(measured, studio)
        until(lambda middle=middle: abs(browser.pixel_of(measured, middle)[1] - LAPTOP[1] / 2) < 3)
        measured.mouse.click(*browser.pixel_of(measured, middle))
        card = measured.locator(f".dbh-card[data-tree='{trunk_id}']")
        card.wait_for()
        result = studio.session.measurement(trunk_id).result
        assert card.locator(".dbh-number b").inner_text() == f"{result.dbh_cm:.1f}"
        assert f"{result.section.coverage_deg:.0f}°" in card.inner_text()
        measured.wait_for_selector(f"tr[data-id='{trunk_id}'][data-selected=true]")


def test_a_row_chooses_the_tree_and_brings_the_camera_to_it(measured: Any, studio: Studio) -> None:
    (client,) = studio.server.viser.get_clients().values()
    for trunk_id in (rows(measured)[-1], rows(measured)[0]):
        measured.click(f"tr[data-id='{trunk_id}']")
        measured.wait_for_selector(f".dbh-card[data-tree='{trunk_id}']")
        browser.settle(measured, studio)
        assert measured.eval_on_selector_all("tr[data-selected=true]", "all => all.map(r => r.dataset.id)") == [
            str(trunk_id)
        ]
        middle = np.median(breast_height_points(studio, trunk_id), axis=0)
        until(lambda middle=middle: np.linalg.norm(client.camera.position - middle) < 8.0)
    # Yellow, and the blue ring about it.
    until(lambda: is_marked(picture(measured)))


def is_marked(pixels: np.ndarray) -> bool:
    red, green, blue = np.moveaxis(pixels, 2, 0)
    yellow = ((red > 120) & (green > 0.6 * red) & (blue < 0.3 * red)).sum()
    ring = ((blue > 120) & (red < 0.5 * blue) & (green < 0.6 * blue)).sum()
    return bool(yellow > 2000 and ring > 30)


def test_on_a_small_laptop_number_and_picture_are_seen_without_scrolling(measured: Any, studio: Studio) -> None:
    measured.click(f"tr[data-id='{rows(measured)[1]}']")
    measured.wait_for_selector(f".dbh-card[data-tree='{rows(measured)[1]}']")
    browser.settle(measured, studio)
    for selector in (".dbh-steps", ".dbh-table", ".dbh-number b", ".dbh-section", ".dbh-legend"):
        box = measured.locator(selector).first.bounding_box()
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= LAPTOP[0]
        if selector != ".dbh-table":  # which scrolls by itself
            assert box["y"] + box["height"] <= LAPTOP[1], selector
    too_wide = """() => [...document.querySelectorAll('.dbh, .dbh-scroll, .dbh-cut, .dbh-steps')]
        .filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.className)"""
    assert measured.evaluate(too_wide) == []


def test_a_curve_is_chosen_in_the_legend_and_undone_by_a_key(measured: Any, studio: Studio) -> None:
    trunk_id = rows(measured)[0]
    measured.click(f"tr[data-id='{trunk_id}']")
    assert studio.session is not None
    measured.click("button[data-choose=ellipse]")
    measured.wait_for_selector("button[data-choose=ellipse][aria-pressed=true]")
    browser.settle(measured, studio)
    result = studio.session.measurement(trunk_id).result
    assert isinstance(result, DbhEstimate) and result.curve == "ellipse"
    assert measured.inner_text(".dbh-number b") == f"{result.dbh_cm:.1f}"
    measured.mouse.move(300, 300)
    measured.keyboard.press("Control+z")
    measured.wait_for_selector("button[data-choose=shrinkage][aria-pressed=true]")


def test_a_deleted_trunk_comes_back_by_key_and_by_button(measured: Any, studio: Studio) -> None:
    assert studio.session is not None
    ids = rows(measured)
    measured.click(f"tr[data-id='{ids[1]}']")
    measured.wait_for_selector(f".dbh-card[data-tree='{ids[1]}']")
    browser.unfold(measured, "About this tree")
    delete = measured.get_by_role("button", name="Delete this trunk")
    delete.click()
    measured.wait_for_selector(f"tr[data-id='{ids[1]}']", state="detached")
    assert ids[1] not in studio.session.document.trunks
    measured.mouse.move(300, 300)
    measured.keyboard.press("Control+z")
    measured.wait_for_selector(f"tr[data-id='{ids[1]}']")
    assert rows(measured) == ids
    browser.settle(measured, studio)  # no row is drawn anew under the pointer
    measured.click(f"tr[data-id='{ids[1]}']")
    measured.wait_for_selector(f".dbh-card[data-tree='{ids[1]}']")
    browser.settle(measured, studio)
    measured.wait_for_timeout(500)  # no double click
    delete.click()
    measured.wait_for_selector(f"tr[data-id='{ids[1]}']", state="detached")
    measured.click("button[data-do=undo]")
    measured.wait_for_selector(f"tr[data-id='{ids[1]}']")
    assert ids[1] in studio.session.document.trunks


def test_the_downloaded_file_is_the_inventory_byte_for_byte(measured: Any, studio: Studio, tmp_path: Path) -> None:
    assert studio.session is not None
    step(measured, "export")
    with measured.expect_download() as download:
        measured.get_by_role("button", name="Download the inventory (CSV)").click()
    saved = tmp_path / "saved.csv"
    download.value.save_as(saved)
    assert download.value.suggested_filename == "plot_inventory.csv"
    assert saved.read_bytes() == inventory_csv(studio.session.inventory())
    measured.wait_for_selector("button[data-step=export][data-state=done]")


def test_arrow_buttons_and_keys_go_through_the_trees(measured: Any) -> None:
    ids = rows(measured)
    measured.click(f"tr[data-id='{ids[0]}']")
    measured.click("button[data-do=Next]")
    measured.wait_for_selector(f".dbh-card[data-tree='{ids[1]}']")
    measured.mouse.move(300, 300)
    measured.keyboard.press("n")
    measured.wait_for_selector(f".dbh-card[data-tree='{ids[2]}']")
    measured.keyboard.press("p")
    measured.wait_for_selector(f".dbh-card[data-tree='{ids[1]}']")


def test_a_reload_shows_the_same_plot_without_a_new_login(measured: Any, studio: Studio) -> None:
    ids = rows(measured)
    measured.reload()
    assert studio.server.guard.token not in measured.url
    measured.wait_for_selector(".dbh-table tr[data-id]")
    assert rows(measured) == ids
    wait_until_painted(measured, studio)
    until(lambda: n_red(measured) > 500)
