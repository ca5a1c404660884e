"""The Session and its saved plot together: what is on the disk is what is on the screen."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from tests.app.plots import contents, make_session, make_trunks

from dbh_studio.app import commands
from dbh_studio.app.autosave import Autosave
from dbh_studio.app.opening import save_as
from dbh_studio.app.saved_states import document_from_state, history_from_states
from dbh_studio.app.session import Session
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import CommandError, ProjectError
from dbh_studio.io.project import ProjectWriter, read_plot, read_project


def keep(session: Session, folder: Path, **options) -> Autosave:
    return Autosave(session, ProjectWriter(folder), **{"background": False, "author": "Ada", **options})


def on_disk(session: Session, folder: Path):
    return contents(document_from_state(read_project(folder), session.document.source))


def history(folder: Path) -> list[str]:
    return [json.loads(line)["what"] for line in (folder / "history.jsonl").read_text(encoding="utf-8").splitlines()]


def fill_disk(patch: pytest.MonkeyPatch) -> None:
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    patch.setattr(os, "fsync", full)
    patch.setattr(os, "write", full)


def test_every_command_is_saved_before_it_returns(tmp_path):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session()
    saver = keep(session, folder)
    assert on_disk(session, folder) == contents(session.document)
    for change in (
        lambda: session.do(commands.delete_trunk(2)),
        lambda: session.do(commands.set_tree_record(1, species="oak", note="«twin»")),
        lambda: session.do(commands.set_up((0.0, 0.6, 0.8))),
        lambda: session.do(commands.set_scale(ScaleEstimate(1.3, "bars", 0.01))),
        lambda: session.do(commands.change_settings("measure", curve="bspline")),
        session.undo,
        session.redo,
    ):
        change()
        assert on_disk(session, folder) == contents(session.document)
        assert saver.status.state == "saved"
    session.close()
    assert history(folder) == [
        "Create the plot",
        "Delete trunk 2",
        "Describe trunk 1",
        "Change the up direction",
        "Set the scale to 1.3 m per unit",
        "Change the measure settings",
        "Undo: Change the measure settings",
        "Redo: Change the measure settings",
    ]
    entry = json.loads((folder / "history.jsonl").read_text(encoding="utf-8").splitlines()[0])
    assert entry["who"] == "Ada" and entry["when"].endswith("+00:00")
    ProjectWriter(folder).close()


def test_a_full_disk_is_reported_keeps_the_session_alive_and_is_tried_again(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session()
    saver = keep(session, folder)
    first = contents(session.document)
    heard = []
    saver.subscribe(lambda status: heard.append(status.state))

    with monkeypatch.context() as patch:
        fill_disk(patch)
        session.do(commands.delete_trunk(1))
        session.do(commands.delete_trunk(2))
        assert not saver.flush()
    assert saver.status.state == "not_saved" and "No space left" in saver.status.problem
    assert on_disk(session, folder) == first
    assert session.document.trunks.ids == (3, 4, 5)
    session.do(commands.delete_trunk(3))
    assert saver.status.state == "saved" and saver.status.problem == ""
    assert on_disk(session, folder) == contents(session.document)
    assert history(folder) == ["Create the plot", "Delete trunk 1", "Delete trunk 2", "Delete trunk 3"]
    assert heard == ["saving", "not_saved", "saving", "not_saved", "saving", "not_saved", "saving", "saved"]
    session.close()


def test_in_the_background_commands_do_not_wait_and_are_all_there_after_a_flush(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session(n_trunks=20)
    saver = keep(session, folder, background=True)
    may_save = threading.Event()
    n_saves = 0
    save = ProjectWriter.save

    def slow(self, state, **options):
        nonlocal n_saves
        n_saves += 1
        may_save.wait(120)
        save(self, state, **options)

    monkeypatch.setattr(ProjectWriter, "save", slow)
    for i in range(1, 11):
        session.do(commands.delete_trunk(i))
    # The plot itself is not saved yet; what was done is there.
    assert read_plot(folder).saved_trunks.ids == tuple(range(1, 21))
    assert on_disk(session, folder) == contents(session.document)
    assert saver.flush()
    assert n_saves == 0
    may_save.set()
    assert on_disk(session, folder) == contents(session.document)
    assert history(folder)[1:] == [f"Delete trunk {i}" for i in range(1, 11)]
    session.do(commands.delete_trunk(11))
    session.close()
    assert read_project(folder).trunks.ids == tuple(range(12, 21))
    assert history(folder)[-1] == "Delete trunk 11"


def test_a_save_that_failed_is_tried_again_by_itself_and_nothing_is_missing_then(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session()
    saver = keep(session, folder, background=True, retry_s=0.01)
    first = contents(session.document)
    reached = {"not_saved": threading.Event(), "saved": threading.Event(), "saving": threading.Event()}
    problems = []

    def told(status):  # not asked of the saver afterwards, which is soon trying again
        problems.append(status.problem)
        reached[status.state].set()

    saver.subscribe(told)
    with monkeypatch.context() as patch:
        fill_disk(patch)
        session.do(commands.delete_trunk(1))
        session.do(commands.set_tree_record(2, species="oak"))
        assert reached["not_saved"].wait(120)
        assert any("No space left" in problem and "every few seconds" in problem for problem in problems)
        assert on_disk(session, folder) == first
        reached["saved"].clear()
    assert reached["saved"].wait(120)
    assert on_disk(session, folder) == contents(session.document)
    assert history(folder) == ["Create the plot", "Delete trunk 1", "Describe trunk 2"]
    session.close()
    assert len(read_plot(folder).states.past) == 2


def test_what_a_full_disk_left_of_a_step_is_written_over(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session()
    keep(session, folder)
    write = os.write
    with monkeypatch.context() as patch:
        n_calls = 0

        def half(descriptor, content):
            nonlocal n_calls
            n_calls += 1
            if n_calls % 2:
                return write(descriptor, bytes(content)[: len(content) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")

        patch.setattr(os, "write", half)
        patch.setattr(os, "fsync", lambda _: half(0, b""))
        session.do(commands.delete_trunk(1))
        session.do(commands.delete_trunk(2))
    session.do(commands.delete_trunk(3))
    session.close()
    plot = read_plot(folder)
    assert plot.notes == () and plot.log.end.offset == (folder / "undo.log").stat().st_size
    assert [label for label, _ in plot.states.past] == [f"Delete trunk {i}" for i in (1, 2, 3)]


def _fail(self, state, **options):
    raise RuntimeError("something unforeseen")


def test_closing_saves_what_a_full_disk_kept_back(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session()
    keep(session, folder)
    with monkeypatch.context() as patch:
        fill_disk(patch)
        session.do(commands.delete_trunk(1))
    session.close()
    session.close()
    assert read_project(folder).trunks.ids == (2, 3, 4, 5)


def test_an_id_given_out_and_undone_is_not_given_out_after_reopening(tmp_path):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session(n_trunks=0)
    keep(session, folder)
    session.do(commands.replace_trunks(make_trunks(3)))
    session.undo()
    session.close()
    document = document_from_state(read_project(folder), session.document.source)
    reopened = Session(session.cloud, document)
    reopened.do(commands.replace_trunks(make_trunks(2)))
    assert reopened.document.trunks.ids == (4, 5)


def test_an_edit_during_the_first_save_is_saved(tmp_path, monkeypatch):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session()
    before = session.document
    editor = threading.Thread(target=lambda: session.do(commands.delete_trunk(1)))
    save = ProjectWriter.save

    def slow(self, state, **options):
        monkeypatch.setattr(ProjectWriter, "save", save)
        editor.start()
        while session.document is before:
            time.sleep(0.001)
        save(self, state, **options)

    monkeypatch.setattr(ProjectWriter, "save", slow)
    saver = keep(session, folder, background=True)
    editor.join(120)
    assert saver.flush()
    assert read_project(folder).trunks.ids == (2, 3, 4, 5)
    assert history(folder) == ["Create the plot", "Delete trunk 1"]
    session.close()


def test_an_edit_while_a_plot_gets_another_folder_is_saved_there(tmp_path, monkeypatch):
    session, _ = make_session()
    save_as(session, tmp_path / "a.dbh", background=False)
    first, close = session.saver, Autosave.close

    def edited_meanwhile(self):
        if self is first:
            session.do(commands.delete_trunk(1))
        return close(self)

    monkeypatch.setattr(Autosave, "close", edited_meanwhile)
    save_as(session, tmp_path / "b.dbh", background=False)
    assert read_project(tmp_path / "b.dbh").trunks.ids == (2, 3, 4, 5)
    session.close()


def test_a_plot_that_cannot_be_saved_elsewhere_stays_where_it_is(tmp_path, monkeypatch):
    session, _ = make_session()
    saver = save_as(session, tmp_path / "a.dbh", background=False)
    with monkeypatch.context() as patch:
        patch.setattr(ProjectWriter, "save", _fail)
        with pytest.raises(ProjectError, match="something unforeseen"):
            save_as(session, tmp_path / "b.dbh", background=False)
    assert session.saver is saver
    session.do(commands.delete_trunk(1))
    assert read_project(tmp_path / "a.dbh").trunks.ids == (2, 3, 4, 5)
    ProjectWriter(tmp_path / "b.dbh").close()
    session.close()


def test_a_last_save_that_fails_is_told(tmp_path, monkeypatch, caplog):
    session, _ = make_session()
    saver = keep(session, tmp_path / "plot.dbh")
    monkeypatch.setattr(ProjectWriter, "save", _fail)
    fill_disk(monkeypatch)
    session.do(commands.delete_trunk(1))
    with pytest.raises(ProjectError, match="something unforeseen"):
        session.flush()
    caplog.clear()
    session.close()
    assert [record.levelname for record in caplog.records if "plot.dbh" in record.getMessage()] == ["ERROR"]
    assert saver.status.state == "not_saved"
    assert saver.close().state == "not_saved"
    ProjectWriter(tmp_path / "plot.dbh").close()


def test_what_is_saved_nowhere_is_flushed_at_once():
    session, _ = make_session()
    session.flush()


def test_a_plot_in_place_of_another_begins_a_history(tmp_path):
    folder = tmp_path / "plot.dbh"
    for label in ("the first", "the second"):
        session, _ = make_session()
        save_as(session, folder, overwrite=True, background=False, label=label)
        session.close()
    assert history(folder) == ["the second"]
    assert "the first" in (folder / "history-1.jsonl").read_text(encoding="utf-8")


text = st.text(st.characters(codec="utf-8"), max_size=5)


class SavedModel(RuleBasedStateMachine):
    """Random edits, undos and reopenings: the disk always holds the live Document."""

    @initialize(folder=st.just(None))
    def begin(self, folder):
        import tempfile

        self._temporary = tempfile.TemporaryDirectory()
        self.folder = Path(self._temporary.name) / "plot.dbh"
        self.session, _ = make_session(n_points=60, n_trunks=0)
        keep(self.session, self.folder)

    def _do(self, command):
        try:
            self.session.do(command)
        except CommandError:
            return

    @rule(n_trunks=st.integers(0, 5), first=st.integers(0, 20), size=st.integers(1, 8))
    def find(self, n_trunks, first, size):
        self._do(commands.replace_trunks(make_trunks(n_trunks, first=first, size=size)))

    @rule(trunk_id=st.integers(1, 10))
    def delete(self, trunk_id):
        self._do(commands.delete_trunk(trunk_id))

    @rule(trunk_id=st.integers(1, 10), note=text, tree=st.none() | st.just(3))
    def describe(self, trunk_id, note, tree):
        self._do(commands.set_tree_record(trunk_id, note=note, tree_id=tree, status="dead"))

    @rule(factor=st.floats(1e-3, 1e3), error=st.none() | st.floats(0, 1))
    def scale(self, factor, error):
        self._do(commands.set_scale(ScaleEstimate(factor, "bars", error)))

    @rule(up=st.tuples(*[st.floats(-1, 1)] * 3))
    def turn(self, up):
        self._do(commands.set_up(up))

    @rule()
    def undo(self):
        if self.session.can_undo:
            self.session.undo()

    @rule()
    def redo(self):
        if self.session.can_redo:
            self.session.redo()

    @rule()
    def reopen(self):
        before, next_id = contents(self.session.document), self.session.next_id
        self.session.close()
        writer = ProjectWriter(self.folder)
        plot = read_plot(self.folder)
        again = history_from_states(plot.states, self.session.document.source)
        self.session = Session(self.session.cloud, again.present, history=again)
        Autosave(self.session, writer, background=False, author="", opened=plot)
        assert contents(self.session.document) == before
        assert self.session.next_id == next_id

    @invariant()
    def the_disk_holds_the_document(self):
        assert self.session.saver.status.state == "saved"
        assert on_disk(self.session, self.folder) == contents(self.session.document)
        points = np.concatenate([np.empty(0, np.int32), *(t.points for t in self.session.document.trunks)])
        assert len(np.unique(points)) == len(points)

    def teardown(self):
        if hasattr(self, "session"):
            self.session.close()
            self._temporary.cleanup()


TestSavedModel = SavedModel.TestCase
TestSavedModel.settings = hypothesis_settings(max_examples=25, stateful_step_count=15, deadline=None)
