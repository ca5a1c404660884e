"""Keeps a Session's saved plot up to date: every command is saved, and the person is told when one could not be."""

from __future__ import annotations

import atexit
import contextlib
import getpass
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

from dbh_studio.app.document import CameraSource, Document, SourceInfo
from dbh_studio.app.session import Change, Session
from dbh_studio.errors import ProjectError
from dbh_studio.io.project import CameraPlace, HistoryEntry, PlotState, ProjectWriter

_log = logging.getLogger(__name__)


def state_from_document(document: Document) -> PlotState:
    """What is saved of a Document: all of it."""
    source, cameras = document.source, document.cameras
    return PlotState(
        plot_id=document.plot_id,
        source_path=source.path,
        source_used=source.used,
        n_points=source.n_points,
        fingerprint=source.fingerprint,
        up_direction=document.up_direction,
        scale=document.scale,
        settings=document.settings,
        trunks=document.trunks,
        trees=document.trees,
        north_direction=document.north_direction,
        origin_src=document.origin_src,
        evidence=document.evidence,
        cameras=None if cameras is None else CameraPlace(cameras.path, cameras.images_dir, cameras.frame),
        masks=document.masks,
    )


def document_from_state(state: PlotState, source: SourceInfo) -> Document:
    """The Document that was saved, about `source`, which the caller has found to be the same cloud."""
    cameras = state.cameras
    return Document(
        plot_id=state.plot_id,
        source=source,
        up_direction=state.up_direction,
        scale=state.scale,
        settings=state.settings,
        trunks=state.trunks,
        trees=state.trees,
        north_direction=state.north_direction,
        origin_src=state.origin_src,
        evidence=state.evidence,
        cameras=None if cameras is None else CameraSource(cameras.path, cameras.images_dir, cameras.frame),
        masks=state.masks,
    )


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

    Commands that come while a save runs are saved together. A save that fails leaves the earlier one intact, is
    reported, and is tried again with the next command and at the end.

    Args:
        session: The plot; its `saver` becomes this.
        writer: The right to write its folder; closed with this.
        background: Save on a thread; otherwise before the command returns.
        author: Whom the history names; the system's user by default.
        is_new: Save the state at hand, too.
        label: What the history says of that.
    """

    def __init__(
        self,
        session: Session,
        writer: ProjectWriter,
        *,
        background: bool = True,
        author: str | None = None,
        is_new: bool = True,
        label: str = "Create the plot",
    ) -> None:
        self._session = session
        self._writer = writer
        self._author = user_name() if author is None else author
        self._condition = threading.Condition()
        self._saving = threading.Lock()
        self._entries: list[HistoryEntry] = []
        self._has_news = self._is_closing = False
        # The Document on disk, by identity; None where there is none yet.
        self._saved: Document | None = None if is_new else session.document
        self._status = SaveStatus("saved")
        self._listeners: list[Callable[[SaveStatus], None]] = []
        self._thread: threading.Thread | None = None
        if is_new:
            self._entries.append(self._entry(label))
        # Before the first save: a command that comes while it runs is saved next.
        self._unsubscribe = session.subscribe(self._on_change)
        self._save_due()
        session.saver = self
        atexit.register(self.close)
        if background:
            self._thread = threading.Thread(target=self._run, name="autosave", daemon=True)
            self._thread.start()

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
        self._save_due()
        return self._status.state == "saved"

    def close(self) -> SaveStatus:
        """Save what is left and release the folder; whether it could be saved, which is logged where it could not.

        Also done when the program ends.
        """
        atexit.unregister(self.close)
        if self._is_closing:
            return self._status
        self._unsubscribe()
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

    def _on_change(self, change: Change) -> None:
        with self._condition:
            self._entries.append(self._entry(change.label))
            self._has_news = True
            self._condition.notify()
        if self._thread is None:
            self._save_due()

    def _run(self) -> None:
        while True:
            with self._condition:
                # News, not what is due: a save that failed stays due, and waits for the next command.
                self._condition.wait_for(lambda: self._is_closing or self._has_news)
                if self._is_closing:
                    return
                self._has_news = False
            self._save_due()

    def _save_due(self) -> None:
        """Save the Document as it is now, unless it is the one on disk and the history is complete."""
        with self._saving:
            with self._condition:
                entries, self._entries = self._entries, []
                document, next_id = self._session.document, self._session.next_id
            if document is self._saved and not entries:
                return
            self._set_status(SaveStatus("saving"))
            try:
                self._writer.save(state_from_document(document), next_id=next_id)
                self._saved = document
                self._writer.log(entries)
            except ProjectError as error:
                self._keep_entries(entries, str(error))
            except Exception as error:  # noqa: BLE001 - the session must live on, and the person must hear of it
                _log.exception("Saving failed")
                self._keep_entries(entries, f"The plot could not be saved ({error}).")
            else:
                self._set_status(SaveStatus("saved"))

    def _keep_entries(self, entries: list[HistoryEntry], problem: str) -> None:
        """Keep what the history lacks, so that the next call saves."""
        with self._condition:
            self._entries = entries + self._entries
        self._set_status(SaveStatus("not_saved", problem))

    def _set_status(self, status: SaveStatus) -> None:
        if status == self._status:
            return
        self._status = status
        for listener in tuple(self._listeners):
            try:
                listener(status)
            except Exception:  # noqa: BLE001 - the others must hear of it
                _log.exception("A listener of the save status failed")

    def _entry(self, label: str) -> HistoryEntry:
        return HistoryEntry(datetime.now(timezone.utc).isoformat(timespec="seconds"), self._author, label)


def user_name() -> str:
    """Who is signed in to the system; empty where that cannot be told."""
    # Which of these it raises where there is no such user depends on the version of Python.
    with contextlib.suppress(OSError, KeyError, ImportError):
        return getpass.getuser()
    return ""
