"""The pages that are handed in, opened from the disk in a real Chromium: nothing is fetched, a stem can be clicked."""

from __future__ import annotations

import io

import browser
import numpy as np
import plots
import pytest
from PIL import Image

from dbh_studio.app import commands
from dbh_studio.app.exports import ExportRequest, export_plot

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The report and the 3D page of a plot of five stems, and the plot."""
    folder = tmp_path_factory.mktemp("pages")
    session = plots.measured_session(folder)
    session.do(
        commands.describe_trees(session.document.trunks.ids[:1], species="oak", note="<img src=x onerror=alert(1)>")
    )
    report, scene = export_plot(session, folder / "out", ExportRequest(("report", "3d")))
    yield report, scene, session
    session.close()


def opened(chromium, path, query: str = ""):
    """The page, and the list of whatever else than itself it asked for."""
    page = browser.open_page(chromium, "about:blank", wait=False)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if path.name not in request.url else None)
    page.goto(path.as_uri() + query)
    return page, asked


def spot_of(page, stem_id):
    """Where the middle of a stem at breast height is in the window."""
    x, y, _ = page.evaluate(
        "id => { const s = JSON.parse(document.getElementById('scene-data').textContent).stems.find(s => s.id === id);"
        " return window.dbhScene.pixelOf(...s.at); }",
        stem_id,
    )
    box = page.locator("#labels").bounding_box()
    return box["x"] + x, box["y"] + y


def test_a_stem_is_clicked_in_the_3d_page(chromium, pages):
    _, scene, session = pages
    page, asked = opened(chromium, scene)
    page.wait_for_function("() => window.dbhScene && window.dbhScene.frames() > 0")
    page.click("#names")  # a label over the stem would be hit in its place, which is as well, but proves less
    stem_id = session.document.trunks.ids[2]
    page.click(f"tr[data-stem='{stem_id}']")  # goes near it, so that nothing stands before it
    assert page.evaluate("() => window.dbhScene.chosen()") == stem_id
    page.keyboard.press("Escape")
    page.focus("#labels")
    page.keyboard.press("Escape")
    page.wait_for_function("() => window.dbhScene.chosen() === 0")
    assert not page.locator("#card").is_visible()
    page.mouse.click(*spot_of(page, stem_id))
    page.wait_for_function("id => window.dbhScene.chosen() === id", arg=stem_id)
    assert page.locator("tr.chosen").get_attribute("data-stem") == str(stem_id)
    dbh_cm = session.measurement(stem_id).result.dbh_cm
    assert f"{dbh_cm:.1f} cm" in page.locator(f"#card article[data-stem='{stem_id}']").inner_text()
    assert page.locator("#card article:visible").count() == 1
    browser.wait_for_frames(page, 2)
    picture = np.asarray(Image.open(io.BytesIO(page.locator("#stage").screenshot())).convert("RGB")).reshape(-1, 3)
    # The chosen stem is drawn yellow: red and green high, blue low.
    assert ((picture[:, 0] > 180) & (picture[:, 1] > 120) & (picture[:, 2] < 110)).sum() > 200
    assert asked == [] and browser.page_errors(page) == []


def test_the_3d_page_is_turned_moved_and_zoomed(chromium, pages):
    _, scene, _ = pages
    page, _ = opened(chromium, scene)
    page.wait_for_function("() => window.dbhScene && window.dbhScene.frames() > 0")
    look = "() => { const c = window.dbhScene.camera(); return [c.turn, c.tilt, c.away, ...c.target]; }"
    box = page.locator("#labels").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def drag(button="left"):
        page.mouse.move(x, y)
        page.mouse.down(button=button)
        page.mouse.move(x + 60, y + 30, steps=4)
        page.mouse.up(button=button)
        return page.evaluate(look)

    first = page.evaluate(look)
    turned = drag()
    assert turned[0] < first[0] and turned[1] > first[1] and turned[2:] == first[2:]
    moved = drag("right")
    assert moved[:3] == turned[:3] and moved[3:] != turned[3:]
    page.mouse.wheel(0, -300)
    page.wait_for_function("away => window.dbhScene.camera().away < away", arg=moved[2])
    assert page.evaluate("() => window.dbhScene.chosen()") == 0  # no drag is a click
    page.click("#reset")
    page.wait_for_function(f"first => JSON.stringify(({look})()) === JSON.stringify(first)", arg=first)
    # Two fingers apart: nearer.
    page.evaluate("""() => {
      const area = document.getElementById('labels');
      area.setPointerCapture = () => {};
      const finger = (kind, id, x) => area.dispatchEvent(new PointerEvent(kind, {pointerId: id, pointerType: 'touch',
        clientX: x, clientY: 300, button: kind === 'pointermove' ? -1 : 0, buttons: 1, bubbles: true}));
      finger('pointerdown', 11, 300); finger('pointerdown', 12, 400); finger('pointermove', 12, 500);
      finger('pointerup', 11, 300); finger('pointerup', 12, 500);
    }""")
    assert page.evaluate("() => window.dbhScene.camera().away") == pytest.approx(first[2] / 2, rel=1e-6)
    assert browser.page_errors(page) == []


def test_without_webgl_the_page_says_so_and_its_table_works(chromium, pages):
    _, scene, session = pages
    page, _ = opened(chromium, scene, "?nogl")
    page.wait_for_function("() => window.dbhScene")
    assert "WebGL" in page.locator("#said").inner_text()
    stem_id = session.document.trunks.ids[1]
    page.click(f"tr[data-stem='{stem_id}']")
    assert page.locator(f"#card article[data-stem='{stem_id}']").is_visible()
    assert browser.page_errors(page) == []


def test_the_report_reads_without_scripts_and_runs_none(chromium, pages):
    report, _, session = pages
    context = chromium.new_context(java_script_enabled=False, viewport={"width": 900, "height": 700})
    page = context.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if report.name not in request.url else None)
    page.goto(report.as_uri())
    ids = session.document.trunks.ids
    assert page.locator("article.stem").count() == len(ids) == page.locator("#inventory tbody tr").count()
    assert page.locator("article.stem svg.dbh-section").count() == len(ids)
    assert page.locator("#stand svg.chart rect").count() > 0 and page.locator("#map circle").count() == len(ids)
    assert "<img src=x onerror=alert(1)>" in page.locator(f"#stem-{ids[0]}").inner_text()
    page.click(f"#inventory a[href='#stem-{ids[3]}']")
    assert page.url.endswith(f"#stem-{ids[3]}")
    # Nothing hangs over the edge of a narrow window but what scrolls by itself.
    assert page.locator("body").evaluate("e => e.scrollWidth") <= 900
    assert asked == []
    context.close()
