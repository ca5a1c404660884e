"""The studio: one server, at most one open plot, any number of tabs that look at it."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from dbh_studio.app import pipeline
from dbh_studio.app.autosave import Autosave, SaveStatus
from dbh_studio.app.document import Document
from dbh_studio.app.jobs import Job, run_job
from dbh_studio.app.opening import open_plot, plot_name, read_cloud
from dbh_studio.app.session import Change, Session
from dbh_studio.core.arrays import Int32, Int64
from dbh_studio.core.progress import Progress
from dbh_studio.core.reconstruction import Reconstruction
from dbh_studio.errors import CancelledError, StudioError
from dbh_studio.io.project import FOLDER_SUFFIX, is_project
from dbh_studio.io.reader import SUPPORTED_SUFFIXES
from dbh_studio.ui.bind import TabWorker, for_each_tab
from dbh_studio.ui.display_cloud import DisplayCloud
from dbh_studio.ui.server import StudioServer
from dbh_studio.ui.tab import Tab
from dbh_studio.ui.uploads import UploadedFile, receive

log = logging.getLogger(__name__)

DEFAULT_DISPLAY_POINTS = 3_000_000


@dataclass(frozen=True)
class JobState:
    """What the progress bar shows."""

    title: str
    fraction: float = 0.0
    message: str = ""


class Studio:
    """Holds the open plot and the running job, and tells the tabs.

    Args:
        server: The wrapped viser server.
        uploads_folder: Where uploaded clouds are kept; the user's data folder by default.
        display_points: How many points a browser is sent at most.
    """

    def __init__(
        self, server: StudioServer, *, uploads_folder: Path | None = None, display_points: int = DEFAULT_DISPLAY_POINTS
    ) -> None:
        self.server = server
        self.session: Session | None = None
        self.display: DisplayCloud | None = None
        self.segmentation_notes: tuple[str, ...] = ()
        self._uploads_folder = uploads_folder or Path(platformdirs.user_data_dir("dbh-studio")) / "plots"
        self._display_points = display_points
        self._tabs: dict[int, Tab] = {}
        self._job: JobState | None = None
        self._stop_job: Callable[[], object] | None = None
        self._exported: Document | None = None
        self._lock = threading.RLock()
        server.viser.initial_camera.position = (0.0, -20.0, 6.0)
        server.viser.initial_camera.look_at = (0.0, 0.0, 1.0)
        server.viser.gui.main_panel.dock_right()
        server.viser.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False, brand_color=(43, 138, 62)
        )
        for_each_tab(server.viser, self._tab_opened)

    # ---- tabs

    def _tab_opened(self, worker: TabWorker) -> None:
        tab = Tab(self, worker)
        with self._lock:
            self._tabs[worker.client.client_id] = tab
        worker.on_close(lambda: self._forget_tab(worker.client.client_id))
        tab.show_job(self._job)

    def _forget_tab(self, client_id: int) -> None:
        with self._lock:
            self._tabs.pop(client_id, None)

    def _each_tab(self, action: Callable[[Tab], Any]) -> None:
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.worker.post(action, tab)

    # ---- the open plot

    def adopt(self, session: Session) -> None:
        """Show this plot in every tab, in place of the one that is open."""
        display = self._make_display(session)
        with self._lock:
            before, self.session, self.display = self.session, session, display
            self.segmentation_notes, self._exported = (), None
        if before is not None:
            before.close()
        session.subscribe(self._session_changed)
        if isinstance(session.saver, Autosave):
            session.saver.subscribe(self._save_status_changed)
        self._each_tab(Tab.adopt_session)
        self.measure_missing()

    def _make_display(self, session: Session) -> DisplayCloud:
        return DisplayCloud.of(
            session.cloud,
            session.points_world(),
            budget=self._display_points,
            is_metric=session.document.scale.is_known,
        )

    def _session_changed(self, change: Change) -> None:
        session = self.session
        if session is None:
            return
        if change.before.scale != change.after.scale or change.before.up_direction != change.after.up_direction:
            self.display = self._make_display(session)
        self._each_tab(lambda tab: tab.session_changed(change))
        self.measure_missing()

    def _save_status_changed(self, status: SaveStatus) -> None:
        self._each_tab(Tab.refresh_header)
        if status.state == "not_saved":
            self._each_tab(lambda tab: tab.worker.notify("Not saved", status.problem, "error"))

    def saved_text(self) -> str:
        """Where the plot is saved, or that it is not, in a few words."""
        session = self.session
        if session is None:
            return ""
        saver = session.saver
        if not isinstance(saver, Autosave):
            return "open for reading, changes are not saved"
        if saver.status.state == "not_saved":
            return f"NOT SAVED: {saver.status.problem}"
        return f"saved in {saver.folder.name}" if saver.status.state == "saved" else "saving …"

    def trunk_ids_at(self, rows: Int64) -> Int32:
        """(K,) trunk id of (K,) points of the display cloud, 0 where none.

        Looked up for the few points under a click: labels of the whole cloud would cost the first click after every
        edit a tenth of a second for ten million points.
        """
        session, display = self.session, self.display
        assert session is not None and display is not None
        points = display.indices[rows].astype(np.int32)
        ids = np.zeros(len(points), np.int32)
        for trunk in session.document.trunks:
            if len(trunk):
                at = np.minimum(np.searchsorted(trunk.points, points), len(trunk) - 1)
                ids[trunk.points[at] == points] = trunk.id
        return ids

    def exported(self, document: Document) -> None:
        """Remember which state of the plot was handed in."""
        self._exported = document
        self._each_tab(Tab.refresh)

    def is_exported(self) -> bool:
        """Whether the plot as it is now has been exported."""
        return self.session is not None and self._exported is self.session.document

    def formats(self) -> str:
        """The file formats that can be opened, for reading by a person."""
        return ", ".join(suffix.lstrip(".").upper() for suffix in SUPPORTED_SUFFIXES)

    def suffixes(self) -> tuple[str, ...]:
        """The suffixes that can be uploaded."""
        return tuple(SUPPORTED_SUFFIXES)

    # ---- long work

    def cancel_job(self) -> None:
        """Stop what runs; nothing of it is kept."""
        stop = self._stop_job
        if stop is not None:
            stop()

    def open_plot(self, path: Path, **options: Any) -> None:
        """Read a plot in the background and show it. `options` as for `pipeline.open_plot`."""
        cancelled = threading.Event()
        self._claim(f"Opening {path.name}", cancelled.set)
        threading.Thread(target=self._open, args=(path, options, cancelled), daemon=True, name="open").start()

    def open_upload(self, uploaded: UploadedFile) -> None:
        """Keep an uploaded file and open it."""
        self.open_plot(receive(uploaded, self._uploads_folder, allowed_suffixes=self.suffixes()))

    def _open(self, path: Path, options: dict[str, Any], cancelled: threading.Event) -> None:
        def progress(fraction: float, message: str = "") -> None:
            if cancelled.is_set():
                raise CancelledError
            self._show_progress(fraction, message)

        def started(job: Job) -> None:
            def stop() -> None:
                cancelled.set()
                job.cancel()

            self._stop_job = stop
            if cancelled.is_set():
                job.cancel()

        def read(source: Path, *, progress: Progress) -> Reconstruction:
            return run_job(read_cloud, source, progress=progress, started=started)

        try:
            options.setdefault("project_dir", None if is_project(path) else self.project_dir_for(path))
            self._release(path, options["project_dir"])
            session = open_plot(path, progress=progress, read=read, **options)
            # Before the plot is shown: what a person then starts must not find this still running.
            self._end_job()
            self.adopt(session)
        except StudioError as error:
            self._tell_failure(f"Opening {path.name}", error)
        except Exception:
            log.exception("Opening %s failed", path)
            self._each_tab(
                lambda tab: tab.worker.notify("Unexpected error", "The program's log has the details.", "error")
            )
        finally:
            self._end_job()

    def project_dir_for(self, path: Path) -> Path:
        """Where a plot made from `path` is saved."""
        return project_dir_for(path, self._uploads_folder)

    def _release(self, path: Path, project_dir: Path | None) -> None:
        """Let go of the open plot if it is the very one to be opened again: a plot has one writer."""
        session = self.session
        saver = session.saver if session is not None else None
        wanted = path if is_project(path) else project_dir
        if isinstance(saver, Autosave) and wanted is not None and saver.folder.absolute() == wanted.absolute():
            saver.close()

    def find_trunks(self) -> None:
        """Find the trunks of the open plot in a child process; the result is one undoable command."""
        session = self._require_session()
        document = session.document
        call = pipeline.segmentation_call(session, document)

        def done(result: pipeline.SegmentationResult) -> None:
            self.segmentation_notes = result[2]
            pipeline.apply_segmentation(session, document, result)
            if session.document is document:
                self._each_tab(Tab.refresh)

        self._run_job("Finding trunks", pipeline.segment_plot, call, done)

    def measure_missing(self) -> None:
        """Measure in the background the stems that have no measurement yet; nothing where there are none."""
        session = self.session
        if session is None or self._job is not None or not session.unmeasured():
            return
        document = session.document
        if not session.has_ground():
            self._run_job(
                "Fitting the ground",
                pipeline.ground_of,
                pipeline.ground_call(session, document),
                self._ground_fitted(document),
            )
            return

        def done(measurements: Any) -> None:
            session.remember_measurements(document, measurements)
            self._each_tab(Tab.refresh)

        self._run_job("Measuring", pipeline.measure_stems, pipeline.measurement_call(session, document), done)

    def _ground_fitted(self, document: Document) -> Callable[[Any], None]:
        session = self._require_session()
        return lambda ground: session.remember_ground(document, ground)

    def _require_session(self) -> Session:
        if self.session is None:
            raise StudioError("No plot is open.", "Open one in step 1.")
        return self.session

    def _run_job(
        self, title: str, function: Callable[..., Any], args: tuple[Any, ...], done: Callable[[Any], None]
    ) -> None:
        def finished(result: Any) -> None:
            # The bar goes first: what `done` changes may start the next job.
            self._end_job()
            done(result)
            self.measure_missing()

        def failed(error: StudioError) -> None:
            self._end_job()
            self._tell_failure(title, error)

        job = Job(function, args, on_progress=self._show_progress, on_done=finished, on_error=failed)
        # Claimed before it starts: a Cancel pressed while the process is being made counts.
        self._claim(title, job.cancel)
        job.start()

    def _tell_failure(self, title: str, error: StudioError) -> None:
        if isinstance(error, CancelledError):
            self._each_tab(lambda tab: tab.worker.notify("Cancelled", f"{title}: nothing was changed.", "info"))
        else:
            self._each_tab(lambda tab: tab.worker.notify_error(error))

    def _claim(self, title: str, stop: Callable[[], object]) -> None:
        with self._lock:
            if self._job is not None:
                raise StudioError(f"{self._job.title} is still running.", "Wait for it, or press Cancel.")
            self._job, self._stop_job = JobState(title), stop
        self._show_job()

    def _show_progress(self, fraction: float, message: str = "") -> None:
        with self._lock:
            if self._job is not None:
                self._job = replace(self._job, fraction=fraction, message=message)
        self._show_job()

    def _end_job(self) -> None:
        with self._lock:
            self._job, self._stop_job = None, None
        self._show_job()

    def _show_job(self) -> None:
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.worker.post_latest("job", lambda tab=tab: tab.show_job(self._job))

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until no job runs and every tab has caught up; for tests and scripts."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            tabs = list(self._tabs.values())
            if self._job is None and all(tab.worker.join(0.05) for tab in tabs) and self._job is None:
                return True
            time.sleep(0.02)
        return False

    def close(self) -> None:
        """Stop the job, save the plot, end the server."""
        self.cancel_job()
        if self.session is not None:
            self.session.close()
        self.server.stop()


def project_dir_for(path: Path, fallback: Path) -> Path:
    """Where the plot of a source file is saved: beside it, or in `fallback` where that folder is not writable."""
    name = f"{plot_name(path)}{FOLDER_SUFFIX}"
    beside = path.absolute().parent / name
    if beside.exists() or os.access(beside.parent, os.W_OK):
        return beside
    # Two plots of one name in two read-only folders must not share a saved plot.
    digest = hashlib.blake2b(str(path.absolute()).encode(), digest_size=4).hexdigest()
    fallback.mkdir(parents=True, exist_ok=True)
    return fallback / f"{beside.stem}-{digest}{FOLDER_SUFFIX}"
