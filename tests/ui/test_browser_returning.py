"""A connection that is cut and comes back, in a real Chromium: the page says so and has its place again."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import browser
import plots
import pytest

from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser


class Line:
    """A network between page and studio that can be cut."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self.target = 0
        self._is_cut = False
        self._ends: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                if self._is_cut:
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self.target))
                self._ends += [near, far]
                for source, target in ((near, far), (far, near)):
                    threading.Thread(target=self._pass_on, args=(source, target), daemon=True).start()

    @staticmethod
    def _pass_on(source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while content := source.recv(1 << 16):
                target.sendall(content)
            target.shutdown(socket.SHUT_WR)

    def cut(self) -> None:
        self._is_cut = True
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._ends.clear()

    def mend(self) -> None:
        self._is_cut = False

    def close(self) -> None:
        self.cut()
        with contextlib.suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join()


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
        line.cut()
        page.wait_for_selector("#dbh-lost")
        assert "All that was done is saved" in page.locator("#dbh-lost").inner_text()
        line.mend()
        page.wait_for_selector("#dbh-lost", state="detached")
        page.get_by_text("Nothing has changed meanwhile.").wait_for()
        page.wait_for_selector(f".dbh-card[data-tree='{trunk_id}']")
        browser.close_notifications(page)
        # A reload is a page that comes back, too.
        page.reload()
        page.get_by_text("Nothing has changed meanwhile.").wait_for()
        page.wait_for_selector(f".dbh-card[data-tree='{trunk_id}']")
        # What the browser says itself of a connection that was cut is no error of the page.
        assert [error for error in browser.page_errors(page) if "WebSocket" not in error and "ERR_" not in error] == []
        page.context.close()
    finally:
        studio.close()
