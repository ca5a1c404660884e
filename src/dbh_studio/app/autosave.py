"""Keeps a Session's saved plot up to date: every command is saved, and the person is told when one could not be."""

from __future__ import annotations

import atexit
import contextlib
import getpass
import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

from dbh_studio.app.document import Document
from dbh_studio.app.saved_states import state_from_document, states_from_history
from dbh_studio.app.session import HISTORY_LIMIT, Change, History, Session
from dbh_studio.errors import ProjectError
from dbh_studio.io.project import (
    HistoryEntry,
    ProjectWriter,
    SavedPlot,
    SavedUndo,
    UndoStates,
    read_history,
    within,
)

# The environment variable with the name that decisions are signed with.
AUTHOR_VARIABLE = "DBH_STUDIO_AUTHOR"
COMMAND_LINE = "command line"

_log = logging.getLogger(__name__)

# How long nothing must happen before the plot itself is saved; until then the undo log has what was done.
_QUIET_S = 20.0
# After a save that failed.
_RETRY_S = 5.0
# Beyond this the undo log is written anew with half of it; a trunk of a dense plot is a quarter of a megabyte.
_MOST_LOG_BYTES = 256_000_000
_MOST_LOG_STEPS = 4 * HISTORY_LIMIT


@dataclass(frozen=True)
class SaveStatus:
    """Whether the plot on disk is the plot on the screen.

    Attributes:
        state: ``saved``, ``saving`` or ``not_saved``.
        problem: Why it is not saved, and what to do; else empty.
    """

    state: Literal["saved", "saving", "not_saved"]
    problem: str = ""


class Autosave:
    """Saves after each command, on a thread of its own so that an edit does not wait for the disk.

    Each command is handed to the system, for the undo log, before anybody hears of it: if the program is killed then,
    the command is there. The thread makes that outlast a power cut, within milliseconds, and saves the plot itself when
    nothing has happened for a while, and at the end. What fails leaves what was saved intact, is reported, and is
    tried again every few seconds, with the next command and at the end.

    Args:
        session: The plot; its `saver` becomes this.
        writer: The right to write its folder; closed with this.
        background: Save on a thread; otherwise before the command returns, and the plot itself each time.
        author: Whom the history names; see `author_of` for who it is by default.
        opened: What was read of the folder, where the plot comes from there; None where it is new there.
        is_new: Save the state at hand, too; by default where nothing was read.
        label: What the history says of that.
        quiet_s: How long nothing must happen before the plot itself is saved.
        retry_s: How long after a save that failed it is tried again.
        most_log_bytes: How long the undo log may become before the oldest steps are dropped.
    """

    def __init__(
        self,
        session: Session,
        writer: ProjectWriter,
        *,
        background: bool = True,
        author: str | None = None,
        opened: SavedPlot | None = None,
        is_new: bool | None = None,
        label: str = "Create the plot",
        quiet_s: float = _QUIET_S,
        retry_s: float = _RETRY_S,
        most_log_bytes: int = _MOST_LOG_BYTES,
    ) -> None:
        self._session = session
        self._writer = writer
        self._author = author_of(is_command=not background) if author is None else author
        self._quiet_s, self._retry_s, self._most_log_bytes = quiet_s, retry_s, most_log_bytes
        self._condition = threading.Condition()
        self._saving = threading.Lock()
        self._entries: list[HistoryEntry] = []
        self._has_news = self._is_closing = False
        # The Document in project.json, by identity; None where it holds another, or must be written anyway.
        self._saved: Document | None = None
        # The undo log that project.json names: what stands in another is not found again.
        self._named_log = ""
        self._is_log_behind = False
        # How much was done to the plot, and noted in its history.
        self._number = self._n_noted()
        # Whether the folder holds the plot in some state: it must not lose the way to what was done since.
        self._was_there = opened is not None
        if opened is not None:
            self._adopt(opened)
        is_new = opened is None if is_new is None else is_new
        if is_new:
            self._saved = None
            self._entries.append(self._entry(label))
        self._status = SaveStatus("saved")
        self._listeners: list[Callable[[SaveStatus], None]] = []
        self._thread: threading.Thread | None = None
        # Before the first save: a command that comes while it runs is saved next.
        self._ends = (session.record_with(self._record), session.subscribe(self._on_change))
        self._save_due(thoroughly=is_new or not background)
        session.saver = self
        atexit.register(self.close)
        if background:
            self._thread = threading.Thread(target=self._run, name="autosave", daemon=True)
            self._thread.start()

    def _adopt(self, opened: SavedPlot) -> None:
        """Go on with what was read of the folder."""
        self._writer.adopt(opened)
        if self._writer.undo_log.is_open:
            self._named_log = self._writer.undo_log.id
            # A program that was killed may have left to the system what was not on the disk yet.
            with contextlib.suppress(OSError):
                self._writer.undo_log.sync()
        self._number = opened.states.number
        if opened.is_at_hand:
            self._saved = self._session.document
        # What was done last may be in the undo log only. Not told by number: beside a log that was lost, or brought
        # back from a backup, the history may have had the same numbers for other steps.
        with contextlib.suppress(ProjectError):
            noted = set(read_history(self._writer.folder))
            self._entries = [entry for entry in opened.recovered if entry not in noted]

    def _n_noted(self) -> int:
        with contextlib.suppress(ProjectError):
            return max((entry.number for entry in read_history(self._writer.folder)), default=0)
        return 0

    @property
    def author(self) -> str:
        """Whom the history names."""
        return self._author

    @property
    def folder(self) -> Path:
        """The saved plot."""
        return self._writer.folder

    @property
    def status(self) -> SaveStatus:
        """Whether everything is saved."""
        return self._status

    def subscribe(self, listener: Callable[[SaveStatus], None]) -> Callable[[], None]:
        """Call `listener`, on the saving thread, whenever the status changes; returns the function that ends it."""
        self._listeners.append(listener)

        def unsubscribe() -> None:
            with contextlib.suppress(ValueError):
                self._listeners.remove(listener)

        return unsubscribe

    def flush(self) -> bool:
        """Save what is not saved, now; whether everything is."""
        self._save_due(thoroughly=False)
        return self._status.state == "saved"

    def close(self) -> SaveStatus:
        """Save what is left and release the folder; whether it could be saved, which is logged where it could not.

        Also done when the program ends.
        """
        atexit.unregister(self.close)
        if self._is_closing:
            return self._status
        for end in self._ends:
            end()
        with self._condition:
            self._is_closing = True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._save_due()
        self._writer.close()
        if self._status.state == "not_saved":
            _log.error("%s lacks the last changes. %s", self.folder.name, self._status.problem)
        return self._status

    # ---- as it happens

    def _record(self, change: Change) -> None:
        """Hand a step to the system; no other happens meanwhile, and nobody has heard of this one."""
        self._number += 1
        entry = self._entry(change.label, self._number)
        with self._condition:
            self._entries.append(entry)
            self._has_news = True
        before, after = state_from_document(change.before), state_from_document(change.after)
        is_noted = False
        try:
            log = self._writer.undo_log
            is_noted = log.append(change.kind, entry, before, after, next_id=self._session.next_id)
        except OSError as error:
            is_noted = True  # kept, and tried again with the rest
            _log.warning("A step is not in the undo log yet: %s", error)
        finally:
            self._is_log_behind |= not is_noted

    def _on_change(self, change: Change) -> None:
        with self._condition:
            self._condition.notify()
        # A plot without an undo log gets one now, so that this step is safe, too, before it is shown.
        if self._thread is None or (self._is_log_behind and self._status.state != "not_saved"):
            self._save_due(thoroughly=self._thread is None)

    # ---- soon after

    def _run(self) -> None:
        while True:
            with self._condition:
                patience_s = self._patience_s()
                is_news = self._condition.wait_for(lambda: self._is_closing or self._has_news, patience_s)
                if self._is_closing:
                    return
                self._has_news = False
            self._save_due(thoroughly=not is_news)

    def _patience_s(self) -> float | None:
        """How long to wait for news before something is to be done without."""
        if self._status.state == "not_saved" or self._is_log_behind or self._writer.undo_log.is_behind:
            return self._retry_s
        return None if self._session.document is self._saved else self._quiet_s

    def _save_due(self, *, thoroughly: bool = True) -> None:
        """Save the Document as it is now, unless it is the one on disk and the history is complete.

        Args:
            thoroughly: Save the plot itself, even where the undo log has it all.
        """
        with self._saving:
            with self._session.held() as history, self._condition:
                entries, number = tuple(self._entries), self._number
            is_noted = not (self._is_log_behind or self._writer.undo_log.is_behind)
            is_saved = history.present is self._saved and is_noted
            if not entries and (is_saved or not (thoroughly or self._status.state == "not_saved")):
                return
            self._set_status(SaveStatus("saving"))
            try:
                self._make_safe(history, number, thoroughly=thoroughly)
                self._write_history(entries)
                self._shorten_log()
            except ProjectError as error:
                self._set_status(SaveStatus("not_saved", str(error)))
            except Exception as error:  # noqa: BLE001 - the session must live on, and the person must hear of it
                _log.exception("Saving failed")
                self._set_status(SaveStatus("not_saved", f"The plot could not be saved ({error})."))
            else:
                self._set_status(SaveStatus("saved"))

    def _make_safe(self, history: History, number: int, *, thoroughly: bool) -> None:
        """See to it that all up to `history` outlasts a power cut: in the undo log or in the plot itself."""
        log = self._writer.undo_log
        if log.is_open and not log.is_doubtful and not self._is_log_behind:
            try:
                log.sync()
            except OSError as error:
                _log.warning("The undo log could not be written: %s", error)
                self._save_plot(history, number)
                return
            if thoroughly and history.present is not self._saved:
                try:
                    self._save_plot(history, number)
                except ProjectError as error:  # nothing is lost: the undo log has it all
                    _log.warning("The plot is in its undo log only: %s", error)
            return
        self._begin_log()

    def _save_plot(self, history: History, number: int) -> None:
        log = self._writer.undo_log
        undo = SavedUndo(log=log.id, number=number) if log.is_open else None
        self._writer.save(state_from_document(history.present), next_id=history.next_id, undo=undo)
        self._saved, self._was_there = history.present, True
        self._named_log = undo.log if undo is not None else ""

    def _begin_log(self) -> None:
        """Write the undo log anew where it cannot be gone on with; the plot itself is saved in any case."""
        log = self._writer.undo_log
        with self._session.held() as history:
            number = self._number
            states = self._begun_anew(history)
        if self._was_there and not log.is_open and history.present is not self._saved:
            # First, for what is in the old log only goes with it.
            self._save_plot(history, number)
        is_written = False
        try:
            if self._was_there and not log.is_open:
                self._writer.put_log_aside()
            # In place of one that is open under its name: what the plot says of it stays true.
            log.write_anew(states, log_id=log.id if log.is_open else "")
            is_written = True
        except (OSError, ProjectError, ValueError) as error:
            _log.warning("The undo log could not be written: %s", error)
        # A log that project.json does not name yet keeps nothing safe, also where the next line fails.
        self._is_log_behind = not is_written or log.id != self._named_log
        self._save_plot(history, number)
        self._is_log_behind = not is_written

    def _shorten_log(self) -> None:
        """Write the undo log anew without the oldest steps, where it is long; what they were is in the history."""
        log = self._writer.undo_log
        if not log.is_open or (log.size_bytes <= self._most_log_bytes and log.n_steps <= _MOST_LOG_STEPS):
            return
        with self._session.held() as history, self._condition:
            states, entries = self._begun_anew(history), tuple(self._entries)
        try:
            # Who did what is not said again in the new log.
            with contextlib.suppress(ProjectError):  # told with the next save
                self._write_history(entries)
            log.write_anew(states, log_id=log.id)
        except OSError as error:  # it goes on as it is
            _log.warning("The undo log could not be shortened: %s", error)
        # Where what must stay is long, or the disk is full, not with every command again.
        self._most_log_bytes = max(self._most_log_bytes, 2 * log.size_bytes)

    def _begun_anew(self, history: History) -> UndoStates:
        """What the undo log is to hold when it is written anew; called while nothing can happen to the plot."""
        states = states_from_history(history, self._number)
        states = within(states, max_steps=HISTORY_LIMIT, max_bytes=self._most_log_bytes // 2)
        # A step back to a state that the log has not could not be followed, nor anything after it.
        self._session.forget_before(len(states.past))
        self._writer.undo_log.begin_anew(states)
        return states

    def _write_history(self, entries: tuple[HistoryEntry, ...]) -> None:
        """Write the first of what the history lacks; where that fails, it lacks them still."""
        self._writer.log(entries)
        with self._condition:
            del self._entries[: len(entries)]

    def _set_status(self, status: SaveStatus) -> None:
        if status == self._status:
            return
        self._status = status
        for listener in tuple(self._listeners):
            try:
                listener(status)
            except Exception:  # noqa: BLE001 - the others must hear of it
                _log.exception("A listener of the save status failed")

    def _entry(self, label: str, number: int = 0) -> HistoryEntry:
        when = datetime.now(timezone.utc).isoformat(timespec="seconds")
        return HistoryEntry(when, self._author, label, number)


def author_of(*, is_command: bool) -> str:
    """Whom the history names: whoever `AUTHOR_VARIABLE` names, else the system's user.

    Args:
        is_command: A command does it, without a person at the studio: then not the user, for who signs in to a computer
            that runs commands is often nobody in particular.
    """
    named = os.environ.get(AUTHOR_VARIABLE, "").strip()
    return named or (COMMAND_LINE if is_command else user_name())


def user_name() -> str:
    """Who is signed in to the system; empty where that cannot be told."""
    # Which of these it raises where there is no such user depends on the version of Python.
    with contextlib.suppress(OSError, KeyError, ImportError):
        return getpass.getuser()
    return ""
