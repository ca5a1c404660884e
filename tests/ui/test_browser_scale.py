"""Scaling in a real Chromium: a marker's corners clicked in the cloud, a bar clicked in panoramas, and both undone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import browser
import numpy as np
import pytest
import scale_plots

from dbh_studio.app.session import Session
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1280, 720)
LONG_S = 120.0
_PHOTO_PIXEL = """() => {
  const box = document.querySelector('#dbh-photo .view').getBoundingClientRect();
  return [box.x, box.y, box.width, box.height];
}"""


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    uploads = tmp_path_factory.mktemp("uploads")
    running = Studio(start_server(port=0), uploads_folder=uploads, display_points=50_000)
    yield running
    running.close()


@pytest.fixture(scope="module")
def shared_page(studio: Studio, chromium: Any) -> Any:
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    page.wait_for_selector(".dbh-steps")
    browser.close_notifications(page)
    return page


@pytest.fixture
def session(studio: Studio, shared_page: Any, tmp_path: Path) -> Iterator[Session]:
    """The plot without a unit, in the Scale step; whatever a test does, the page must not complain."""
    opened = scale_plots.session_of(tmp_path)
    studio.adopt(opened)
    shared_page.wait_for_selector("button[data-step=scale]")
    shared_page.click("button[data-step=scale]")
    shared_page.wait_for_selector(".dbh-ways")
    assert studio.display is not None
    browser.settle(shared_page, studio)
    browser.wait_for_points(shared_page, int((~studio.display.is_crown).sum()))
    yield opened
    browser.settle(shared_page, studio)
    errors = browser.page_errors(shared_page)
    shared_page.studio_errors.clear()
    assert errors == []


def until(condition: Callable[[], Any]) -> Any:
    """Ask again and again until the answer is true."""
    deadline = time.monotonic() + LONG_S
    while not (answer := condition()):
        assert time.monotonic() < deadline, "did not come to pass"
        time.sleep(0.1)
    return answer


def tab_of(studio: Studio) -> Any:
    (tab,) = studio._tabs.values()
    return tab


def look_at(page: Any, studio: Studio, target: np.ndarray, away: np.ndarray) -> None:
    """Put the camera where a person would fly to."""
    tab = tab_of(studio)
    tab.worker.post(lambda: tab.scene._move(target + away, target, animate=False))
    browser.settle(page, studio)
    until(lambda: np.linalg.norm(np.asarray(tab.client.camera.position) - target - away) < 1e-3)
    browser.settle(page, studio)


def test_four_corners_of_a_marker_clicked_in_the_cloud(studio: Studio, session: Session, shared_page: Any) -> None:
    page, truth = shared_page, scale_plots.plot()
    corners = truth.corners()
    side = float(np.linalg.norm(corners[1] - corners[0]))
    page.click("button[data-way=cloud]")
    page.click("button[data-start=square]")
    page.wait_for_selector("#dbh-banner")
    look_at(page, studio, corners.mean(axis=0), side * np.array([0.1, -1.0, 2.0]))
    for number, corner in enumerate(corners):
        page.mouse.click(*browser.pixel_of(page, corner))
        page.wait_for_selector(f"button[data-point='{number}'][data-kind=done]")
    page.fill("input[data-field=keep]", "1.00")
    page.click("button[data-do=keep]")
    page.get_by_role("button", name="Set the scale from the known lengths").click()
    page.wait_for_selector("button[data-step=scale][data-state=done]")
    scale = session.document.scale
    assert scale.source == "marker"
    assert scale.metres_per_unit == pytest.approx(truth.metres_per_unit, rel=0.01)
    page.get_by_text(f"1 unit = {scale.metres_per_unit:.6g} m").wait_for()
    page.click("button[data-do=undo]")
    page.wait_for_selector("button[data-step=scale][data-state=open]")
    assert not session.document.scale.is_known and len(session.document.evidence) == 1
    page.click("button[data-do=undo]")
    until(lambda: len(session.document.evidence) == 0)


def test_the_enlarged_point_is_moved_by_a_click_and_by_the_arrow_keys(
    studio: Studio, session: Session, shared_page: Any
) -> None:
    page, corner = shared_page, scale_plots.plot().corners()[0]
    page.click("button[data-way=cloud]")
    page.click("button[data-start=bar]")
    look_at(page, studio, corner, np.array([0.2, -1.5, 2.5]))
    page.mouse.click(*browser.pixel_of(page, corner + [0.03, 0.0, 0.0]))
    page.wait_for_selector(".dbh-closeup")
    browser.settle(page, studio)
    marking = tab_of(studio).marking
    eye = np.asarray(tab_of(studio).client.camera.position)
    # Where the corner is in the picture as it is enlarged.
    x, y = marking.close_up.place_of(corner)
    box = page.locator(".dbh-closeup").bounding_box()
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    until(lambda: np.linalg.norm(np.array(marking.picks.picks[0].point.xyz_src) - corner) < 0.012)
    before = np.array(marking.picks.picks[0].point.xyz_src)
    page.keyboard.press("ArrowRight")
    until(lambda: not np.array_equal(marking.picks.picks[0].point.xyz_src, before))
    step = np.linalg.norm(np.array(marking.picks.picks[0].point.xyz_src) - before)
    assert 0 < step < 3 * 2 * marking.close_up.half_width / 260
    browser.settle(page, studio)
    np.testing.assert_allclose(tab_of(studio).client.camera.position, eye, atol=1e-6)  # the keys did not fly
    page.keyboard.press("Escape")
    page.wait_for_selector("#dbh-banner", state="detached")


def test_a_side_that_is_refused_does_not_stay_in_its_field(session: Session, shared_page: Any) -> None:
    page = shared_page
    page.click("button[data-way=markers]")
    field = page.locator("input[data-field=marker-side]")
    for typed, shown in (("abc", "1.00"), ("0", "1.00"), ("0,5", "0.50"), ("50 cm", "0.50")):
        field.fill(typed)
        page.keyboard.press("Enter")
        until(lambda shown=shown: field.input_value() == shown)
    browser.close_notifications(page)


def test_the_chosen_point_is_dragged_by_its_arrows(studio: Studio, session: Session, shared_page: Any) -> None:
    page, corner = shared_page, scale_plots.plot().corners()[0]
    page.click("button[data-way=cloud]")
    page.click("button[data-start=bar]")
    look_at(page, studio, corner, np.array([0.2, -1.5, 2.5]))
    page.mouse.click(*browser.pixel_of(page, corner))
    page.wait_for_selector("button[data-point='0'][data-kind=done]")
    marking, camera = tab_of(studio).marking, tab_of(studio).client.camera
    before, eye = np.array(marking.picks.picks[0].point.xyz_src), np.asarray(camera.position)
    browser.settle(page, studio)
    browser.wait_for_frames(page, 3)  # the page draws the arrows
    reach = 0.08 * float(np.linalg.norm(eye - before))
    start = browser.pixel_of(page, before + [0.7 * reach, 0.0, 0.0])
    end = browser.pixel_of(page, before + [1.7 * reach, 0.0, 0.0])
    page.mouse.move(*start)
    browser.wait_for_frames(page, 3)  # they know that the pointer is over them
    page.mouse.down()
    for share in np.linspace(0.1, 1.0, 10):
        page.mouse.move(*(np.array(start) + share * (np.array(end) - start)))
        browser.wait_for_frames(page, 1)
    page.mouse.up()
    until(lambda: not np.array_equal(marking.picks.picks[0].point.xyz_src, before))
    step = np.array(marking.picks.picks[0].point.xyz_src) - before
    np.testing.assert_allclose(step, [reach, 0.0, 0.0], atol=0.15 * reach)
    np.testing.assert_allclose(camera.position, eye, atol=1e-6)  # the picture did not turn
    # Undo takes the point back, and not what was done before.
    label = session.undo_label
    page.click("button[data-do=undo]")
    page.wait_for_selector("button[data-point='0'][data-kind=open]")
    assert session.undo_label == label
    page.keyboard.press("Escape")
    page.wait_for_selector("#dbh-banner", state="detached")


def test_a_bar_clicked_in_two_panoramas(studio: Studio, session: Session, shared_page: Any) -> None:
    page, truth, tab = shared_page, scale_plots.plot(), tab_of(studio)
    ends = truth.corners()[[0, 1]]
    page.click("button[data-way=photos]")
    page.click("button[data-start=bar]")
    for number, end in enumerate(ends):
        if number == 0:
            page.click("button[data-do=photo]")
        until(lambda: tab.photos.image is not None)
        click_in_photo(page, studio, tab, end)
        page.locator(".dbh-offers button").first.click()
        used = tab.marking.picks.current.sights[0].image
        until(lambda used=used: tab.photos.image != used)
        click_in_photo(page, studio, tab, end)
        page.wait_for_selector(f"button[data-point='{number}'][data-kind=done]")
        found = np.array(tab.marking.picks.picks[number].point.xyz_src)
        assert np.linalg.norm(found - end) * truth.metres_per_unit < 0.02
        if number == 0:
            page.click("button[data-do=next]")
            until(lambda: tab.marking.picks.chosen == 1)
    page.click("button[data-do=keep]")
    page.get_by_role("button", name="Set the scale from the known lengths").click()
    page.wait_for_selector("button[data-step=scale][data-state=done]")
    assert session.document.scale.metres_per_unit == pytest.approx(truth.metres_per_unit, rel=0.01)
    assert session.document.scale.source == "bars"
    page.click("button[data-do=undo]")
    page.wait_for_selector("button[data-step=scale][data-state=open]")
    assert not session.document.scale.is_known


def click_in_photo(page: Any, studio: Studio, tab: Any, point: np.ndarray) -> None:
    """Look at where a point is in the open photo, as a person who sees it would, and click it."""
    name = tab.photos.image
    u, v = scale_plots.plot().posed.by_name(name).project(point[None])[0][0]
    tab.worker.post(lambda: tab.photos.open(name, at_px=(float(u), float(v)), zoom_px=4.0))
    look = until(lambda: shown_look(page, tab, (float(u), float(v))))
    browser.settle(page, studio)
    (x, y), _ = (np.asarray(part)[0] for part in look.view_from_photo([[u, v]]))
    left, top, width, height = page.evaluate(_PHOTO_PIXEL)
    n_sights = len(tab.marking.picks.current.sights)
    page.mouse.click(left + x / look.width_px * width, top + y / look.height_px * height)
    until(lambda: len(tab.marking.picks.current.sights) == n_sights + 1)


def shown_look(page: Any, tab: Any, uv: tuple[float, float]) -> Any:
    """The look at the photo that the page shows, once it has turned to a pixel; a click is read in that very one."""
    number = page.evaluate("() => Number(document.querySelector('#dbh-photo .view')?.dataset.frame || 0)")
    name, look = tab.photos._frames.get(number, (None, None))
    if look is None or name != tab.photos.image:
        return None
    place, is_inside = look.view_from_photo([uv])
    middle = np.array([look.width_px, look.height_px]) / 2
    return look if is_inside[0] and np.abs(place[0] - middle).max() < 20 else None
