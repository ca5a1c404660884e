"""The steps of the search in a real Chromium: legend, list and advice are pressed as a person presses them."""

from __future__ import annotations

import browser
import plots
import pytest

from dbh_studio.app import commands
from dbh_studio.app.opening import open_plot
from dbh_studio.app.pipeline import apply_segmentation, segment_plot, segmentation_call
from dbh_studio.core.chain_steps import Step

pytestmark = pytest.mark.browser


def test_from_the_legend_to_the_setting_that_brings_a_tree_back(studio, chromium, tmp_path):
    session = open_plot(plots.write_laz(tmp_path), project_dir=tmp_path / "plot.dbh")
    session.do(commands.change_settings("trunks", small_clusters="otsu"))
    apply_segmentation(session, session.document, segment_plot(*segmentation_call(session, session.document)))
    steps = session.last_search.steps
    studio.adopt(session)
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=(1366, 768))
    page.wait_for_selector(".dbh-steps")
    browser.close_notifications(page)
    page.click("button[data-step=trunks]")
    page.click("#dbh-view button[data-mode=Steps]")
    dropped = page.locator(f"#dbh-chain button[data-chain-step='{int(Step.DROPPED)}']")
    dropped.wait_for()
    assert f"{steps.counts[Step.DROPPED]:,}" in dropped.inner_text()
    dropped.click()
    page.wait_for_selector("#dbh-chain button[data-chain-step='5'][aria-pressed=false]")
    dropped.click()
    page.wait_for_selector("#dbh-chain button[data-chain-step='5'][aria-pressed=true]")
    # Neither the bar nor the legend lies over the other, and both are in the window.
    legend, bar = (page.locator(name).bounding_box() for name in ("#dbh-chain", "#dbh-view"))
    assert legend["y"] >= 0 and legend["y"] + legend["height"] <= bar["y"]
    browser.unfold(page, "Where trees were lost")
    page.locator("[data-go]").first.click()
    page.wait_for_selector(".dbh-story")
    page.locator(".dbh-story [data-try]").first.click()
    page.get_by_text("Find the trunks again to try it").wait_for()
    # Nothing in the panel is wider than the panel.
    for part in (".dbh-story", ".dbh-sizes", ".dbh-chain-table", ".dbh-lost"):
        assert page.locator(part).first.evaluate("e => e.scrollWidth <= e.clientWidth + 1"), part
    page.click("#dbh-view button[data-mode=Original]")
    page.wait_for_selector("#dbh-chain", state="detached")
    assert browser.page_errors(page) == []
    page.context.close()
