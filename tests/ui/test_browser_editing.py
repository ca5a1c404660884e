"""Correcting trunks in a real Chromium: what is drawn on the picture is what the inventory says in the end.

One page and one measured plot for the file; every test leaves the plot as it was.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import browser
import numpy as np
import plots
import pytest

from dbh_studio.app.session import Session
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1280, 720)
LONG_S = 120.0
_LOOKS_AT = """([px, py, pz, x, y, z]) => {
  const m = window.__viserMutable, camera = m.camera;
  camera.updateMatrixWorld();
  const at = new camera.position.constructor(px, py, pz), to = new camera.position.constructor(x, y, z);
  m.nodeRefFromName[''].localToWorld(at);
  m.nodeRefFromName[''].localToWorld(to).project(camera);
  return at.distanceTo(camera.position) < 0.01 && Math.abs(to.x) < 0.01 && Math.abs(to.y) < 0.01;
}"""


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    uploads = tmp_path_factory.mktemp("uploads")
    running = Studio(start_server(port=0), uploads_folder=uploads, display_points=40_000)
    running.adopt(plots.measured_session(tmp_path_factory.mktemp("plot")))
    yield running
    running.close()


@pytest.fixture(scope="module")
def shared_page(studio: Studio, chromium: Any) -> Any:
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    page.wait_for_selector(".dbh-table tr[data-id]")
    browser.close_notifications(page)
    assert studio.display is not None
    browser.wait_for_points(page, int((~studio.display.is_crown).sum()))
    return page


@pytest.fixture
def page(shared_page: Any, studio: Studio) -> Iterator[Any]:
    """The page in the Inspect step with the tools open and nothing chosen; what the test does is undone."""
    session = session_of(studio)
    before = session.document
    for tab in studio._tabs.values():
        tab.worker.post(tab.adopt_session)
        tab.worker.post(tab.editing.open)
    browser.settle(shared_page, studio)
    shared_page.wait_for_selector("#dbh-edit .chosen")
    until(lambda: words(shared_page, "chosen") == "No tree chosen")
    yield shared_page
    browser.settle(shared_page, studio)
    while session.document is not before:
        session.undo()
    browser.settle(shared_page, studio)
    errors = browser.page_errors(shared_page)
    shared_page.studio_errors.clear()
    assert errors == []


def session_of(studio: Studio) -> Session:
    assert studio.session is not None
    return studio.session


def until(condition: Callable[[], Any], timeout_s: float = LONG_S) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (answer := condition()):
        assert time.monotonic() < deadline, "did not come to pass"
        time.sleep(0.05)
    return answer


def words(page: Any, name: str) -> str:
    """What a part of the bar says."""
    return str(page.evaluate("name => document.querySelector('#dbh-edit .' + name)?.textContent || ''", name))


def wait_words(page: Any, name: str, text: str) -> None:
    page.wait_for_function(
        "([name, text]) => document.querySelector('#dbh-edit .' + name)?.textContent.includes(text)", arg=[name, text]
    )


def points_of(studio: Studio, trunk_id: int) -> np.ndarray:
    session = session_of(studio)
    return session.points_world()[session.document.trunks[trunk_id].points].astype(float)


def breast_height(studio: Studio, trunk_id: int) -> np.ndarray:
    """(3,) the middle of a stem at breast height, world."""
    stem = session_of(studio).measurement(trunk_id)
    return np.array([*stem.xy_m, stem.z_ground_m + 1.3])


def look_at(page: Any, studio: Studio, target: np.ndarray, away: tuple[float, float, float] = (0.0, -4.0, 0.4)) -> None:
    (client,) = studio.server.viser.get_clients().values()
    position = target + np.asarray(away)
    client.camera.up_direction = (0.0, 0.0, 1.0)
    client.camera.position, client.camera.look_at = position, target
    page.wait_for_function(_LOOKS_AT, arg=[float(part) for part in (*position, *target)])
    browser.settle(page, studio)


def front(studio: Studio, trunk_id: int) -> np.ndarray:
    """(3,) a point of a stem about breast height that faces south."""
    points = points_of(studio, trunk_id)
    band = points[np.abs(points[:, 2] - breast_height(studio, trunk_id)[2]) < 0.15]
    return band[band[:, 1].argmin()]


def choose_by_click(page: Any, studio: Studio, trunk_id: int) -> None:
    look_at(page, studio, front(studio, trunk_id))
    page.mouse.click(*browser.pixel_of(page, front(studio, trunk_id)))
    wait_words(page, "chosen", f"Tree {trunk_id}")


def take(page: Any, studio: Studio, tool: str, key: str) -> None:
    page.mouse.move(400, 400)
    page.keyboard.press(key)
    page.wait_for_selector(f"#dbh-edit button[data-edit=tool-{tool}][aria-pressed=true]")
    browser.settle(page, studio)


def draw(page: Any, *places: tuple[float, float]) -> None:
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=6)
    page.mouse.up()


def exported(page: Any, studio: Studio, tmp_path: Path) -> dict[int, dict[str, str]]:
    """The rows of the inventory that the page downloads, by stem."""
    browser.settle(page, studio)
    assert studio.wait_idle(LONG_S)
    page.click("button[data-step=export]")
    page.wait_for_selector("button[data-step=export][data-active=true]")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download the inventory (CSV)").click()
    saved = tmp_path / "saved.csv"
    download.value.save_as(saved)
    page.click("button[data-step=inspect]")
    page.wait_for_selector("button[data-step=inspect][data-active=true]")
    lines = [line for line in saved.read_text("utf-8-sig").splitlines() if line and not line.startswith("#")]
    table = csv.DictReader(io.StringIO("\n".join(lines)))
    return {int(row["stem_id"]): row for row in table}


def stems(rows: dict[int, dict[str, str]]) -> dict[int, str]:
    return {stem: row["dbh_cm"] for stem, row in rows.items()}


def assert_says(row: dict[str, str], result: Any) -> None:
    """The row has this diameter, or none."""
    if isinstance(result, DbhEstimate):
        assert float(row["dbh_cm"]) == pytest.approx(result.dbh_cm, abs=0.006)
    else:
        assert row["dbh_cm"] == ""


def test_two_trunks_are_merged_and_the_inventory_has_one_row_less(page: Any, studio: Studio, tmp_path: Path) -> None:
    session = session_of(studio)
    first = exported(page, studio, tmp_path)
    one, two = session.document.trunks.ids[:2]
    choose_by_click(page, studio, one)
    look_at(page, studio, front(studio, two))
    page.keyboard.down("Control")
    page.mouse.click(*browser.pixel_of(page, front(studio, two)))
    page.keyboard.up("Control")
    wait_words(page, "chosen", f"Trees {one} and {two}")
    page.keyboard.press("m")
    wait_words(page, "effect", f"Tree {two} is gone")
    rows = exported(page, studio, tmp_path)
    assert set(rows) == set(first) - {two}
    result = session.measurement(one).result
    assert_says(rows[one], result)
    assert {i: rows[i]["dbh_cm"] for i in rows if i != one} == {i: first[i]["dbh_cm"] for i in rows if i != one}


def test_a_drawn_line_cuts_a_trunk_and_both_parts_are_handed_in(page: Any, studio: Studio, tmp_path: Path) -> None:
    session = session_of(studio)
    tree = session.document.trunks.ids[0]
    choose_by_click(page, studio, tree)
    points, n_before = points_of(studio, tree), len(session.document.trunks)
    target = breast_height(studio, tree) + [0.0, 0.0, 0.9]
    look_at(page, studio, target)
    take(page, studio, "line", "5")
    x, y = browser.pixel_of(page, target)
    camera = np.array(next(iter(studio.server.viser.get_clients().values())).camera.position)
    draw(page, (x - 150, y), (x + 150, y))
    wait_words(page, "effect", "New tree")
    assert np.allclose(next(iter(studio.server.viser.get_clients().values())).camera.position, camera)
    rows = exported(page, studio, tmp_path)
    new = max(session.document.trunks.ids)
    assert len(rows) == n_before + 1 and new in rows
    upper, lower = sorted((tree, new), key=lambda i: -points_of(studio, i)[:, 2].max())
    # The line is level and drawn at the height one looks at, a little from above.
    assert points_of(studio, lower)[:, 2].max() == pytest.approx(target[2], abs=0.12)
    assert points_of(studio, upper)[:, 2].min() == pytest.approx(target[2], abs=0.12)
    assert len(points_of(studio, upper)) + len(points_of(studio, lower)) == len(points)
    assert rows[lower]["dbh_cm"]
    assert_says(rows[lower], session.measurement(lower).result)


def test_what_a_lasso_selects_is_taken_off_and_undone_to_the_start(page: Any, studio: Studio, tmp_path: Path) -> None:
    session = session_of(studio)
    tree = session.document.trunks.ids[0]
    start, first = session.document, exported(page, studio, tmp_path)
    choose_by_click(page, studio, tree)
    target = breast_height(studio, tree)
    look_at(page, studio, target)
    take(page, studio, "lasso", "3")
    rows_before, (x, y) = session.document.trunks[tree].points, browser.pixel_of(page, target)
    # All east of the middle, from the foot to well above breast height.
    draw(page, (x, y - 160), (x + 120, y - 160), (x + 120, y + 250), (x, y + 250), (x, y - 158))
    wait_words(page, "chosen", "selected")
    selected = int(words(page, "chosen").split(" ")[0].replace(",", ""))
    page.keyboard.press("Delete")
    wait_words(page, "effect", f"Tree {tree}:")
    left = session.document.trunks[tree].points
    off = session.points_world()[np.setdiff1d(rows_before, left)].astype(float)
    assert len(rows_before) - len(left) == len(off) == selected > 100
    assert off[:, 0].min() > target[0] - 0.03  # seen from the south, east is on the right
    result = session.measurement(tree).result
    rows = exported(page, studio, tmp_path)
    assert set(rows) == set(first)
    assert rows[tree] != first[tree]
    assert_says(rows[tree], result)
    page.mouse.move(400, 400)
    while session.document is not start:
        now = session.document
        page.keyboard.press("Control+z")
        until(lambda now=now: session.document is not now)
    wait_words(page, "effect", "Undone.")
    assert stems(exported(page, studio, tmp_path)) == stems(first)


def test_delete_held_down_takes_the_points_off_and_leaves_the_trunk(page: Any, studio: Studio) -> None:
    session = session_of(studio)
    tree = session.document.trunks.ids[0]
    choose_by_click(page, studio, tree)
    target = breast_height(studio, tree)
    look_at(page, studio, target)
    take(page, studio, "lasso", "3")
    x, y = browser.pixel_of(page, target)
    draw(page, (x, y - 160), (x + 120, y - 160), (x + 120, y + 250), (x, y + 250), (x, y - 158))
    wait_words(page, "chosen", "selected")
    for _ in range(3):
        page.keyboard.down("Delete")
    page.keyboard.up("Delete")
    wait_words(page, "effect", f"Tree {tree}:")
    browser.settle(page, studio)
    assert tree in session.document.trunks


def test_the_second_press_of_a_double_click_is_none_on_what_has_come_to_lie_there(page: Any, studio: Studio) -> None:
    tree = session_of(studio).document.trunks.ids[0]
    choose_by_click(page, studio, tree)
    take(page, studio, "click", "1")
    sent = page.evaluate(
        """() => {
          const kept = window.dbh, sent = [];
          window.dbh = (kind, payload) => sent.push(payload[0]);
          const press = (what, x) => document.querySelector(`#dbh-edit [data-edit=${what}]`).dispatchEvent(
            new MouseEvent('click', {detail: 1, clientX: x, clientY: 50, bubbles: true}));
          press('grow', 50);
          press('delete', 52);
          press('delete', 52);
          press('split', 200);
          press('split', 200);
          window.dbh = kept;
          return sent;
        }"""
    )
    assert sent == ["grow", "split", "split"]


def test_the_brush_follows_the_pointer_and_the_view_stays(page: Any, studio: Studio) -> None:
    session = session_of(studio)
    tree = session.document.trunks.ids[0]
    choose_by_click(page, studio, tree)
    target = breast_height(studio, tree)
    look_at(page, studio, target)
    take(page, studio, "brush", "4")
    page.keyboard.press("]")
    wait_words(page, "view", "12.5 cm")
    x, y = browser.pixel_of(page, target)
    page.mouse.move(x, y - 60)
    page.wait_for_selector("#dbh-edit-ring", state="visible")
    page.mouse.down()
    page.mouse.move(x, y + 60, steps=12)
    page.mouse.up()
    wait_words(page, "chosen", "selected")
    browser.settle(page, studio)
    chosen = next(iter(studio._tabs.values())).editing.points
    assert np.isin(chosen, session.document.trunks[tree].points).all()
    assert np.abs(session.points_world()[chosen][:, 2] - target[2]).min() < 0.1
    # The right button turns the view meanwhile; with the tool put away it moves it again.
    (client,) = studio.server.viser.get_clients().values()
    camera = np.array(client.camera.look_at), np.array(client.camera.position)
    page.mouse.move(300, 500)
    page.mouse.down(button="right")
    page.mouse.move(420, 500, steps=6)
    page.mouse.up(button="right")
    until(lambda: np.linalg.norm(client.camera.position - camera[1]) > 0.3)
    assert np.allclose(client.camera.look_at, camera[0], atol=0.01)
    page.keyboard.press("Escape")
    wait_words(page, "chosen", f"Tree {tree}")


def test_one_tree_alone_the_list_of_keys_and_the_end(page: Any, studio: Studio) -> None:
    tree = session_of(studio).document.trunks.ids[0]
    choose_by_click(page, studio, tree)
    page.mouse.move(400, 400)
    page.keyboard.press("o")
    page.wait_for_selector("#dbh-edit input[data-edit=others]:checked")
    shown = "() => window.__viserTestpoints.rendererInfo.render.points"
    page.wait_for_function("() => window.__viserTestpoints.rendererInfo.render.points < 30000")
    page.keyboard.press("u")
    page.wait_for_selector("#dbh-edit input[data-edit=slice]:checked")
    page.wait_for_function("() => window.__viserTestpoints.rendererInfo.render.points < 3000")
    assert page.evaluate(shown) > 0
    page.click("#dbh-edit button[data-edit=keys]")
    assert "Shift+Delete" in page.inner_text("#dbh-edit .keys")
    page.keyboard.press("Escape")
    page.wait_for_selector("#dbh-edit .keys", state="hidden")
    box = page.locator("#dbh-edit").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] < LAPTOP[0] - 300 and box["height"] < 220
    page.click("#dbh-edit button[data-edit=close]")
    page.wait_for_selector("#dbh-edit", state="hidden")
    page.wait_for_function("() => window.__viserTestpoints.rendererInfo.render.points > 30000")
    page.get_by_role("button", name=f"Correct tree {tree}").wait_for()
