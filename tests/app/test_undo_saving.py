"""Undo and redo across restarts, and plots whose program ends at any moment: nothing accepted is lost."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.app.plots import make_session, make_trunks
from tests.app.random_edits import N_POINTS, all_of, of, random_step

from dbh_studio.app import autosave, commands, edits
from dbh_studio.app.autosave import Autosave
from dbh_studio.app.saved_states import history_from_states
from dbh_studio.app.session import Session
from dbh_studio.io import undo_log
from dbh_studio.io.project import ProjectWriter, read_history, read_plot

REPOSITORY = Path(__file__).parents[2]
_REAL = {name: getattr(os, name) for name in ("write", "fsync", "replace", "ftruncate")}


def begin(folder: Path, **options: Any) -> Session:
    """A new plot with trunks, in a folder; with no thread, so that what is saved when can be told."""
    session, _ = make_session(n_points=N_POINTS, n_trunks=4)
    keep(session, folder, **options)
    return session


def keep(session: Session, folder: Path, **options: Any) -> Autosave:
    return Autosave(session, ProjectWriter(folder), **{"author": "Ada", "background": True, **options})


def reopened(folder: Path, before: Session, **options: Any) -> Session:
    writer = ProjectWriter(folder)
    plot = read_plot(folder)
    history = history_from_states(plot.states, before.document.source)
    session = Session(before.cloud, history.present, history=history)
    session.reopening_notes = plot.notes
    Autosave(session, writer, **{"author": "Ada", "background": True, **options}, opened=plot)
    return session


def abandon(session: Session, saver: Autosave | None = None) -> None:
    """The program is gone: nothing is saved, the system closes its files."""
    saver = saver or session.saver
    if saver is not None:
        autosave.atexit.unregister(saver.close)
        # The thread ends where a killed one would: between two saves, not with its files closed under its hands.
        with saver._condition:
            saver._is_closing = True
            saver._condition.notify()
        if saver._thread is not None:
            saver._thread.join()
        saver._writer.close()
        session.saver = None


@pytest.fixture
def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread saves: a test does."""
    monkeypatch.setattr(Autosave, "_run", lambda self: None)


# ---- undo after reopening


def test_undo_and_redo_lead_to_the_same_states_after_reopening(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    first = of(session)[0]
    session.do(commands.delete_trunk(2))
    session.do(edits.merge_trunks([1, 3]))
    session.do(commands.set_tree_record(1, species="oak"))
    session.undo()
    expected = of(session)
    session.close()
    again = reopened(folder, session)
    assert again.reopening_notes == ()
    assert of(again) == expected
    assert (again.undo_label, again.redo_label) == ("Merge trunks 1 and 3", "Describe trunk 1")
    # What did not change is one object in all states: nothing is measured again.
    past = [document.trunks for _, document in again.earlier]
    assert past[0][4] is again.document.trunks[4]
    again.redo()
    assert again.document.record(1).species == "oak"
    while again.can_undo:
        again.undo()
    assert of(again)[0] == first
    again.close()
    last = reopened(folder, session)
    assert of(last)[0] == first and last.redo_label == "Delete trunk 2"
    last.close()


def test_a_number_given_out_and_undone_is_not_given_out_after_reopening(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    session.do(edits.add_trunk(np.arange(100, 110)))
    session.undo()
    session.close()
    again = reopened(folder, session)
    assert again.next_id == 6
    again.do(edits.add_trunk(np.arange(100, 110)))
    assert again.document.trunks.ids == (1, 2, 3, 4, 6)
    again.close()


def test_a_plot_saved_elsewhere_takes_what_can_be_undone_with_it(tmp_path):
    from dbh_studio.app.opening import save_as

    session, _ = make_session(n_points=N_POINTS)
    save_as(session, tmp_path / "a.dbh")
    session.do(commands.delete_trunk(1))
    save_as(session, tmp_path / "b.dbh")
    session.do(commands.delete_trunk(2))
    expected = of(session)
    session.close()
    assert all_of(history_from_states(read_plot(tmp_path / "b.dbh").states, session.document.source)) == expected
    assert [entry.what for entry in read_history(tmp_path / "a.dbh")] == ["Create the plot", "Delete trunk 1"]


def test_the_history_says_who_did_what_in_order_also_after_a_kill(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    session.do(commands.delete_trunk(1))
    session.saver.flush()
    session.do(commands.delete_trunk(2))
    session.undo()
    abandon(session)  # the last two are in the undo log only
    assert [entry.number for entry in read_history(folder)] == [0, 1]
    again = reopened(folder, session, author="Bob")
    again.redo()
    again.close()
    entries = read_history(folder)
    assert [(entry.kind, entry.what, entry.who, entry.number) for entry in entries] == [
        ("do", "Create the plot", "Ada", 0),
        ("do", "Delete trunk 1", "Ada", 1),
        ("do", "Delete trunk 2", "Ada", 2),
        ("undo", "Undo: Delete trunk 2", "Ada", 3),
        ("redo", "Redo: Delete trunk 2", "Bob", 4),
    ]


def test_one_edit_writes_little_and_the_trunks_only_once(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, _ = make_session(n_points=200_000, n_trunks=0)
    session.do(commands.replace_trunks(make_trunks(40, size=4000)))
    keep(session, folder)
    log, trunks = folder / "undo.log", {path: path.stat().st_mtime_ns for path in folder.glob("trunks*")}
    size = log.stat().st_size
    session.do(commands.set_tree_record(3, species="oak"))
    after_word = log.stat().st_size
    assert after_word - size < 1500
    session.do(edits.drop_points(np.arange(10), 1))
    after_points = log.stat().st_size
    assert 4 * 3990 < after_points - after_word < 4 * 3990 + 1500
    for _ in range(20):
        session.undo()
        session.redo()
    assert log.stat().st_size - after_points < 40 * 400
    session.saver.flush()
    assert {path: path.stat().st_mtime_ns for path in folder.glob("trunks*")} == trunks
    abandon(session)


def test_a_long_log_is_shortened_and_keeps_what_can_be_undone(tmp_path, by_hand, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 30)
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    sizes = []
    for step in range(100):
        session.do(commands.rename_plot(f"plot {step}"))
        session.undo()
        session.saver.flush()
        sizes.append((folder / "undo.log").stat().st_size)
    assert max(sizes) < 40 * 400 + 5000 and sizes[-1] < sizes[-30] + 15_000
    session.do(commands.delete_trunk(1))
    expected = of(session)
    abandon(session)
    again = reopened(folder, session)
    assert of(again) == expected
    again.close()


def test_a_log_that_outgrows_its_bound_forgets_the_oldest_steps_only(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session = begin(folder, most_log_bytes=20_000)
    for step in range(60):
        session.do(edits.drop_points(np.array([step % 40]), None) if step % 2 else commands.rename_plot(str(step)))
        session.saver.flush()
    expected = of(session)
    abandon(session)
    assert (folder / "undo.log").stat().st_size < 45_000
    again = reopened(folder, session)
    present, past, future, _ = of(again)
    assert present == expected[0] and future == ()
    assert 0 < len(past) <= len(expected[1]) and past == expected[1][-len(past) :]
    again.close()


def test_what_is_done_while_the_log_is_written_anew_is_in_it(tmp_path, by_hand, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 2)
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    for trunk_id in (1, 2, 3):
        session.do(commands.delete_trunk(trunk_id))
    records_of = undo_log.records_of

    def interrupted(*args: Any) -> Iterator[Any]:
        yield from records_of(*args)
        monkeypatch.setattr(undo_log, "records_of", records_of)
        session.do(edits.add_trunk(np.arange(100, 110)))
        session.undo()

    monkeypatch.setattr(undo_log, "records_of", interrupted)
    session.saver.flush()
    expected = of(session)
    assert expected[2]  # it can be redone
    abandon(session)
    again = reopened(folder, session)
    assert of(again) == expected
    again.close()


def test_edits_of_several_threads_are_there_at_once_while_the_log_is_written_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 10)
    folder = tmp_path / "plot.dbh"
    session = begin(folder, quiet_s=0.001)

    def work(trunk_id: int) -> None:
        for step in range(40):
            session.do(commands.set_tree_record(trunk_id, note=f"{trunk_id} {step}"))

    workers = [threading.Thread(target=work, args=(trunk_id,)) for trunk_id in (1, 2, 3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    # Nothing was waited for: what was done is there, whatever is being saved.
    assert all_of(history_from_states(read_plot(folder).states, session.document.source)) == of(session)
    session.close()
    assert [entry.number for entry in read_history(folder)] == list(range(121))
    assert all_of(history_from_states(read_plot(folder).states, session.document.source)) == of(session)


# ---- the end at any moment


class Crash(BaseException):
    """The program is killed."""


class Fate:
    """Counts the calls by which something comes to the disk; at a chosen one the program ends, halfway through."""

    def __init__(self, at: int | None = None, error: BaseException | None = None, *, for_good: bool = True) -> None:
        self.n_calls, self._at, self._error, self._for_good = 0, at, error or Crash(), for_good

    def _strikes(self) -> bool:
        self.n_calls += 1
        if self._at is None:
            return False
        return self.n_calls - 1 >= self._at if self._for_good else self.n_calls - 1 == self._at

    def write(self, descriptor: int, content: Any) -> int:
        if self._strikes():
            if self.n_calls - 1 == self._at:
                _REAL["write"](descriptor, bytes(content)[: len(content) // 2])
            raise self._error
        return _REAL["write"](descriptor, content)

    def other(self, name: str) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            if self._strikes():
                raise self._error
            return _REAL[name](*args)

        return call

    @contextmanager
    def rules(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "write", self.write)
            for name in ("fsync", "replace", "ftruncate"):
                patch.setattr(os, name, self.other(name))
            yield


def _steps(session: Session) -> Iterator[Callable[[], Any]]:
    """A morning's work: edits, Undo, Redo, another way after Undo, the log written anew, the plot saved."""
    saver = session.saver
    yield lambda: session.do(commands.delete_trunk(2))
    yield lambda: session.do(edits.merge_trunks([1, 3]))
    yield saver.flush
    yield session.undo
    yield session.undo
    yield session.redo
    yield saver._save_due
    yield lambda: session.do(edits.split_trunk(4, [np.arange(30, 34), np.arange(34, 40)]))
    yield session.undo
    yield lambda: session.do(commands.set_tree_record(4, species="oak"))
    yield saver.flush
    yield lambda: session.do(edits.add_trunk(np.arange(100, 110)))
    yield session.close


def _work(folder: Path, session: Session, fate: Fate) -> list[tuple]:
    """Do it until the end; what the plot may be found as."""
    accepted = of(session)
    try:
        with fate.rules():
            for step in _steps(session):
                step()
                accepted = of(session)
    except Crash:
        return [accepted, of(session)]
    return [accepted]


def test_at_whatever_call_the_program_ends_all_that_was_accepted_is_there(tmp_path, by_hand, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 4)
    begun = begin(tmp_path / "count.dbh")
    counting = Fate()
    _work(tmp_path / "count.dbh", begun, counting)
    assert counting.n_calls > 30
    found_last = 0
    for at in range(counting.n_calls):
        folder = tmp_path / f"plot-{at}.dbh"
        session = begin(folder)
        first = of(session)[0]
        saver = session.saver
        possible = _work(folder, session, Fate(at))
        abandon(session, saver)
        again = reopened(folder, session)
        assert of(again) in possible, f"after call {at}"
        found_last += of(again) == possible[-1]
        assert all("undone any more" not in note and "Lost" not in note for note in again.reopening_notes)
        again.do(commands.rename_plot("afterwards"))
        while again.can_undo:
            again.undo()
        assert of(again)[0] == first
        again.close()
    assert found_last > counting.n_calls / 2


def test_at_whatever_call_the_disk_is_full_once_nothing_is_missing(tmp_path, by_hand, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 4)
    counting = Fate()
    _work(tmp_path / "count.dbh", begin(tmp_path / "count.dbh"), counting)
    for at in range(counting.n_calls):
        folder = tmp_path / f"plot-{at}.dbh"
        session = begin(folder)
        (expected,) = _work(folder, session, Fate(at, OSError(28, "No space left on device"), for_good=False))
        again = reopened(folder, session)
        # All of it, but that Undo may begin anew where even the last save was hit.
        assert of(again)[0] == expected[0], f"after call {at}"
        again.close()


def _fsync_fails_once(session: Session) -> None:
    """What the system had taken it could not bring to the disk, and may have dropped."""
    fate = Fate(0, OSError(5, "Input/output error"), for_good=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", fate.other("fsync"))
        session.saver.flush()
    assert session.saver._writer.undo_log.is_doubtful


def test_at_whatever_call_the_program_ends_while_a_doubtful_log_is_mended_nothing_is_missing(tmp_path, by_hand):
    for at in range(14):
        folder = tmp_path / f"plot-{at}.dbh"
        session = begin(folder)
        session.do(commands.delete_trunk(1))
        _fsync_fails_once(session)
        session.do(commands.delete_trunk(2))
        expected = of(session)
        with contextlib.suppress(Crash), Fate(at).rules():
            session.saver.flush()
        abandon(session)
        again = reopened(folder, session)
        assert of(again) == expected, f"after call {at}"
        again.close()


def test_a_step_that_waited_for_room_is_not_there_twice_when_the_log_is_mended(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    session.do(commands.delete_trunk(1))
    _fsync_fails_once(session)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "write", Fate(0, OSError(28, "No space left on device")).write)
        session.do(commands.delete_trunk(2))
    assert session.saver.flush()
    session.do(commands.delete_trunk(3))
    expected = of(session)
    abandon(session)
    again = reopened(folder, session)
    assert of(again) == expected
    again.close()


@pytest.mark.parametrize("seed", range(8))
def test_random_edits_undos_kills_power_cuts_and_reopenings(tmp_path, by_hand, monkeypatch, seed):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 25)
    rng = np.random.default_rng(seed)
    folder = tmp_path / "plot.dbh"
    session = begin(folder)
    first = of(session)[0]
    # What the plot may be found as: with the last item if the program ends, with any if the power does.
    possible = [of(session)]
    for _ in range(60):
        fate = Fate(int(rng.integers(0, 8)) if rng.random() < 0.15 else None)
        try:
            with fate.rules():
                random_step(rng, session)
                possible.append(of(session))
                if rng.random() < 0.3:
                    if session.saver.flush():
                        possible = possible[-1:]
                elif rng.random() < 0.1:
                    session.saver._save_due()
                    possible = possible[-1:]
        except Crash:
            killed = [*possible[-1:], of(session)]
            is_power_cut, durable = rng.random() < 0.4, session.saver._writer.undo_log._n_durable
            abandon(session)
            if is_power_cut:
                with (folder / "undo.log").open("r+b") as log:
                    end = log.seek(0, os.SEEK_END)
                    log.truncate(int(rng.integers(min(durable, end), end + 1)))
            session = reopened(folder, session)
            assert of(session) in ([*possible, *killed] if is_power_cut else killed)
            possible = [of(session)]
    expected = of(session)
    session.close()
    again = reopened(folder, session)
    assert of(again) == expected
    while again.can_undo:
        again.undo()
    assert of(again)[0] == first
    again.close()


_EDITOR = """
import sys, numpy as np
sys.path.insert(0, sys.argv[3])
from pathlib import Path
from tests.app.test_undo_saving import begin
from tests.app.random_edits import random_step
session, rng = begin(Path(sys.argv[1]), quiet_s=0.05), np.random.default_rng(int(sys.argv[2]))
print("begun", flush=True)
while True:
    random_step(rng, session)
    print("done", flush=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL on Windows")
@pytest.mark.parametrize("seed", range(3))
def test_a_program_that_is_killed_for_good(tmp_path, seed):
    """The same edits in a process of its own, which is killed while it works, and here, where nothing is saved."""
    folder = tmp_path / "plot.dbh"
    command = [sys.executable, "-c", _EDITOR, str(folder), str(seed), str(REPOSITORY)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as editor:
        assert editor.stdout.readline() == "begun\n"
        for _ in range(20 + 37 * seed):
            assert editor.stdout.readline() == "done\n"
        editor.send_signal(signal.SIGKILL)
        n_done = 20 + 37 * seed + editor.stdout.read().count("done\n")
    alone, rng = make_session(n_points=N_POINTS, n_trunks=4)[0], np.random.default_rng(seed)
    for _ in range(n_done):
        random_step(rng, alone)
    # Done but not yet said so, or under way.
    possible = [of(alone)]
    for _ in range(2):
        random_step(rng, alone)
        possible.append(of(alone))
    again = reopened(folder, alone)
    assert of(again) in possible
    again.close()
