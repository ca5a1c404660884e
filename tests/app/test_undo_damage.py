"""Undo logs that are damaged, missing or made up: the plot opens, and what is lost is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.app.random_edits import N_POINTS, of
from tests.app.test_undo_saving import abandon, begin, by_hand, reopened

from dbh_studio.app import commands
from dbh_studio.app.saved_states import history_from_states
from dbh_studio.app.session import Session
from dbh_studio.io import undo_log
from dbh_studio.io.project import read_plot

__all__ = ["by_hand"]

# ---- a log that cannot be used


def _closed(folder: Path) -> tuple[Session, tuple]:
    session = begin(folder)
    session.do(commands.delete_trunk(1))
    session.do(commands.set_tree_record(2, species="oak"))
    session.close()
    return session, of(session)


def _behind(folder: Path) -> tuple[Session, tuple]:
    """As `_closed`, but ended after a further edit that is in the log only."""
    session, _ = _closed(folder)
    again = reopened(folder, session)
    again.do(commands.rename_plot("later"))
    abandon(again)
    return session, of(again)


def _flipped(path: Path, where: Callable[[bytes], int]) -> None:
    content = bytearray(path.read_bytes())
    content[where(bytes(content))] ^= 0x20
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: path.unlink(), "No such file"),
        (lambda path: path.write_bytes(b""), "beginning cannot be read"),
        (lambda path: path.write_bytes(b"\xdbUnd" + b"\xff" * 200), "beginning cannot be read"),
        (lambda path: path.write_bytes(path.read_bytes()[:-30]), "it ends before the plot was saved"),
        (lambda path: _flipped(path, lambda content: 40), "beginning cannot be read"),
        (lambda path: _flipped(path, lambda content: content.index(b"Delete trunk 1")), "it ends before"),
    ],
    ids=["missing", "empty", "garbage", "cut", "begin", "middle"],
)
def test_a_damaged_log_keeps_no_plot_from_opening_and_is_told(tmp_path, by_hand, damage, words):
    folder = tmp_path / "plot.dbh"
    session, expected = _closed(folder)
    damage(folder / "undo.log")
    again = reopened(folder, session)
    (note,) = again.reopening_notes
    assert "cannot be undone any more" in note and words in note and "Lost" not in note
    assert of(again)[0] == expected[0] and not again.can_undo
    again.do(commands.delete_trunk(2))
    now = of(again)
    abandon(again)  # safe at once, in a log begun anew
    last = reopened(folder, session)
    assert of(last) == now and last.undo_label == "Delete trunk 2"
    last.close()
    assert len(list(folder.glob("undo-damaged-*.log"))) == (0 if "No such" in words else 1)


def test_what_is_lost_with_a_damaged_log_is_named(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, _ = _behind(folder)
    _flipped(folder / "undo.log", lambda content: content.index(b"Delete trunk 1"))
    again = reopened(folder, session)
    assert "Lost, and to be done again: «Rename the plot" in again.reopening_notes[0]
    again.close()


def test_what_comes_before_a_damaged_place_is_kept(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, expected = _behind(folder)
    again = reopened(folder, session)
    again.do(commands.delete_trunk(3))
    again.do(commands.delete_trunk(4))
    abandon(again)
    _flipped(folder / "undo.log", lambda content: content.index(b"Delete trunk 3"))
    last = reopened(folder, session)
    assert "there, up to «" in last.reopening_notes[0]
    assert "Lost, and to be done again: «Delete trunk 4»" in last.reopening_notes[1]
    assert of(last)[:2] == expected[:2]
    last.close()
    assert read_plot(folder).notes == ()


def test_a_log_of_another_plot_is_not_believed(tmp_path, by_hand):
    first, second = tmp_path / "a.dbh", tmp_path / "b.dbh"
    session, expected = _closed(first)
    _closed(second)
    (first / "undo.log").write_bytes((second / "undo.log").read_bytes())
    again = reopened(first, session)
    assert "another plot" in again.reopening_notes[0]
    assert of(again)[0] == expected[0]
    again.close()


def test_a_killed_program_is_told_on_opening(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, expected = _behind(folder)
    again = reopened(folder, session)
    assert again.reopening_notes == (
        f"The plot was not closed last time. Nothing is lost: the last change is there, up to «{again.undo_label}».",
    )
    assert of(again) == expected
    again.close()
    with (folder / "undo.log").open("ab") as log:
        log.write(b"\xdbUnd half a step")
    last = reopened(folder, session)
    assert last.reopening_notes == ("One change was still being written when the program ended; it is not there.",)
    last.do(commands.delete_trunk(2))
    now = of(last)
    abandon(last)
    final = reopened(folder, session)
    assert of(final) == now
    final.close()


# ---- logs that somebody has made


def _reframed(path: Path, change: Callable[[list[dict[str, Any]]], object], points_at_end: bytes = b"") -> None:
    """Change the records of a log and write it so that its check sums fit."""
    content = memoryview(path.read_bytes())
    parts = [(record, bytes(points)) for record, points, _ in undo_log._records(content)]
    change([record for record, _ in parts])
    parts[-1] = parts[-1][0], points_at_end or parts[-1][1]
    path.write_bytes(b"".join(undo_log._framed(record, [points]) for record, points in parts))


def test_a_log_in_which_two_trunks_share_points_is_not_believed(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, _ = _behind(folder)

    def share(records: list[dict[str, Any]]) -> None:
        records[-1]["trunks"] = {"new": [[99, 9, "hand", 3]], "came": [99], "next_id": 10}

    _reframed(folder / "undo.log", share, np.arange(21, 24, dtype="<i4").tobytes())
    again = reopened(folder, session)
    assert "share points" in again.reopening_notes[0] and "Lost, and to be done again" in again.reopening_notes[0]
    assert again.document.trunks.ids == (2, 3, 4)
    again.close()


def _mutated(value: Any, rng: np.random.Generator) -> Any:
    """The value with one part of it replaced by something odd."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        return {**value, key: _mutated(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = int(rng.integers(len(value)))
        return [*value[:at], _mutated(value[at], rng), *value[at + 1 :]]
    odd = [None, -1, 0, 10**30, "", "x", [], {}, [[1]], {"1": None}, 1.5, True, "do", "mark"]
    return odd[int(rng.integers(len(odd)))]


def test_a_log_of_odd_content_never_keeps_a_plot_from_opening(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, _ = _behind(folder)
    whole, rng = (folder / "undo.log").read_bytes(), np.random.default_rng(0)
    n_usable = 0
    for _ in range(150):
        (folder / "undo.log").write_bytes(whole)

        def mutate(records: list[dict[str, Any]]) -> None:
            record = records[int(rng.integers(len(records)))]
            key = str(rng.choice(list(record)))
            record[key] = _mutated(record[key], rng)

        _reframed(folder / "undo.log", mutate)
        plot = read_plot(folder)
        trunks = plot.states.present.trunks
        points = np.concatenate([np.empty(0, np.int32), *(trunk.points for trunk in trunks)])
        assert len(np.unique(points)) == len(points) and points.max(initial=0) < N_POINTS
        n_usable += plot.log is not None
        try:
            history_from_states(plot.states, session.document.source)
        except ValueError:
            assert plot.log is not None  # `opening` then leaves out what can be undone
    assert 0 < n_usable < 150


def test_a_log_cut_or_flipped_anywhere_gives_a_state_that_was_there(tmp_path, by_hand):
    folder = tmp_path / "plot.dbh"
    session, expected = _behind(folder)
    source, whole, rng = session.document.source, (folder / "undo.log").read_bytes(), np.random.default_rng(1)
    states = [expected[0], *(state for _, state in expected[1])]
    for _ in range(150):
        content = bytearray(whole)
        if rng.random() < 0.5:
            del content[int(rng.integers(len(content))) :]
        else:
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
        (folder / "undo.log").write_bytes(content)
        plot = read_plot(folder)
        history = history_from_states(plot.states, source)
        assert of(Session(session.cloud, history.present, history=history))[0] in states
        assert plot.notes
