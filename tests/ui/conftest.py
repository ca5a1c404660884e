"""What the tests of this folder share: their helpers (`fakeclient`, `browser`) by name, a server, a tab, a browser."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import browser
import plots
from fakeclient import FakeClient
from panel import LONG, table_ids

from dbh_studio.ui.bind import TabWorker
from dbh_studio.ui.server import StudioServer, start_server
from dbh_studio.ui.studio import Studio

_running: list[Any] = []  # the browser, once a test has asked for it


@pytest.fixture(scope="module")
def server() -> Iterator[StudioServer]:
    """A bare server: no studio in it."""
    running = start_server(port=0)
    yield running
    running.stop()


@pytest.fixture
def tab(server: StudioServer) -> Iterator[FakeClient]:
    """A page connected to it."""
    with FakeClient(server.url) as client:
        yield client


@pytest.fixture
def worker(server: StudioServer, tab: FakeClient) -> Iterator[TabWorker]:
    """That tab's worker."""
    made = TabWorker(tab.handle(server.viser))
    yield made
    made.close()


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    """An empty studio on a server of its own."""
    running = Studio(start_server(port=0), uploads_folder=tmp_path / "uploads")
    yield running
    running.close()


@pytest.fixture
def measured(studio: Studio, tmp_path: Path) -> Iterator[FakeClient]:
    """A tab of that studio, which shows a plot whose trunks are found and measured."""
    studio.adopt(plots.measured_session(tmp_path))
    with FakeClient(studio.server.url) as client:
        client.wait(table_ids, LONG)
        client.wait(lambda t: "/labels" in t.scene, LONG)
        yield client


@pytest.fixture(scope="package")
def chromium(chromium_path: str) -> Iterator[Any]:
    """One browser for all files; pages have profiles of their own."""
    with browser.chromium(chromium_path) as running:
        _running.append(running)
        yield running
        _running.clear()


@pytest.fixture(scope="module", autouse=True)
def no_page_stays_open() -> Iterator[None]:
    """A page left open goes on drawing in software, on a core of its own, until all tests of the folder are through."""
    yield
    for running in _running:
        for context in list(running.contexts):
            context.close()
