"""A connection that is cut and comes back, in a real Chromium: the page says so and has its place again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import browser
import plots
import pytest
from line import Line

from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    yield made
    made.close()


def test_a_page_whose_connection_is_cut_says_so_and_has_its_place_again(
    chromium: Any, line: Line, tmp_path: Path
) -> None:
    server = start_server(port=0, allowed_hosts=(f"127.0.0.1:{line.port}",))
    line.target = server.port
    studio = Studio(server, uploads_folder=tmp_path / "uploads")
    try:
        studio.adopt(plots.measured_session(tmp_path))
        trunk_id = studio.session.document.trunks.ids[1]
        page = browser.open_page(chromium, server.url.replace(f":{server.port}", f":{line.port}") + "&fixedDpr=1")
        page.locator(f"tr[data-id='{trunk_id}']").click()
        page.wait_for_selector(f".dbh-card[data-tree='{trunk_id}']")
        page.wait_for_function("() => Boolean(window.dbhWatch)")
        browser.settle(page, studio)  # the studio knows the page's name
        line.cut()
        page.wait_for_selector("#dbh-lost")
        assert "All that was done is saved" in page.locator("#dbh-lost").inner_text()
        line.mend()
        page.wait_for_selector("#dbh-lost", state="detached")
        browser.wait_for_note(page, "Nothing has changed meanwhile.")
        page.wait_for_selector(f".dbh-card[data-tree='{trunk_id}']")
        # A reload is a page that comes back, too.
        page.reload()
        browser.wait_for_note(page, "Nothing has changed meanwhile.")
        page.wait_for_selector(f".dbh-card[data-tree='{trunk_id}']")
        # What the browser says itself of a connection that was cut is no error of the page.
        assert [error for error in browser.page_errors(page) if "WebSocket" not in error and "ERR_" not in error] == []
        page.context.close()
    finally:
        studio.close()
