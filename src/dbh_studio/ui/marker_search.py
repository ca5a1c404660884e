"""The finds of the last search for markers, shared by all tabs, and the search itself as a job."""

from __future__ import annotations

import threading
from functools import partial
from typing import TYPE_CHECKING

from dbh_studio.app.autosave import Autosave
from dbh_studio.app.cameras import require_fit
from dbh_studio.app.commands import Command
from dbh_studio.app.document import CameraSource, Document
from dbh_studio.app.found_markers import (
    MarkerSearch,
    apply_search,
    checks_of,
    place_markers,
    search_markers,
    sides_of,
    strike_out,
    use_marker,
)
from dbh_studio.app.marker_cache import keep_detections, kept_detections
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
            StudioError: There are no photos, they do not belong to the cloud, or another job runs.
        """
        session = self._studio.session
        if session is None or session.cameras is None:
            raise StudioError("This plot has no photos yet.", "Add them first.")
        document, cameras = session.document, session.cameras
        require_fit(cameras)
        settings = MarkerSettings().changed(side_m=side_m)
        call = (cameras.posed, sides_of(document), document.evidence.struck, settings, checks_of(document))
        done = partial(self._searched, session, document)
        self._studio.start_job("Finding markers", search_markers, call, session, done)

    def _searched(self, session: Session, document: Document, search: MarkerSearch) -> None:
        cameras = document.cameras
        if cameras is None:
            return
        with self._lock:
            self._session, self._cameras, self._detections = session, cameras, search.detections
            self.problems = _problems(search)
        folder = _folder(session)
        if folder is not None:
            keep_detections(folder, cameras, search.detections)
        # Also where no scale comes of it: the pictures show why.
        self._studio.refresh_tabs()
        command = apply_search(session.document, search, keep_number=True)
        session.do(command, based_on=document, reads=("cameras",))

    def strike(self, session: Session, sight: tuple[str, str, int], side_m: float, *, struck: bool) -> None:
        """Leave one find out, or take it in again: one undoable step. `side_m` is of markers not placed before."""
        detections, cameras = self.of(session), session.cameras
        if detections is None or cameras is None:
            return
        if not any((each.image, *each.key) == sight for each in detections):
            return
        settings = MarkerSettings().changed(side_m=side_m)
        command = strike_out(session.document, detections, cameras.posed, sight, struck=struck, settings=settings)
        self._do(session, command, settings)

    def use(self, session: Session, marker: tuple[str, int], side_m: float, others_m: float) -> None:
        """Believe a marker that was left out: one undoable step. `others_m` is the side of those not placed before."""
        detections, cameras = self.of(session), session.cameras
        if detections is not None and cameras is not None and any(each.key == marker for each in detections):
            settings = MarkerSettings().changed(side_m=others_m)
            command = use_marker(session.document, detections, cameras.posed, marker, side_m, settings)
            self._do(session, command, settings)

    def _do(self, session: Session, command: Command, settings: MarkerSettings) -> None:
        """Do it, and say anew what is wrong: what was said of the search may be mended by it."""
        document = command.apply(session.document)
        detections, cameras = self.of(session), session.cameras
        if detections is not None and cameras is not None:
            struck = document.evidence.struck
            search = place_markers(detections, cameras.posed, sides_of(document), struck, settings, checks_of(document))
            self.problems = _problems(search)
        session.do(command)


def _problems(search: MarkerSearch) -> tuple[Problem, ...]:
    """What is not said by the known lengths themselves: why there is no scale, and why markers were left out."""
    verdict = search.report.verdict
    is_refused = verdict.level == "refused" and not search.squares
    said = [("", verdict.message, verdict.remedy)] if is_refused or verdict.code == "default_side" else []
    others = [
        (name, why.reason, why.remedy) for name, why in search.problems if not said or why.reason not in verdict.message
    ]
    return (*said, *others)


def _folder(session: Session) -> Path | None:
    saver = session.saver
    return saver.folder if isinstance(saver, Autosave) else None
