"""What goes wrong in a day's work: impatience, a second tab, a full disk, a file that is open already."""

from __future__ import annotations

import errno
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, choose, find_trunks, idle, table_ids

from dbh_studio.app import commands
from dbh_studio.app.opening import open_plot
from dbh_studio.app.session import Session
from dbh_studio.errors import ProjectError, StudioError
from dbh_studio.io.project import read_project
from dbh_studio.ui.studio import Studio, project_dir_for
from dbh_studio.ui.studio_jobs import RunningJob
from dbh_studio.ui.tab import Tab
from dbh_studio.ui.uploads import safe_name


@pytest.fixture
def tab(studio: Studio) -> Iterator[FakeClient]:
    with FakeClient(studio.server.url) as client:
        yield client


class Standstill:
    """Keeps the one tab of a studio busy until it is let go."""

    def __init__(self, studio: Studio) -> None:
        self._go, started = threading.Event(), threading.Event()
        (tab,) = studio._tabs.values()
        tab.worker.post(lambda: (started.set(), self._go.wait(LONG)))
        assert started.wait(LONG)

    def end(self) -> None:
        self._go.set()


def nothing_told(tab: FakeClient) -> bool:
    tab.settle()
    return not tab.notifications


# -- jobs -----------------------------------------------------------------------------------------------------------


def test_what_is_measured_when_a_saved_plot_opens_has_a_bar_and_can_be_cancelled(
    tab: FakeClient, studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plots.measured_session(tmp_path).close()
    monkeypatch.setattr("dbh_studio.app.pipeline.ground_of", plots.endless_ground)
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(tmp_path / "plot.dbh"))
    tab.press("Open")
    tab.wait_text("Fitting the ground", LONG)
    tab.wait(lambda t: any("Looking behind tree 9" in script for script in t.javascript), LONG)
    assert "Fitting the ground" in tab.text()
    tab.bridge_send("cancel")
    tab.wait_notification("Fitting the ground: nothing was changed", LONG)
    assert studio.wait_idle(LONG)


def test_cancel_does_not_wait_for_a_tab_that_is_busy(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dbh_studio.app.pipeline.segment_plot", plots.endless_search)
    studio.find_trunks()
    standstill = Standstill(studio)
    try:
        measured.bridge_send("cancel")
        measured.wait(lambda _: studio._job is None, LONG / 2)  # before it ends by itself
    finally:
        standstill.end()


def test_another_plot_ends_the_job_of_the_one_before(
    measured: FakeClient, studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dbh_studio.app.pipeline.segment_plot", plots.endless_search)
    studio.find_trunks()
    measured.wait_text("Finding trunks")
    (tmp_path / "other").mkdir()
    studio.adopt(plots.measured_session(tmp_path / "other"))
    assert studio.wait_idle(LONG)
    measured.wait(lambda t: "Finding trunks" not in t.text())


def test_a_search_that_was_cancelled_leaves_no_tree_unmeasured(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What changed while it ran could not be measured at the same time."""
    assert studio.session is not None
    with monkeypatch.context() as patch:
        patch.setattr("dbh_studio.app.pipeline.segment_plot", plots.endless_search)
        studio.find_trunks()
        studio.session.do(commands.change_settings("measure", curve="ellipse"))
        assert studio.session.unmeasured()
        measured.bridge_send("cancel")
        measured.wait_notification("Finding trunks: nothing was changed", LONG)
    measured.wait(lambda _: studio.session and not studio.session.unmeasured(), LONG)


def test_an_upload_that_comes_at_the_wrong_moment_need_not_be_sent_again(
    tab: FakeClient, studio: Studio, tmp_path: Path
) -> None:
    content = plots.write_laz(tmp_path).read_bytes()
    tab.wait_text("Open a point cloud")
    standstill = Standstill(studio)
    tab.upload("Upload a cloud", "mine.laz", content)
    tab.delivered()
    job = RunningJob("Something else", threading.Event().set)
    studio._claim(job)
    standstill.end()
    tab.wait_notification("is still running")
    kept = tmp_path / "uploads" / "mine.laz"
    tab.wait(lambda t: t.value("File or folder") == str(kept))
    studio._end(job)
    idle(tab, studio)  # the button was locked and is free again
    tab.press("Open")
    tab.wait(lambda t: "mine" in t.text() and "Press Find trunks" in t.text(), LONG)


# -- one plot, one place --------------------------------------------------------------------------------------------


def test_opening_the_open_plot_again_does_not_end_its_saving(
    measured: FakeClient, studio: Studio, tmp_path: Path
) -> None:
    """The file has become unreadable meanwhile, so a second reading would fail and leave a plot that nobody saves."""
    before = studio.session
    (tmp_path / "plot.laz").write_bytes(b"")
    measured.bridge_send("step", "open")
    measured.set("File or folder", str(tmp_path / "plot.laz"))
    measured.press("Open")
    measured.wait(lambda t: t.notifications, LONG)
    idle(measured, studio)
    assert studio.session is before
    trunk_id = before.document.trunks.ids[0]
    before.do(commands.set_tree_record(trunk_id, species="Fagus sylvatica"))
    before.flush()
    assert read_project(tmp_path / "plot.dbh").trees[trunk_id].species == "Fagus sylvatica"
    assert "open already" in measured.notifications[-1].title


def test_a_file_of_the_same_name_would_be_saved_in_the_same_place(
    measured: FakeClient, studio: Studio, tmp_path: Path
) -> None:
    (tmp_path / "plot.ply").write_bytes(b"ply\n")
    with pytest.raises(StudioError, match=r"would be saved in plot\.dbh, where the open plot of plot\.laz is"):
        studio.open_plot(tmp_path / "plot.ply")
    assert studio._job is None


def fill_disk(session: Session, patch: pytest.MonkeyPatch) -> None:
    """Neither the plot nor its undo log can be written."""

    def full(*_: Any, **__: Any) -> None:
        raise ProjectError("The disk is full.", "Make room.")

    def no_room(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    patch.setattr(session.saver._writer, "save", full)
    patch.setattr(session.saver._writer.undo_log, "_write", no_room)


def test_a_plot_that_cannot_be_saved_is_not_closed_for_another(
    measured: FakeClient, studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = studio.session
    fill_disk(before, monkeypatch)
    before.do(commands.delete_trunk(before.document.trunks.ids[0]))
    (tmp_path / "other").mkdir()
    path = plots.write_laz(tmp_path / "other", "other.laz")
    measured.bridge_send("step", "open")
    measured.set("File or folder", str(path))
    measured.press("Open")
    measured.wait_notification("The open plot is kept", LONG)
    other = open_plot(path, project_dir=tmp_path / "other.dbh")
    with pytest.raises(ProjectError, match="The disk is full"):
        studio.adopt(other)
    other.close()
    assert studio.session is before
    assert studio.wait_idle(LONG)
    monkeypatch.undo()
    before.flush()


def test_that_a_plot_is_not_saved_is_told_once_and_then_shown(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = studio.session
    fill_disk(session, monkeypatch)
    for trunk_id in session.document.trunks.ids[:3]:
        session.do(commands.delete_trunk(trunk_id))
        assert not session.saver.flush()
    measured.wait_text("NOT SAVED")
    measured.settle()
    assert [note.title for note in measured.notifications] == ["Not saved"]
    monkeypatch.undo()
    session.flush()
    measured.wait(lambda t: "NOT SAVED" not in t.text())


@pytest.mark.parametrize("stem", ["a" * 254, "ä" * 127, "林" * 84], ids=["letters", "umlauts", "signs"])
def test_a_plot_of_a_long_name_is_saved_under_a_shorter_one(tmp_path: Path, stem: str) -> None:
    """A folder's name may fill what the file system allows, and leave no room for a suffix."""
    first, second = (tmp_path / f"{stem}{letter}" for letter in "xy")
    first.mkdir()
    plots.write_laz(first)
    folder = project_dir_for(first, tmp_path / "elsewhere")
    open_plot(first, project_dir=folder).close()
    assert folder.is_dir() and folder.suffix == ".dbh" and folder.parent == tmp_path
    assert folder.name.startswith(stem[:60])
    assert project_dir_for(first, tmp_path) == folder != project_dir_for(second, tmp_path)


def test_a_path_that_no_file_can_have(tab: FakeClient) -> None:
    tab.wait_text("Open a point cloud")
    for path in ("x" * 300, "~nobody-is-called-so/plot.laz"):
        tab.set("File or folder", path)
        tab.press("Open")
        tab.wait(lambda t, path=path: t.notifications and safe_name(path)[:50] in t.notifications[-1].title)
    assert ["no such file" in note.title for note in tab.notifications] == [True, True]


def test_a_double_click_on_what_is_quickly_done_acts_once(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second press comes when the first has been dealt with."""
    monkeypatch.setattr("dbh_studio.ui.bind._DOUBLE_CLICK_S", LONG)
    measured.bridge_send("step", "export")
    measured.press("Download the inventory (CSV)", hurried=True)
    measured.wait_notification("Inventory exported")
    assert studio.wait_idle(LONG)
    measured.press("Download the inventory (CSV)", hurried=True)
    measured.settle()
    assert [note.title for note in measured.notifications] == ["Inventory exported"]


def test_trunks_that_come_back_are_shown_in_the_table_whatever_was_done_before(
    measured: FakeClient, studio: Studio
) -> None:
    choose(measured, table_ids(measured)[0])
    measured.bridge_send("undo")
    measured.wait(lambda t: not table_ids(t))
    measured.bridge_send("redo")
    measured.wait(lambda _: len(studio.session.document.trunks))
    idle(measured, studio)
    assert table_ids(measured)


# -- many hands -----------------------------------------------------------------------------------------------------


def test_a_change_while_a_tab_is_being_built_reaches_it(
    studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio.adopt(plots.measured_session(tmp_path))
    assert studio.session is not None
    ids, build = studio.session.document.trunks.ids, Tab.adopt_session

    def build_and_delete(tab: Tab) -> None:
        build(tab)
        studio.session.do(commands.delete_trunk(ids[0]))

    monkeypatch.setattr(Tab, "adopt_session", build_and_delete)
    with FakeClient(studio.server.url) as tab:
        tab.wait(lambda t: table_ids(t) == list(ids[1:]))


def test_changes_that_outrun_a_tab_do_not_trouble_it(measured: FakeClient, studio: Studio) -> None:
    """When the tab hears of the first deletion, the chosen tree has gone, too."""
    ids = table_ids(measured)
    choose(measured, ids[1])
    standstill = Standstill(studio)
    for trunk_id in ids[:2]:
        studio.session.do(commands.delete_trunk(trunk_id))
    standstill.end()
    measured.wait(lambda t: table_ids(t) == ids[2:] and "/highlight" not in t.scene)
    assert nothing_told(measured)


def test_undo_once_too_often_is_no_error(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    studio.session.do(commands.delete_trunk(ids[0]))
    for _ in range(6):
        measured.command("Undo")
    for _ in range(6):
        measured.bridge_send("redo")
    idle(measured, studio)
    assert not studio.session.can_redo
    assert table_ids(measured) == ids[1:]
    assert nothing_told(measured)


def test_a_key_held_down_flies_once(measured: FakeClient, studio: Studio) -> None:
    """Each flight takes a third of a second; twenty trees further nobody wants to have seen them all."""
    measured.settle()
    standstill = Standstill(studio)
    n_before = len(measured.messages)
    for _ in range(12):
        measured.command("Next tree")
    measured.delivered()
    standstill.end()
    measured.settle()
    moves = [m for m in measured.messages[n_before:] if m["type"] == "SetCameraPositionMessage"]
    # Of moves that wait to be sent the last goes in the place of all: there may be few of them, but not 12 flights.
    assert 1 <= len(moves) <= 12 + 8


@pytest.mark.parametrize("kind", ["sort", "step", "row", "colours", "look", "curve"])
def test_a_message_of_odd_content_does_nothing(measured: FakeClient, kind: str) -> None:
    for payload in ([], {}, None, -1, "no such thing", [["id"]], 1e300):
        measured.bridge_send(kind, payload)
    assert nothing_told(measured)


# -- what is being typed --------------------------------------------------------------------------------------------


def refresh(studio: Studio) -> None:
    """As when a job ends, or another tab changes something."""
    studio._each_tab(Tab.refresh)
    assert studio.wait_idle(LONG)


def test_a_refresh_leaves_alone_what_is_being_typed_about_a_tree(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.set("Species", "Picea ab")
    measured.set("Breast height (m)", 1.5)
    measured.settle()
    refresh(studio)
    measured.settle()
    assert measured.value("Species") == "Picea ab"
    assert measured.value("Breast height (m)") == 1.5


def test_what_was_typed_about_a_tree_is_kept_when_another_is_chosen(measured: FakeClient, studio: Studio) -> None:
    first, second = table_ids(measured)[:2]
    choose(measured, first)
    measured.set("Species", "Picea abies")
    measured.set("Status", "dead")
    choose(measured, second)
    record = studio.session.document.record(first)
    assert (record.species, record.status) == ("Picea abies", "dead")
    assert studio.session.undo_label == f"Describe trunk {first}"
    measured.wait(lambda t: t.value("Species") == "")
    # Nothing typed, nothing kept.
    choose(measured, first)
    choose(measured, second)
    studio.session.undo()
    assert studio.session.document.record(first).species == ""


def test_what_was_typed_about_a_tree_does_not_bring_back_a_deleted_one(measured: FakeClient, studio: Studio) -> None:
    first, second = table_ids(measured)[:2]
    choose(measured, first)
    measured.set("Species", "Picea abies")
    studio.session.do(commands.delete_trunk(first))
    choose(measured, second)
    assert nothing_told(measured)
    assert first not in studio.session.document.trunks
    assert measured.value("Species") == ""


def test_a_refresh_leaves_alone_the_path_that_is_being_typed(measured: FakeClient, studio: Studio) -> None:
    measured.bridge_send("step", "open")
    measured.wait(lambda t: t.has("File or folder") and t.value("File or folder").endswith("plot.laz"))
    measured.set("File or folder", "/data/ot")
    measured.settle()
    refresh(studio)
    measured.settle()
    assert measured.value("File or folder") == "/data/ot"


def test_the_up_direction_shown_is_the_one_there_is(measured: FakeClient, studio: Studio) -> None:
    measured.bridge_send("step", "open")
    measured.set("Up in the file", "+y")
    measured.wait(lambda _: studio.session.document.up_direction == (0.0, 1.0, 0.0))
    measured.bridge_send("undo")
    measured.wait(lambda t: t.value("Up in the file") == "as recognised", LONG)


# -- what is not there yet ------------------------------------------------------------------------------------------


def test_nothing_is_handed_in_while_trees_are_not_measured(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(studio, "measure_missing", lambda: None)
    studio.session.do(commands.change_settings("measure", curve="ellipse"))
    measured.bridge_send("step", "export")
    measured.press("Download the inventory (CSV)")
    measured.wait_notification("not measured yet")
    measured.settle()
    assert not measured.downloads


def test_a_tree_is_not_measured_by_a_click_while_the_ground_is_unknown(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To fit it takes as long as the job that is about to do it, and the tab would stand still."""
    trunk_id = table_ids(measured)[0]
    monkeypatch.setattr(studio, "measure_missing", lambda: None)
    studio.session.do(commands.change_settings("ground", cell_m=0.7))
    choose(measured, trunk_id)
    measured.wait_text("Not measured yet.")
    measured.bridge_send("look", "tree")
    idle(measured, studio)
    assert not studio.session.has_ground()
    monkeypatch.undo()
    studio.measure_missing()
    measured.wait_text("Ring seen", LONG)
    measured.wait(lambda t: "/ring" in t.scene)


# -- the picture ----------------------------------------------------------------------------------------------------


def test_one_edit_looks_at_one_trunk(measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    import dbh_studio.ui.tab as module

    looked_at, anchor = [], module._label_anchor
    monkeypatch.setattr(module, "_label_anchor", lambda points: (looked_at.append(len(points)), anchor(points))[1])
    ids = table_ids(measured)
    measured.wait(lambda t: f"/tree/{ids[-1]}" in t.scene)
    idle(measured, studio)
    looked_at.clear()
    studio.session.do(commands.delete_trunk(ids[0]))
    measured.wait(lambda t: f"/red/{ids[0]}" not in t.scene)
    idle(measured, studio)
    assert looked_at == []
    studio.session.undo()
    measured.wait(lambda t: f"/red/{ids[0]}" in t.scene)
    idle(measured, studio)
    assert looked_at == [len(studio.session.document.trunks[ids[0]])]


def test_larger_points_leave_the_chosen_tree_on_top_and_stay_large(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.wait(lambda t: "/highlight" in t.scene)
    measured.set("Point size", 3.0)
    size = studio.display.point_size
    measured.settle()
    assert measured.scene["/highlight"].props["point_size"] == pytest.approx(3.9 * size)
    assert measured.scene[f"/red/{trunk_id}"].props["point_size"] == pytest.approx(3.75 * size)
    studio.session.do(commands.set_up("-z"))
    idle(measured, studio)
    shown = measured.scene["/rgb/low/0"].props["point_size"]
    assert shown == pytest.approx(3.0 * studio.display.point_size)


def test_a_row_of_turns_sends_the_cloud_once_and_as_it_is_at_the_end(measured: FakeClient, studio: Studio) -> None:
    measured.settle()
    n_before = len(measured.messages)
    standstill = Standstill(studio)
    for axis in ("-z", "+x", "+y", "+z", "-y"):
        studio.session.do(commands.set_up(axis))
    standstill.end()
    idle(measured, studio)
    roots = [m for m in measured.messages[n_before:] if m["type"] == "FrameMessage" and m.get("name") == "/rgb"]
    assert len(roots) == 1
    sent = np.vstack([node.props["points"] for name, node in measured.scene.items() if name.startswith("/rgb/low/")])
    low = studio.display.points[~studio.display.is_crown]
    np.testing.assert_allclose(np.sort(sent, axis=0), np.sort(low, axis=0), atol=1e-6)


def test_open_pressed_three_times_opens_once(tab: FakeClient, studio: Studio, tmp_path: Path) -> None:
    path = plots.write_laz(tmp_path)
    tab.wait_text("Open a point cloud")
    tab.set("File or folder", str(path))
    for _ in range(3):
        tab.press("Open", force=True)
    tab.wait_text("Press Find trunks", LONG)
    idle(tab, studio)
    tab.bridge_send("step", "trunks")
    find_trunks(tab, studio)
    assert len(studio.session.document.trunks) == len(plots.plot().trees)
