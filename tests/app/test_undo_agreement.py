"""The Session, project.json, the undo log and the history tell one story, also where one of them was left behind."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
from tests.app.plots import make_session, make_trunks
from tests.app.random_edits import of
from tests.app.test_undo_saving import Fate, abandon, begin, by_hand, keep, reopened
from tests.app.test_undo_saving import _work as work

from dbh_studio.app import autosave, commands, edits
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.errors import ProjectError
from dbh_studio.io.project import read_history, read_plot

__all__ = ["by_hand"]


def test_no_step_leads_back_behind_what_a_shortened_log_has(tmp_path, by_hand):
    """One that did could not be followed on reopening, nor could anything that was done after it."""
    folder = tmp_path / "plot.dbh"
    session, _ = make_session(n_points=20_000, n_trunks=0)
    session.do(commands.replace_trunks(make_trunks(4, size=4000)))
    keep(session, folder, most_log_bytes=200_000)
    for step in range(30):
        session.do(edits.drop_points(np.array([step]), None))
        session.saver.flush()
    n_undone = 0
    while session.can_undo:
        session.undo()
        n_undone += 1
    assert 0 < n_undone < 25
    session.do(commands.rename_plot("after"))
    session.saver.flush()
    expected = of(session)
    abandon(session)
    again = reopened(folder, session)
    assert of(again) == expected and "Nothing is lost" in again.reopening_notes[0]
    again.close()


def test_a_log_that_the_plot_does_not_name_yet_is_not_called_saved(tmp_path, by_hand, monkeypatch):
    """The disk takes the log but not the plot itself: what is in that log would not be found again."""
    folder = tmp_path / "plot.dbh"
    begun = begin(folder)
    begun.close()
    (folder / "undo.log").unlink()
    session = reopened(folder, begun)
    saver = session.saver
    save, n_saves = saver._writer.save, 0

    def full_after_the_first(*args: Any, **options: Any) -> None:
        nonlocal n_saves
        n_saves += 1
        if n_saves > 1:
            raise ProjectError("The disk is full.")
        save(*args, **options)

    monkeypatch.setattr(saver._writer, "save", full_after_the_first)
    session.do(commands.delete_trunk(1))
    for _ in range(3):
        session.do(commands.set_tree_record(2, note=f"{n_saves}"))
        assert not saver.flush() and "disk is full" in saver.status.problem
        saver._save_due()
        assert saver.status.state == "not_saved"
    monkeypatch.setattr(saver._writer, "save", save)
    assert saver.flush()
    session.do(commands.delete_trunk(3))
    expected = of(session)
    abandon(session)
    again = reopened(folder, begun)
    assert of(again) == expected
    again.close()


@pytest.mark.parametrize(
    "command",
    [
        lambda n: commands.set_scale(ScaleEstimate(n, "factor")),
        lambda n: commands.change_settings("measure", breast_height_m=n),
        lambda n: commands.rename_plot(f"plot {n}"),
        lambda n: commands.delete_trunk(int(n)),
    ],
    ids=["scale", "settings", "name", "trunks"],
)
def test_the_log_of_a_copy_that_went_another_way_is_not_believed(tmp_path, by_hand, command):
    one, other = tmp_path / "one.dbh", tmp_path / "other.dbh"
    begun = begin(one)
    begun.close()
    shutil.copytree(one, other)
    states = []
    for folder, n in ((one, 1.5), (other, 2.5)):
        session = reopened(folder, begun)
        session.do(command(n))
        states.append(of(session)[0])
        session.close()
    shutil.copy(other / "undo.log", one / "undo.log")
    again = reopened(one, begun)
    assert "another story" in again.reopening_notes[0]
    assert of(again)[0] == states[0] != states[1]
    again.close()


def test_a_log_that_is_a_link_keeps_nothing_from_being_changed_and_undone(tmp_path, by_hand):
    folder, elsewhere = tmp_path / "plot.dbh", tmp_path / "elsewhere"
    begun = begin(folder)
    begun.do(commands.delete_trunk(1))
    begun.close()
    begun = reopened(folder, begun)
    begun.do(commands.delete_trunk(2))
    abandon(begun)
    (folder / "undo.log").rename(elsewhere)
    try:
        (folder / "undo.log").symlink_to(elsewhere)
    except OSError:
        pytest.skip("no links may be made here")
    content = elsewhere.read_bytes()
    session = reopened(folder, begun)
    assert of(session) == of(begun)
    session.do(commands.delete_trunk(3))
    expected = of(session)
    abandon(session)
    again = reopened(folder, begun)
    assert of(again) == expected and not (folder / "undo.log").is_symlink()
    again.close()
    assert elsewhere.read_bytes() == content
    assert [entry.what for entry in read_history(folder)][1:] == [f"Delete trunk {i}" for i in (1, 2, 3)]


def test_the_history_has_every_step_also_where_it_is_newer_than_the_rest(tmp_path, by_hand):
    """All but the history is brought back from a backup, work goes on, and the program is killed."""
    folder, backup = tmp_path / "plot.dbh", tmp_path / "backup"
    begun = begin(folder)
    begun.close()
    shutil.copytree(folder, backup)
    session = reopened(folder, begun)
    for trunk_id in (1, 2):
        session.do(commands.delete_trunk(trunk_id))
    session.close()
    shutil.copytree(backup, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("history*", "lock"))
    session = reopened(folder, begun)
    assert session.document.trunks.ids == (1, 2, 3, 4)
    session.do(commands.delete_trunk(4))
    abandon(session)
    reopened(folder, begun).close()
    again = reopened(folder, begun)
    again.close()
    assert [entry.what for entry in read_history(folder)][-1] == "Delete trunk 4"
    assert len(read_history(folder)) == 4


def test_at_whatever_call_the_program_ends_the_history_has_every_step_once(tmp_path, by_hand, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 4)
    counting = Fate()
    work(tmp_path / "count.dbh", begin(tmp_path / "count.dbh"), counting)
    for at in range(counting.n_calls):
        folder = tmp_path / f"plot-{at}.dbh"
        session = begin(folder)
        saver = session.saver
        work(folder, session, Fate(at))
        abandon(session, saver)
        n_steps = read_plot(folder).states.number
        reopened(folder, session).close()
        assert [entry.number for entry in read_history(folder)] == list(range(n_steps + 1)), f"after call {at}"


def test_what_is_done_before_the_log_is_shortened_is_in_the_history_after_a_kill(tmp_path, by_hand, monkeypatch):
    monkeypatch.setattr(autosave, "_MOST_LOG_STEPS", 2)
    session = begin(tmp_path / "plot.dbh")
    for trunk_id in (1, 2, 3):
        session.do(commands.delete_trunk(trunk_id))
    shorten = session.saver._shorten_log

    def a_moment_later() -> None:
        session.do(commands.delete_trunk(4))
        shorten()

    monkeypatch.setattr(session.saver, "_shorten_log", a_moment_later)
    session.saver.flush()
    abandon(session)
    assert [entry.what for entry in read_history(tmp_path / "plot.dbh")][1:] == [
        f"Delete trunk {i}" for i in range(1, 5)
    ]


def test_a_name_that_is_no_text_keeps_no_step_from_being_noted(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session = begin(folder, author="Ad\udce9le")
    session.do(commands.delete_trunk(1))
    expected = of(session)
    abandon(session)
    again = reopened(folder, session)
    assert of(again) == expected
    again.close()
