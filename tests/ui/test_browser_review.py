"""The last hour with a plot in a real Chromium: keys, gestures in the section, and all of it after a reload."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import browser
import plots
import pytest

from dbh_studio.app import commands
from dbh_studio.core.corrections import Correction
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1280, 720)


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    folder = tmp_path_factory.mktemp("plot")
    running = Studio(start_server(port=0), uploads_folder=folder / "uploads", display_points=40_000)
    running.adopt(plots.measured_session(folder))
    yield running
    running.close()


@pytest.fixture(scope="module")
def shared_page(studio: Studio, chromium: Any) -> Any:
    opened = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    opened.wait_for_selector(".dbh-table tr[data-id]")
    browser.close_notifications(opened)
    return opened


@pytest.fixture
def page(studio: Studio, shared_page: Any) -> Iterator[Any]:
    """The page, none of the trees chosen; it must not complain, and what a test does to the plot is undone."""
    assert studio.session is not None
    before = studio.session.document
    for tab in studio._tabs.values():
        tab.worker.post(tab.adopt_session)
    shared_page.get_by_text("No tree is chosen.").wait_for()
    browser.settle(shared_page, studio)
    yield shared_page
    errors = browser.page_errors(shared_page)
    shared_page.studio_errors.clear()
    assert errors == []
    browser.settle(shared_page, studio)
    while studio.session.document is not before:
        studio.session.undo()


def rows(page: Any) -> list[int]:
    return [int(i) for i in page.eval_on_selector_all(".dbh-trees tr[data-id]", "all => all.map(r => r.dataset.id)")]


def press(page: Any, studio: Studio, key: str) -> None:
    page.keyboard.press(key)
    browser.settle(page, studio)


def field(page: Any, label: str) -> Any:
    """An input of the panel by the label in front of it."""
    return page.locator(
        f"//label[normalize-space()='{label}']/ancestor::div[contains(@class,'mantine-Flex-root')][1]//input"
    ).first


def until(condition: Callable[[], Any]) -> None:
    """Wait until the server has what was typed: the page sends the inputs of its panel a moment later."""
    deadline = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline, "did not come to pass"
        time.sleep(0.05)


def in_section(page: Any, u: float, v: float) -> tuple[float, float]:
    """Where a place of the section, metres, is on the page."""
    x, y = page.evaluate(
        """([u, v]) => {
          const svg = document.querySelector('.dbh-section'), [cu, cv, half] = svg.dataset.frame.split(' ').map(Number);
          const point = new DOMPoint(170 * (1 + (u - cu) / half), 170 * (1 - (v - cv) / half));
          const at = point.matrixTransform(svg.getScreenCTM());
          return [at.x, at.y];
        }""",
        [u, v],
    )
    return float(x), float(y)


def test_three_trees_are_looked_through_one_corrected_two_named_and_a_reload_keeps_it(
    page: Any, studio: Studio
) -> None:
    session = studio.session
    assert session is not None
    ids = rows(page)
    # Three trees, by Space alone; a button that was just clicked does not get the key.
    page.click(f".dbh-trees tr[data-id='{ids[0]}']")
    page.wait_for_selector(f".dbh-card[data-tree='{ids[0]}']")
    page.click("button[data-filter=open]")
    browser.settle(page, studio)
    for _ in range(3):
        press(page, studio, "Space")
    page.get_by_text(f"3 of {len(ids)} reviewed").first.wait_for()
    page.click("button[data-filter=all]")
    assert [i for i in ids if session.document.record(i).review] == ids[:3]
    page.wait_for_selector(f".dbh-trees tr[data-id='{ids[0]}'][data-review=accepted]")

    # Breast height of the first: its decision goes stale, and the card says from what to what.
    page.click(f".dbh-trees tr[data-id='{ids[0]}']")
    page.wait_for_selector(f".dbh-card[data-tree='{ids[0]}']")
    was = session.measurement(ids[0]).result
    assert isinstance(was, DbhEstimate)
    browser.unfold(page, "Correct this measurement")
    correction = next(iter(studio._tabs.values())).inspect.correction
    field(page, "Why").fill("whorl")
    until(lambda: correction._why.value == "whorl")
    field(page, "Height (m)").fill("2.5")
    until(lambda: correction._height.value == 2.5)
    page.get_by_role("button", name="Measure at this height").click()
    page.wait_for_selector("[data-correction=breast_height]")
    browser.settle(page, studio)
    now = session.measurement(ids[0]).result
    assert isinstance(now, DbhEstimate) and now.hom_m == pytest.approx(2.5, abs=0.02)
    assert f"{was.dbh_cm:.1f} → {now.dbh_cm:.1f} cm" in page.inner_text("[data-moved]")
    page.wait_for_selector(f".dbh-trees tr[data-id='{ids[0]}'][data-review=stale]")

    # A tape value of the second. Space and L are letters while one types.
    page.click(f".dbh-trees tr[data-id='{ids[1]}']")
    page.wait_for_selector(f".dbh-card[data-tree='{ids[1]}']")
    field(page, "Why").press_sequentially("l l")
    until(lambda: correction._why.value == "l l")
    field(page, "Tape").fill("12.4 in")
    until(lambda: correction._tape.value == "12.4 in")
    page.get_by_role("button", name="Keep the tape value").click()
    page.wait_for_selector("[data-correction=tape]")
    assert session.document.record(ids[1]).correction("tape") == pytest.approx(31.496)
    assert session.document.record(ids[1]).corrections[0].why == "l l"

    # Species of two trees at once, chosen from what is offered.
    page.click(f".dbh-trees tr[data-id='{ids[3]}']")
    page.wait_for_selector(f".dbh-card[data-tree='{ids[3]}']")
    page.click(f".dbh-trees tr[data-id='{ids[4]}']", modifiers=["Control"])
    browser.unfold(page, "About this tree")
    page.wait_for_selector("[data-several='2']")
    field(page, "Species").press_sequentially("fausy", delay=40)
    page.click("button[data-offer='Fagus sylvatica']")
    page.wait_for_selector("[data-known]")
    page.get_by_role("button", name="Keep", exact=True).click()
    browser.settle(page, studio)
    assert [session.document.record(i).species for i in ids[3:5]] == ["Fagus sylvatica"] * 2

    # A reload is a new tab: everything is there.
    page.reload()
    page.wait_for_selector(".dbh-trees tr[data-id]")
    page.wait_for_selector(f".dbh-trees tr[data-id='{ids[0]}'][data-review=stale]")
    assert page.inner_text(f".dbh-trees tr[data-id='{ids[1]}'] td[data-column=tape]") == "31.5"
    for i in ids[3:5]:
        assert "Fagus sylvatica" in page.inner_text(f".dbh-trees tr[data-id='{i}'] td[data-column=remark]")
    page.get_by_text(f"2 of {len(ids)} reviewed").first.wait_for()
    page.click(f".dbh-trees tr[data-id='{ids[0]}']")
    page.wait_for_selector("[data-correction=breast_height]")
    assert "whorl" in page.inner_text("[data-correction=breast_height]")


def test_points_are_drawn_round_and_a_ring_is_clicked_in_the_section(page: Any, studio: Studio) -> None:
    session = studio.session
    assert session is not None
    trunk_id = rows(page)[0]
    page.click(f".dbh-trees tr[data-id='{trunk_id}']")
    page.wait_for_selector(".dbh-section")
    browser.settle(page, studio)
    result = session.measurement(trunk_id).result
    assert isinstance(result, DbhEstimate)
    radius = 0.005 * result.dbh_cm

    page.click("button[data-draw=out]")
    assert "leave out" in page.inner_text(".dbh-cut-hint")
    corners = [(0.3, -1.2), (1.3, -1.2), (1.3, 1.2), (0.3, 1.2)]
    page.mouse.move(*in_section(page, *(radius * c for c in corners[0])))
    page.mouse.down()
    for corner in corners[1:]:
        page.mouse.move(*in_section(page, *(radius * c for c in corner)), steps=8)
    page.mouse.up()
    page.wait_for_selector("[data-correction=left_out]")
    browser.settle(page, studio)
    after = session.measurement(trunk_id).result
    assert after.section is not None and after.section.coverage_deg < result.section.coverage_deg - 60
    page.click("button[data-withdraw=left_out]")
    page.wait_for_selector("[data-correction=left_out]", state="detached")
    browser.settle(page, studio)

    # Esc puts the tool away, and nothing is decided.
    page.click("button[data-draw=ring]")
    page.wait_for_selector("button[data-draw=ring][aria-pressed=true]")
    page.keyboard.press("Escape")
    page.wait_for_selector("button[data-draw=ring][aria-pressed=false]")
    page.click("button[data-draw=ring]")
    ring = [(1.15, 0.0), (0.8, 0.8), (0.0, 1.15), (-0.8, 0.8), (-1.15, 0.0), (-0.8, -0.8), (0.0, -1.15), (0.8, -0.8)]
    for corner in ring:
        page.mouse.click(*in_section(page, *(radius * c for c in corner)))
    page.keyboard.press("Enter")
    page.wait_for_selector("[data-correction=ring]")
    browser.settle(page, studio)
    drawn = session.measurement(trunk_id).result
    assert isinstance(drawn, DbhEstimate)
    assert drawn.dbh_cm == pytest.approx(1.12 * result.dbh_cm, rel=0.04)
    assert not any(record.review for record in session.document.trees.values())


def test_breast_height_is_dragged_in_the_profile(page: Any, studio: Studio) -> None:
    session = studio.session
    assert session is not None
    trunk_id = rows(page)[0]
    page.click(f".dbh-trees tr[data-id='{trunk_id}']")
    page.click("button[data-do=compare]")
    grip = page.locator("[data-height-grip] circle")
    grip.wait_for()
    browser.settle(page, studio)
    grip.scroll_into_view_if_needed()
    box = grip.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 40, y, steps=6)
    page.mouse.up()
    page.wait_for_selector("[data-correction=breast_height]")
    browser.settle(page, studio)
    height = session.document.record(trunk_id).correction("breast_height")
    assert 1.5 < height < 4.0
    assert session.measurement(trunk_id).result.hom_m == pytest.approx(height, abs=0.02)


def test_a_refused_tree_is_given_a_number_from_its_card(page: Any, studio: Studio) -> None:
    session = studio.session
    assert session is not None
    trunk_id = rows(page)[1]
    session.do(commands.correct_measurement(trunk_id, Correction("breast_height", 19.5)))
    page.click(f".dbh-trees tr[data-id='{trunk_id}']")
    page.fill(".dbh-tape input", "33,5")
    page.press(".dbh-tape input", "Enter")
    page.wait_for_selector("[data-correction=tape]")
    page.click("button[data-do=look-along]")
    page.locator(".dbh-remedies button[data-height]").first.click()
    page.wait_for_selector(f".dbh-card[data-tree='{trunk_id}'][data-dbh]")
    browser.settle(page, studio)
    assert session.document.record(trunk_id).correction("tape") == 33.5
    assert isinstance(session.measurement(trunk_id).result, DbhEstimate)


def test_what_is_typed_in_a_card_outlives_its_redrawing(page: Any, studio: Studio) -> None:
    session = studio.session
    assert session is not None
    trunk_id = rows(page)[1]
    session.do(commands.correct_measurement(trunk_id, Correction("breast_height", 19.5)))
    page.click(f".dbh-trees tr[data-id='{trunk_id}']")
    page.wait_for_selector(".dbh-tape input")
    browser.settle(page, studio)
    page.locator(".dbh-tape input").press_sequentially("33")
    page.evaluate("window.oldField = document.querySelector('.dbh-tape input')")
    session.do(commands.correct_measurement(trunk_id, Correction("breast_height", 19.6)))
    page.wait_for_function("!window.oldField.isConnected && document.querySelector('.dbh-tape input')")
    browser.settle(page, studio)
    page.keyboard.type(".5")  # as one who has noticed nothing
    assert page.input_value(".dbh-tape input") == "33.5"
    page.keyboard.press("Enter")
    page.wait_for_selector("[data-correction=tape]")
    page.wait_for_function("document.querySelector('.dbh-tape input').value === ''")
    assert session.document.record(trunk_id).correction("tape") == 33.5


def test_one_press_of_space_is_one_decision_and_none_is_made_while_one_draws(page: Any, studio: Studio) -> None:
    session = studio.session
    assert session is not None
    ids = rows(page)

    def reviewed() -> list[int]:
        return [i for i in ids if session.document.record(i).review]

    page.click(f".dbh-trees tr[data-id='{ids[0]}']")
    page.wait_for_selector(f".dbh-card[data-tree='{ids[0]}'] .dbh-section")
    browser.settle(page, studio)
    for _ in range(4):  # a key that is held down repeats itself
        page.keyboard.down("Space")
    page.keyboard.up("Space")
    browser.settle(page, studio)
    assert reviewed() == ids[:1]

    # Too little was drawn: the tool stays in hand and says what is missing.
    page.click(f".dbh-trees tr[data-id='{ids[1]}']")
    page.wait_for_selector(f".dbh-card[data-tree='{ids[1]}'] .dbh-section")
    browser.settle(page, studio)
    page.click("button[data-draw=out]")
    page.mouse.click(*in_section(page, 0.0, 0.0))
    page.get_by_text("Hold the button down while you draw.").wait_for()
    page.wait_for_selector("button[data-draw=out][aria-pressed=true]")
    page.click("button[data-draw=ring]")
    for corner in [(0.15, 0.0), (0.0, 0.15), (-0.15, 0.0), (0.0, -0.15), (0.1, -0.1)]:
        page.mouse.click(*in_section(page, *corner))
    undo_label = session.undo_label
    press(page, studio, "Control+z")
    press(page, studio, "Backspace")
    assert page.locator("[data-drawn=ring] circle").count() == 3 and session.undo_label == undo_label
    press(page, studio, "Enter")
    page.get_by_text("Four corners or more make a ring.").wait_for()
    press(page, studio, "Space")
    page.get_by_text("Press Enter to close the ring first.").wait_for()
    assert reviewed() == ids[:1]
    page.mouse.click(*in_section(page, 0.0, -0.15))
    page.keyboard.press("Enter")
    page.wait_for_selector("[data-correction=ring]")
    press(page, studio, "Space")
    assert reviewed() == ids[:2]
