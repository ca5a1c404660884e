"""The history of a plot, read whatever has happened to it."""

from __future__ import annotations

import errno
import os

import pytest

from dbh_studio.errors import ProjectError
from dbh_studio.io.history import HistoryEntry, append_history
from dbh_studio.io.project import read_history

ENTRIES = [
    HistoryEntry("2026-05-01T08:00:00+00:00", "Ada", "Delete trunk 5", 1),
    HistoryEntry("2026-05-01T08:00:09+00:00", "Ada", "Undo: Delete trunk 5", 2),
    HistoryEntry("2026-05-01T08:01:00+00:00", "Bob", "Redo: Delete trunk 5\n«twin»", 3),
]


def test_what_was_noted_is_read(tmp_path):
    assert read_history(tmp_path) == []
    append_history(tmp_path, ENTRIES[:2])
    append_history(tmp_path, [])
    append_history(tmp_path, ENTRIES[2:])
    assert read_history(tmp_path) == ENTRIES
    assert [entry.kind for entry in ENTRIES] == ["do", "undo", "redo"]


def test_half_lines_and_odd_ones_are_left_out(tmp_path):
    append_history(tmp_path, ENTRIES[:1])
    with (tmp_path / "history.jsonl").open("ab") as file:
        file.write(b'\n[]\n{"what": 3}\n\xff\xfe\n{"what": "old", "who": 7, "number": true}\n{"when": "20')
    append_history(tmp_path, ENTRIES[1:])
    assert read_history(tmp_path) == [ENTRIES[0], HistoryEntry("", "", "old"), *ENTRIES[1:]]
    (tmp_path / "history.jsonl").write_bytes(b"[" * 100_000)
    assert read_history(tmp_path) == []


def test_what_a_full_disk_took_half_of_is_not_there_twice_when_tried_again(tmp_path, monkeypatch):
    append_history(tmp_path, ENTRIES[:1])

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(ProjectError, match="No space left"):
            append_history(tmp_path, ENTRIES[1:])
    assert read_history(tmp_path) == ENTRIES[:1]
    append_history(tmp_path, ENTRIES[1:])
    assert read_history(tmp_path) == ENTRIES


def test_a_history_that_cannot_be_read_is_told(tmp_path):
    (tmp_path / "history.jsonl").mkdir()
    with pytest.raises(ProjectError, match="cannot be read"):
        read_history(tmp_path)
