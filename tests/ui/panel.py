"""What a person does in the panel, for tests with a `FakeClient`."""

from __future__ import annotations

import threading
from pathlib import Path

from fakeclient import FakeClient, until_ended

from dbh_studio.ui.studio import Studio

LONG = 120.0


def table_ids(tab: FakeClient) -> list[int]:
    """The trees of the table on screen, in its order."""
    return [int(row.split('"')[0]) for row in tab.html().split('<tr data-id="')[1:]]


def open_by_path(tab: FakeClient, path: Path) -> None:
    """Open a scaled cloud by its path, and go to step 3."""
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(path))
    tab.press("Open")
    tab.wait_text("Press Find trunks", LONG)
    tab.settle()  # the header speaks of the plot a moment before the step is chosen
    tab.bridge_send("step", "trunks")
    tab.wait(lambda t: path.stem in t.text() and t.has("Find trunks"), LONG)


def find_trunks(tab: FakeClient, studio: Studio) -> None:
    """Press Find trunks and wait until all are measured."""
    tab.press("Find trunks")
    tab.wait_text("trunks found", LONG)
    tab.wait(lambda t: table_ids(t) and "not measured yet" not in t.text(), LONG)
    idle(tab, studio)


def idle(tab: FakeClient, studio: Studio) -> None:
    """Wait until no work is left, neither in a child process nor in the tab, and the page shows what came of it."""
    tab.delivered()
    is_idle = False
    while not is_idle:  # what ends may start the next
        until_ended("job", "open", "work")
        assert studio.wait_idle(LONG)
        is_idle = not any(thread.name in ("job", "open", "work") for thread in threading.enumerate())
    tab.settle()


def choose(tab: FakeClient, trunk_id: int) -> None:
    """Choose a tree in the table."""
    tab.bridge_send("row", trunk_id)
    tab.wait_text(f"Tree {trunk_id}")
