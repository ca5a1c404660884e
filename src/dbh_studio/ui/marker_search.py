"""The finds of the last search for markers, shared by all tabs, and the search itself as a job."""

from __future__ import annotations

import threading
from functools import partial
from typing import TYPE_CHECKING

from dbh_studio.app.autosave import Autosave
from dbh_studio.app.document import CameraSource, Document
from dbh_studio.app.marker_cache import keep_detections, kept_detections
from dbh_studio.app.scaling import MarkerSearch, apply_search, search_markers, sides_of, strike_out, use_marker
from dbh_studio.errors import StudioError
from dbh_studio.settings import MarkerSettings

if TYPE_CHECKING:
    from pathlib import Path

    from dbh_studio.app.session import Session
    from dbh_studio.stages.marker_detect import Detection
    from dbh_studio.ui.studio import Studio

Problem = tuple[str, str, str]
"""(marker, why it is not used, what to do)."""


class MarkerFinds:
    """What was found for the open plot."""

    def __init__(self, studio: Studio) -> None:
        self._studio = studio
        self._lock = threading.Lock()
        self._session: Session | None = None
        self._cameras: CameraSource | None = None
        self._detections: tuple[Detection, ...] | None = None
        self.problems: tuple[Problem, ...] = ()

    def of(self, session: Session) -> tuple[Detection, ...] | None:
        """All finds, those struck out among them; None where the photos have not been searched."""
        cameras = session.cameras
        if cameras is None:
            return None
        with self._lock:
            if session is not self._session or cameras.source != self._cameras:
                folder = _folder(session)
                kept = None if folder is None else kept_detections(folder, cameras.source, cameras.posed)
                self._session, self._cameras, self._detections, self.problems = session, cameras.source, kept, ()
            return self._detections

    def search(self, side_m: float) -> None:
        """Look for markers in a child process; scale and markers come back as one undoable step.

        Args:
            side_m: Of markers that were not found before.

        Raises:
            StudioError: There are no photos, or another job runs.
        """
        session = self._studio.session
        if session is None or session.cameras is None:
            raise StudioError("This plot has no photos yet.", "Add them first.")
        document, cameras = session.document, session.cameras
        settings = MarkerSettings().changed(side_m=side_m)
        call = (cameras.posed, sides_of(document), document.evidence.struck, settings)
        done = partial(self._searched, session, document)
        self._studio.start_job("Finding markers", search_markers, call, session, done)

    def _searched(self, session: Session, document: Document, search: MarkerSearch) -> None:
        cameras = document.cameras
        if cameras is None:
            return
        with self._lock:
            self._session, self._cameras, self._detections = session, cameras, search.detections
            verdict = search.report.verdict
            said = [("", verdict.message, verdict.remedy)] if verdict.level != "good" else []
            others = [
                (name, why.reason, why.remedy) for name, why in search.problems if why.reason not in verdict.message
            ]
            self.problems = (*said, *others)
        folder = _folder(session)
        if folder is not None:
            keep_detections(folder, cameras, search.detections)
        # Also where no scale comes of it: the pictures show why.
        self._studio.refresh_tabs()
        session.do(apply_search(session.document, search), based_on=document, reads=("cameras",))

    def strike(self, session: Session, sight: tuple[str, str, int], *, struck: bool) -> None:
        """Leave one find out, or take it in again: one undoable step."""
        detections, cameras = self.of(session), session.cameras
        if detections is None or cameras is None:
            return
        if not any((each.image, *each.key) == sight for each in detections):
            return
        session.do(strike_out(session.document, detections, cameras.posed, sight, struck=struck))

    def use(self, session: Session, marker: tuple[str, int], side_m: float) -> None:
        """Believe a marker that was left out because few photos show it: one undoable step."""
        detections, cameras = self.of(session), session.cameras
        if detections is not None and cameras is not None and any(each.key == marker for each in detections):
            session.do(use_marker(session.document, detections, cameras.posed, marker, side_m))


def _folder(session: Session) -> Path | None:
    saver = session.saver
    return saver.folder if isinstance(saver, Autosave) else None
