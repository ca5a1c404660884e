"""A page that loses its connection and comes back, several pages on one plot, and what is said when a plot opens."""

from __future__ import annotations

import time
from pathlib import Path
from typing import IO

import plots
import pytest
from fakeclient import FakeClient, until_ended
from panel import LONG, choose, idle, table_ids
from test_studio_mishaps import fill_disk

from dbh_studio.app import commands
from dbh_studio.io.lock import lock_file
from dbh_studio.io.project import ProjectWriter, read_project
from dbh_studio.ui.studio import Studio


def lose(tab: FakeClient, studio: Studio) -> None:
    """The connection is lost, and what the page left behind has been kept."""
    tab.close()
    deadline = time.monotonic() + LONG
    while studio._tabs:
        assert time.monotonic() < deadline, "the tab stays"
        time.sleep(0.01)
    until_ended("page gone")


def test_a_page_that_comes_back_has_its_place_again(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    choose(measured, ids[2])
    measured.bridge_send("page", ["a page", False])
    idle(measured, studio)  # it has flown there
    measured.look((3.0, -9.0, 2.0), (1.0, 0.0, 1.0))
    idle(measured, studio)
    lose(measured, studio)
    studio.session.do(commands.delete_trunk(ids[0]))
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: table_ids(t) == ids[1:], LONG)
        tab.bridge_send("page", ["a page", True])
        note = tab.wait_notification("Connected again")
        assert f"Last of all: «Delete trunk {ids[0]}»" in note.body
        tab.wait_text(f"Tree {ids[2]}")
        tab.settle()
        moved = [message for message in tab.messages if message["type"] == "SetCameraPositionMessage"]
        assert moved[-1]["position"] == pytest.approx((3.0, -9.0, 2.0))
    with FakeClient(studio.server.url) as stranger:
        stranger.wait(table_ids, LONG)
        stranger.bridge_send("page", ["another page", False])
        stranger.settle()
        assert not stranger.notifications and f"Tree {ids[2]}" not in stranger.text()


def test_a_place_in_a_plot_that_is_open_no_more_is_forgotten(
    measured: FakeClient, studio: Studio, tmp_path: Path
) -> None:
    measured.bridge_send("page", ["a page", False])
    idle(measured, studio)
    lose(measured, studio)
    (tmp_path / "other").mkdir()
    studio.adopt(plots.measured_session(tmp_path / "other"))
    assert studio.lost_pages.take("a page") is None  # it would keep the cloud of the first plot in memory


@pytest.mark.parametrize("payload", [None, [], ["", True], [3, True], ["x" * 65, True], ["a", "b", "c"], {"a": 1}])
def test_a_name_of_a_page_that_makes_no_sense_does_nothing(measured: FakeClient, payload: object) -> None:
    measured.bridge_send("page", payload)
    measured.settle()
    assert not measured.notifications


def test_what_was_typed_about_a_tree_is_kept_when_the_connection_is_lost(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.set("Species", "Picea abies")
    measured.settle()
    lose(measured, studio)
    assert studio.session.document.record(trunk_id).species == "Picea abies"
    assert studio.session.undo_label == f"Describe trunk {trunk_id}"


def test_what_was_typed_about_a_tree_is_kept_when_the_studio_ends(
    measured: FakeClient, studio: Studio, tmp_path: Path
) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.set("Species", "Picea abies")
    measured.settle()
    studio.close()
    assert read_project(tmp_path / "plot.dbh").trees[trunk_id].species == "Picea abies"


def test_what_is_done_in_one_tab_is_told_in_the_other(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    with FakeClient(studio.server.url) as other:
        other.wait(table_ids, LONG)
        studio.session.do(commands.delete_trunk(ids[0]))  # by no tab: told nowhere
        other.wait(lambda t: table_ids(t) == ids[1:])
        other.command("Undo")
        assert measured.wait_notification("In another tab").body == f"Undo: Delete trunk {ids[0]}."
        other.settle()
        measured.settle()
        assert len(measured.notifications) == 1 and not other.notifications


def test_that_all_is_saved_again_is_told_without_another_edit(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = studio.session
    session.saver._retry_s = 0.05
    with monkeypatch.context() as patch:
        fill_disk(session, patch)
        session.do(commands.delete_trunk(table_ids(measured)[0]))
        measured.wait_text("NOT SAVED")
    measured.wait_notification("All that was done is saved again")
    measured.wait(lambda t: "NOT SAVED" not in t.text())
    folder = session.saver.folder
    assert read_project(folder).trunks.ids == session.document.trunks.ids


def test_a_plot_that_another_program_writes_is_opened_for_reading_and_says_by_whom(
    studio: Studio, tmp_path: Path
) -> None:
    plots.measured_session(tmp_path).close()
    writer = ProjectWriter(tmp_path / "plot.dbh")
    try:
        with FakeClient(studio.server.url) as tab:
            tab.wait_text("Open a point cloud")
            tab.set("File or folder", str(tmp_path / "plot.dbh"))
            tab.press("Open")
            tab.wait_notification("being written by process", LONG)
            tab.wait_text("open for reading only, plot.dbh is being written by process")
            assert studio.session.is_read_only
    finally:
        writer.close()


def test_a_plot_that_cannot_be_written_is_opened_and_goes_on_in_a_copy(
    studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plots.measured_session(tmp_path).close()
    folder = tmp_path / "plot.dbh"

    def lock(path: Path) -> IO[str]:
        if path.parent == folder:
            raise PermissionError(13, "Permission denied")
        return lock_file(path)

    monkeypatch.setattr("dbh_studio.io.project.lock_file", lock)
    with FakeClient(studio.server.url) as tab:
        tab.wait_text("Open a point cloud")
        assert not tab.has("Save a copy")
        tab.set("File or folder", str(folder))
        tab.press("Open")
        assert "“Save a copy”" in tab.wait_notification("plot was opened", LONG).body
        tab.wait_text("open for reading only, its folder cannot be written")
        idle(tab, studio)
        trunk_id = table_ids(tab)[0]
        choose(tab, trunk_id)
        # What is typed is not lost in silence.
        tab.set("Note", "a fork")
        choose(tab, table_ids(tab)[1])
        tab.wait_notification("What was typed about the tree was not kept")
        tab.bridge_send("step", "open")
        tab.wait(lambda t: t.has("Save a copy") and t.value("Save in").endswith("plot.dbh"))
        tab.set("Save in", str(tmp_path / "elsewhere" / "copy"))
        tab.press("Save a copy")
        tab.wait_text("saved in copy.dbh", LONG)
        tab.wait(lambda t: not t.has("Save a copy"))
        studio.session.do(commands.delete_trunk(trunk_id))
        studio.session.flush()
    assert trunk_id not in read_project(tmp_path / "elsewhere" / "copy.dbh").trunks
    assert trunk_id in read_project(folder).trunks


def test_how_a_plot_was_found_is_told_once_and_stays_in_the_first_step(studio: Studio, tmp_path: Path) -> None:
    session = plots.measured_session(tmp_path)
    session.close()
    (tmp_path / "plot.dbh" / "undo.log").unlink()
    with FakeClient(studio.server.url) as tab:
        tab.wait_text("Open a point cloud")
        tab.set("File or folder", str(tmp_path / "plot.dbh"))
        tab.press("Open")
        assert "cannot be undone any more" in tab.wait_notification("plot was opened", LONG).body
        idle(tab, studio)
        tab.bridge_send("step", "open")
        tab.wait_text("cannot be undone any more")
    with FakeClient(studio.server.url) as later:
        later.wait(table_ids, LONG)
        later.settle()
        assert not later.notifications
