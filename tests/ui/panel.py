"""What a person does in the panel, for tests with a `FakeClient`."""

from __future__ import annotations

from pathlib import Path

from fakeclient import FakeClient

from dbh_studio.ui.studio import Studio

LONG = 60.0


def table_ids(tab: FakeClient) -> list[int]:
    """The trees of the table on screen, in its order."""
    return [int(row.split('"')[0]) for row in tab.html().split('<tr data-id="')[1:]]


def open_by_path(tab: FakeClient, path: Path) -> None:
    """Open a scaled cloud by its path, and go to step 3."""
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(path))
    tab.press("Open")
    tab.wait_text("Press Find trunks", LONG)
    tab.bridge_send("step", "trunks")
    tab.wait(lambda t: path.stem in t.text() and t.has("Find trunks"), LONG)


def find_trunks(tab: FakeClient, studio: Studio) -> None:
    """Press Find trunks and wait until all are measured."""
    tab.press("Find trunks")
    tab.wait_text("trunks found", LONG)
    assert studio.wait_idle(LONG)
    tab.wait(lambda t: "not measured yet" not in t.text(), LONG)


def choose(tab: FakeClient, trunk_id: int) -> None:
    """Choose a tree in the table."""
    tab.bridge_send("row", trunk_id)
    tab.wait_text(f"Tree {trunk_id}")
