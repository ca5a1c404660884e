"""The history of a saved plot: what was done, by whom and when, one JSON line each, for people and for export.

Nothing is computed from it: what Undo needs is kept in `io.undo_log`.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from dbh_studio.errors import ProjectError
from dbh_studio.io.ownfile import open_own_file

HISTORY_FILE = "history.jsonl"
_UNDO, _REDO = "Undo: ", "Redo: "


@dataclass(frozen=True)
class HistoryEntry:
    """One thing that was done to a plot.

    Attributes:
        when: ISO 8601, UTC; empty where the line does not say.
        who: Who did it; empty where nobody signed.
        what: As on the Undo button: ``Delete trunk 5``, ``Undo: Delete trunk 5``.
        number: Counts what was done to the plot; 0 where it was noted by an earlier program.
    """

    when: str
    who: str
    what: str
    number: int = 0

    @property
    def kind(self) -> Literal["do", "undo", "redo"]:
        """Whether it was a command, or one taken back or done again."""
        if self.what.startswith(_UNDO):
            return "undo"
        return "redo" if self.what.startswith(_REDO) else "do"

    def line(self) -> str:
        """As it stands in the file."""
        content: dict[str, str | int] = {"when": self.when, "who": self.who, "what": self.what}
        if self.number:
            content["number"] = self.number
        return json.dumps(content, ensure_ascii=False) + "\n"


def read_history(folder: Path | str) -> list[HistoryEntry]:
    """What was done to a saved plot, the earliest first; empty where nothing is known.

    Lines that a full disk or a crash cut off, or that somebody wrote into the file, are left out.

    Args:
        folder: The saved plot; another process may be writing it.

    Raises:
        ProjectError: There is a history but it cannot be read.
    """
    path = Path(folder) / HISTORY_FILE
    try:
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ProjectError(f"The history of {path.parent.name} cannot be read ({error.strerror or error}).") from error
    return [entry for entry in map(_entry_of, lines) if entry is not None]


def _entry_of(line: bytes) -> HistoryEntry | None:
    try:
        content = json.loads(line.decode("utf-8", errors="replace"))
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or not isinstance(content.get("what"), str):
        return None
    when, who, number = content.get("when"), content.get("who"), content.get("number")
    return HistoryEntry(
        when if isinstance(when, str) else "",
        who if isinstance(who, str) else "",
        content["what"],
        number if isinstance(number, int) and not isinstance(number, bool) and number > 0 else 0,
    )


def append_history(folder: Path, entries: Iterable[HistoryEntry]) -> None:
    """Append to the history.

    Raises:
        ProjectError: It cannot be written.
    """
    text = "".join(entry.line() for entry in entries)
    if not text:
        return
    try:
        descriptor = open_own_file(folder / HISTORY_FILE, os.O_RDWR | os.O_CREAT | os.O_APPEND)
        with open(descriptor, "a+b") as file:
            _append_whole(file, text.encode("utf-8", errors="replace"))
    except OSError as error:
        raise ProjectError(f"The history of the plot could not be written ({error.strerror or error}).") from error


def put_history_aside(folder: Path) -> None:
    """Begin a new history, where another plot is to be saved in place of the one that is there.

    Raises:
        ProjectError: It cannot be renamed.
    """
    history = folder / HISTORY_FILE
    aside = (history.with_stem(f"{history.stem}-{number}") for number in itertools.count(1))
    try:
        history.rename(next(path for path in aside if not os.path.lexists(path)))
    except FileNotFoundError:
        pass
    except OSError as error:
        raise ProjectError(f"The history of the plot could not be put aside ({error.strerror or error}).") from error


def _append_whole(file: IO[bytes], content: bytes) -> None:
    """Append lines, after closing a line that a full disk or a crash cut off; all of them or nothing."""
    end = file.seek(0, os.SEEK_END)
    if end:
        file.seek(end - 1)
        if file.read(1) != b"\n":
            content = b"\n" + content
    try:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    except OSError:
        # They are tried again, and half of them would then be there twice.
        os.ftruncate(file.fileno(), end)
        raise
