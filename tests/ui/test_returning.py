"""A page that loses its connection and comes back, several pages on one plot, and what is said when a plot opens."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import plots
import pytest
from fakeclient import FakeClient, login, until_ended
from line import Line
from panel import LONG, choose, idle, table_ids
from test_studio_mishaps import fill_disk

from dbh_studio.app import commands
from dbh_studio.io.lock import lock_file
from dbh_studio.io.project import ProjectWriter, read_project
from dbh_studio.ui.returning import Returning
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio


def lose(tab: FakeClient, studio: Studio, *, n_left: int = 0) -> None:
    """The connection is lost, and what the page left behind has been kept."""
    tab.close()
    until_n_tabs(studio, n_left)


def until_n_tabs(studio: Studio, n_tabs: int) -> None:
    deadline = time.monotonic() + LONG
    while len(studio._tabs) != n_tabs:
        assert time.monotonic() < deadline, "the tab stays"
        time.sleep(0.01)
    until_ended("page gone")


def test_a_page_that_comes_back_has_its_place_again(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    choose(measured, ids[2])
    measured.bridge_send("page", ["a page", []])
    idle(measured, studio)  # it has flown there
    measured.look((3.0, -9.0, 2.0), (1.0, 0.0, 1.0))
    idle(measured, studio)
    lose(measured, studio)
    studio.session.do(commands.delete_trunk(ids[0]))
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: table_ids(t) == ids[1:], LONG)
        tab.bridge_send("page", ["later", ["never heard of", "a page"]])
        note = tab.wait_notification("Back where you were")
        assert f"Last of all: «Delete trunk {ids[0]}»" in note.body
        tab.wait_text(f"Tree {ids[2]}")
        tab.settle()
        moved = [message for message in tab.messages if message["type"] == "SetCameraPositionMessage"]
        assert moved[-1]["position"] == pytest.approx((3.0, -9.0, 2.0))
    with FakeClient(studio.server.url) as stranger:
        stranger.wait(table_ids, LONG)
        stranger.bridge_send("page", ["another page", []])
        stranger.settle()
        assert not stranger.notifications and f"Tree {ids[2]}" not in stranger.text()


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    yield made
    made.close()


@pytest.fixture
def studio(tmp_path: Path, line: Line) -> Iterator[Studio]:
    """As that of all tests, to be reached over the line as well."""
    server = start_server(port=0, allowed_hosts=(f"127.0.0.1:{line.port}",))
    line.target = server.port
    running = Studio(server, uploads_folder=tmp_path / "uploads")
    yield running
    running.close()


def over(line: Line, studio: Studio) -> FakeClient:
    """A page that reaches the studio over the line."""
    tab = FakeClient(f"http://127.0.0.1:{line.port}/", cookie=login(studio.server.url))
    tab._port = studio.server.port  # where it finds its server
    return tab


def named(tab: FakeClient, studio: Studio, *names: str) -> None:
    """The page says its name and those it had before, and the studio has heard it."""
    tab.wait(table_ids, LONG)
    tab.bridge_send("page", [names[0], list(names[1:])])
    tab.settle()
    assert studio.lost_pages.knows(names[0])


def test_a_page_is_asked_for_its_name_before_there_is_anything_to_click(measured: FakeClient) -> None:
    """Else what a person chooses at once would give way to what the page had before."""
    kinds = [(each["type"], str(each)) for each in measured.messages]
    asked = next(k for k, (_, text) in enumerate(kinds) if "dbh('page'" in text)
    shown = next(k for k, (kind, text) in enumerate(kinds) if kind == "GuiUpdateMessage" and "<tr data-id=" in text)
    assert asked < shown


def test_a_page_is_there_again_before_its_old_tab_has_ended(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    named(measured, studio, "first")
    choose(measured, ids[2])
    with FakeClient(studio.server.url) as again:
        named(again, studio, "second", "first")
        assert again.wait_notification("Back where you were").body == "Nothing has changed meanwhile."
        again.wait_text(f"Tree {ids[2]}")
        choose(again, ids[1])
        # Now the old end is heard. It puts nothing over what the page looks at by now.
        lose(measured, studio, n_left=1)
        again.settle()
        assert len(again.notifications) == 1
        lose(again, studio)
    with FakeClient(studio.server.url) as third:
        named(third, studio, "third", "second", "first")
        third.wait_text(f"Tree {ids[1]}")


def test_a_page_whose_old_connection_is_half_open_has_its_place_and_what_was_typed(
    studio: Studio, line: Line, tmp_path: Path
) -> None:
    studio.adopt(plots.measured_session(tmp_path))
    with over(line, studio) as asleep:
        named(asleep, studio, "first")
        ids = table_ids(asleep)
        choose(asleep, ids[1])
        asleep.set("Species", "Picea abies")
        asleep.settle()
        line.hold()
        with FakeClient(studio.server.url) as awake:
            named(awake, studio, "second", "first")
            note = awake.wait_notification("Back where you were")
            assert f"«Describe trunk {ids[1]}»" in note.body
            awake.wait_text(f"Tree {ids[1]}")
            awake.wait(lambda t: t.value("Species") == "Picea abies")
            awake.set("Species", "Abies alba")
            awake.press("Keep")
            awake.wait(lambda _: studio.session.document.record(ids[1]).species == "Abies alba")
            line.cut()
            until_n_tabs(studio, 1)
            # The old input holds what was typed first; its end keeps it no second time.
            awake.settle()
            assert studio.session.document.record(ids[1]).species == "Abies alba"
            # Nobody else was here, so of nobody is told.
            assert [each.title for each in awake.notifications] == ["Back where you were"]


def test_what_others_did_while_a_connection_was_half_open_is_told(studio: Studio, line: Line, tmp_path: Path) -> None:
    studio.adopt(plots.measured_session(tmp_path))
    with over(line, studio) as asleep, FakeClient(studio.server.url) as other:
        named(asleep, studio, "first")
        ids = table_ids(asleep)
        line.hold()
        other.wait(table_ids, LONG)
        choose(other, ids[0])
        other.press("Delete this trunk")
        other.wait(lambda _: ids[0] not in studio.session.document.trunks)
        other.settle()
        with FakeClient(studio.server.url) as awake:
            named(awake, studio, "second", "first")
            note = awake.wait_notification("Back where you were")
            assert f"Last of all: «Delete trunk {ids[0]}»" in note.body
            line.cut()


def test_the_copy_of_a_page_begins_where_it_is_and_leaves_it_alone(measured: FakeClient, studio: Studio) -> None:
    """A browser that duplicates a tab hands the names on to the copy."""
    ids = table_ids(measured)
    named(measured, studio, "first")
    choose(measured, ids[2])
    measured.set("Species", "Picea")
    with FakeClient(studio.server.url) as copy:
        named(copy, studio, "copy", "first")
        copy.wait_text(f"Tree {ids[2]}")
        choose(copy, ids[0])
        measured.settle()
        assert f"Tree {ids[2]}" in measured.text() and measured.value("Species") == "Picea"
        assert not measured.notifications
        # The first goes on typing, and is loaded anew: it is where it was, not where its copy went.
        measured.set("Species", "Picea abies")
        measured.settle()
        lose(measured, studio, n_left=1)
        assert studio.session.document.record(ids[2]).species == "Picea abies"
        with FakeClient(studio.server.url) as again:
            named(again, studio, "again", "first")
            again.wait_text(f"Tree {ids[2]}")


def test_a_place_that_was_on_its_way_when_the_connection_was_lost_again_is_kept(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = table_ids(measured)
    named(measured, studio, "first")
    choose(measured, ids[2])
    lose(measured, studio)
    with monkeypatch.context() as patch, FakeClient(studio.server.url) as second:
        is_lost = threading.Event()
        patch.setattr(Returning, "_give_back", lambda self, place: is_lost.wait(LONG))
        second.wait(table_ids, LONG)
        second.bridge_send("page", ["second", ["first"]])
        second.wait(lambda _: studio.lost_pages.knows("second"))
        lose(second, studio)
        is_lost.set()
    with FakeClient(studio.server.url) as third:
        named(third, studio, "third", "second", "first")
        third.wait_text(f"Tree {ids[2]}")


def test_a_place_in_a_plot_that_is_open_no_more_is_forgotten(
    measured: FakeClient, studio: Studio, tmp_path: Path
) -> None:
    measured.bridge_send("page", ["a page", []])
    idle(measured, studio)
    lose(measured, studio)
    (tmp_path / "other").mkdir()
    studio.adopt(plots.measured_session(tmp_path / "other"))
    assert not studio.lost_pages.knows("a page")  # it would keep the cloud of the first plot in memory


@pytest.mark.parametrize(
    "payload",
    [
        *(None, [], {"a": 1}, ["a", "b", "c"], ["a", "b"], ["a", True]),
        *(["", []], [3, []], ["x" * 65, []], ["a", [3]], ["a", [""]], ["a", ["x" * 65]], ["a", ["b"] * 10]),
    ],
)
def test_a_name_of_a_page_that_makes_no_sense_does_nothing(
    measured: FakeClient, studio: Studio, payload: object
) -> None:
    measured.bridge_send("page", payload)
    measured.settle()
    (tab,) = studio._tabs.values()
    assert not measured.notifications and tab.returning._page == ""


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
        # It has a past, which cannot be gone back to here.
        assert studio.session.can_undo
        assert re.search(r'data-do="undo" title="The plot is open for reading only[^>]* disabled>', tab.html())
        # What is typed is not lost in silence.
        tab.set("Note", "a fork")
        choose(tab, table_ids(tab)[1])
        tab.wait_notification("What was typed about the tree was not kept")
        tab.bridge_send("step", "open")
        tab.wait(lambda t: t.has("Save a copy") and t.value("Save in").endswith("plot.dbh"))
        tab.set("Save in", str(tmp_path / "elsewhere" / "copy"))
        tab.press("Save a copy")
        tab.wait_text("saved in copy.dbh", LONG)
        tab.wait(lambda t: re.search(r'data-do="undo" title="Undo: [^>]*"\)?[^>]*>', t.html()))
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
