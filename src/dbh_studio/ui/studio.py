"""The studio: one server, at most one open plot, any number of tabs that look at it."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import platformdirs

from dbh_studio.app import pipeline
from dbh_studio.app.autosave import Autosave, SaveStatus
from dbh_studio.app.document import Document
from dbh_studio.app.jobs import run_job
from dbh_studio.app.opening import open_or_read, open_plot, plot_name, read_cloud, save_as, say_read_only
from dbh_studio.app.session import Change, Session
from dbh_studio.core.progress import Progress
from dbh_studio.core.reconstruction import Reconstruction
from dbh_studio.errors import ProjectError, ProjectLockedError, StudioError
from dbh_studio.io.project import is_project
from dbh_studio.io.reader import SUPPORTED_SUFFIXES
from dbh_studio.ui.bind import TabWorker, for_each_tab
from dbh_studio.ui.display_cloud import DisplayCloud
from dbh_studio.ui.marker_search import MarkerFinds
from dbh_studio.ui.mask_desk import MaskDesk
from dbh_studio.ui.mask_jobs import MaskJobs
from dbh_studio.ui.photo_desk import PhotoDesk
from dbh_studio.ui.photo_render import PhotoCache
from dbh_studio.ui.plot_places import place_for_copy, project_dir_for
from dbh_studio.ui.returning import LostPages
from dbh_studio.ui.server import StudioServer
from dbh_studio.ui.studio_jobs import BusyError, RunningJob, StudioJobs
from dbh_studio.ui.tab import Tab
from dbh_studio.ui.uploads import UploadedFile, receive

log = logging.getLogger(__name__)

DEFAULT_DISPLAY_POINTS = 3_000_000
# What is done in one tab is told in the others so often at most.
_BETWEEN_NOTES_S = 2.0


class Studio(StudioJobs):
    """Holds the open plot and the running job, and tells the tabs.

    Args:
        server: The wrapped viser server.
        uploads_folder: Where uploaded clouds are kept; the user's data folder by default.
        display_points: How many points a browser is sent at most.
    """

    def __init__(
        self, server: StudioServer, *, uploads_folder: Path | None = None, display_points: int = DEFAULT_DISPLAY_POINTS
    ) -> None:
        super().__init__()
        self.server = server
        self.display: DisplayCloud | None = None
        self.segmentation_notes: tuple[str, ...] = ()
        self.markers = MarkerFinds(self)
        self._uploads_folder = uploads_folder or Path(platformdirs.user_data_dir("dbh-studio")) / "plots"
        self._display_points = display_points
        self.lost_pages = LostPages()
        self._end_session: Callable[[], None] = lambda: None
        self._problem_told = ""
        self._others_told_at = -_BETWEEN_NOTES_S
        # The plot of which it was told how it was opened.
        self._opening_told: Session | None = None
        self._exported: Document | None = None
        self.photo_cache = PhotoCache()
        self.photos = PhotoDesk(self, run=self.start_job, tell=self._each_tab)
        self.masks = MaskDesk(self, tell=self._each_tab)
        self.mask_jobs = MaskJobs(self)
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
        # Before it shows the plot: a change from now on waits in its queue, and none is missed.
        with self._lock:
            self._tabs[worker.client.client_id] = tab
        worker.on_close(lambda: self._forget_tab(worker.client.client_id))
        # Before it shows anything: the answer comes before whatever a person does with what is shown.
        tab.returning.ask()
        tab.adopt_session()
        tab.show_job(self._job)
        self._tell_of_opening(tab)

    def _forget_tab(self, client_id: int) -> None:
        with self._lock:
            self._tabs.pop(client_id, None)

    def refresh_tabs(self) -> None:
        """Show in every tab what has changed beside the document."""
        self._each_tab(Tab.refresh)

    # ---- the open plot

    def adopt(self, session: Session) -> None:
        """Show this plot in every tab, in place of the one that is open.

        Raises:
            ProjectError: The last changes of the open plot cannot be saved, so it stays open.
        """
        display = self._make_display(session)
        self._save_open_plot()
        end = session.subscribe(partial(self._session_changed, session))
        with self._lock:
            before, self.session, self.display = self.session, session, display
            end_before, self._end_session = self._end_session, end
            # At one go: what a person starts in the new plot must not find the opening of it, or the old one's job.
            job, self._job = self._job, None
            self.segmentation_notes, self._exported, self._problem_told = (), None, ""
        if job is not None:
            job.stop()
        end_before()
        if before is not None:
            before.close()
        self.lost_pages.clear()
        self._each_tab(lambda tab: tab.returning.plot_opened())
        if isinstance(session.saver, Autosave):
            session.saver.subscribe(self._save_status_changed)
        self.masks.plot_opened()
        self.mask_jobs.plot_opened()
        # First: a tab that shows the end of the job shows its step too, and a press meanwhile would be undone.
        self._each_tab(Tab.adopt_session)
        self._each_tab(self._tell_of_opening)
        self._show_job()
        self.photos.plot_opened(session)
        self.measure_missing()

    def _tell_of_opening(self, tab: Tab) -> None:
        """Tell once what was lost, or brought back, when the plot was opened; the first step shows it all the time."""
        session = self.session
        if session is None or self._opening_told is session:
            return
        self._opening_told = session
        for note in session.reopening_notes:
            tab.worker.notify(f"{session.document.plot_id} was opened", note, "warning")

    def _save_open_plot(self) -> None:
        """Raise ProjectError where the open plot cannot be saved: closing it would lose what was done."""
        self._keep_typed()
        try:
            if self.session is not None:
                self.session.flush()
        except ProjectError as error:
            raise ProjectError(
                f"The open plot is kept, for it could not be saved: {error.problem}", error.remedy
            ) from None

    def _keep_typed(self) -> None:
        """Keep what was typed about trees in any tab, before the plot is closed."""
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.returning.keep_typed()

    def _make_display(self, session: Session) -> DisplayCloud:
        return DisplayCloud.of(
            session.cloud,
            session.points_world(),
            budget=self._display_points,
            is_metric=session.document.scale.is_known,
        )

    def _session_changed(self, session: Session, change: Change) -> None:
        if session is not self.session:
            return
        if change.moves_points:
            self.display = self._make_display(session)
        self.photos.follow(session)
        self._each_tab(lambda tab: tab.session_changed(change))
        self._tell_other_tabs(change)
        self.measure_missing()

    def _tell_other_tabs(self, change: Change) -> None:
        """What was done in one tab is told in the others, where somebody may be about to do the same."""
        here = threading.current_thread()
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            if not tab.worker.is_run_by(here):
                tab.returning.changed_elsewhere(change.before)
        # Not every stroke of a row of them: the notes would cover the plot.
        is_due = time.monotonic() - self._others_told_at > _BETWEEN_NOTES_S
        if is_due and any(tab.worker.is_run_by(here) for tab in tabs):
            self._others_told_at = time.monotonic()
            for tab in tabs:
                if not tab.worker.is_run_by(here):
                    tab.worker.notify("In another tab", f"{change.label}.", "info")

    def _save_status_changed(self, status: SaveStatus) -> None:
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.worker.post_latest("saved", tab.refresh_header)
        # Told once: with every edit it fails again, and the header says so all the time.
        if status.state == "saved":
            if self._problem_told:
                self._each_tab(lambda tab: tab.worker.notify("Saved", "All that was done is saved again.", "success"))
            self._problem_told = ""
        elif status.state == "not_saved" and status.problem != self._problem_told:
            self._problem_told = status.problem
            self._each_tab(lambda tab: tab.worker.notify("Not saved", status.problem, "error"))

    def saved_text(self) -> str:
        """Where the plot is saved, in a few words."""
        session = self.session
        if session is None:
            return ""
        saver = session.saver
        if not isinstance(saver, Autosave):
            return f"open for reading only{f', {session.held_by}' if session.held_by else ''}"
        return f"saved in {saver.folder.name}" if saver.status.state == "saved" else "saving …"

    def save_problem(self) -> str:
        """Why the plot is not saved; empty where it is."""
        saver = self.session.saver if self.session is not None else None
        return saver.status.problem if isinstance(saver, Autosave) else ""

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

    def open_plot(self, path: Path, **options: Any) -> None:
        """Read a plot in the background and show it. `options` as for `opening.open_plot`.

        Raises:
            StudioError: It is open already, the open plot cannot be saved, or another job runs.
        """
        options.setdefault("project_dir", None if is_project(path) else self.project_dir_for(path))
        self._check_not_open(path, options["project_dir"] or path)
        self._save_open_plot()
        cancelled = threading.Event()
        job = RunningJob(f"Opening {path.name}", cancelled.set)
        self._claim(job)
        threading.Thread(target=self._open, args=(job, path, options, cancelled), daemon=True, name="open").start()

    def keep_upload(self, uploaded: UploadedFile) -> Path:
        """Where an uploaded file is kept from now on."""
        return receive(uploaded, self._uploads_folder, allowed_suffixes=self.suffixes())

    def _open(self, running: RunningJob, path: Path, options: dict[str, Any], cancelled: threading.Event) -> None:
        progress, started = self._stoppable(running, cancelled)

        def read(source: Path, *, progress: Progress) -> Reconstruction:
            return run_job(read_cloud, source, progress=progress, started=started)

        try:
            session = self._open_or_read(path, progress=progress, read=read, **options)
            try:
                self.adopt(session)
            except BaseException:
                session.close()
                raise
        except StudioError as error:
            self._fail(running, error)
            self.measure_missing()
        except Exception:
            log.exception("Opening %s failed", path)
            self._fail(running, StudioError("Unexpected error.", "The program's log has the details."))

    @staticmethod
    def _open_or_read(path: Path, **options: Any) -> Session:
        """Open a plot; one that cannot be written, or that another program writes, is opened for reading only."""
        try:
            return open_or_read(path, **options)
        except ProjectLockedError as error:
            session = open_plot(path, **{**options, "read_only": True})
            what = "It is open here for reading only, as it was saved last; close it there to change it here, or press "
            what += "“Save a copy” in step 1 to go on in a copy."
            say_read_only(session, error.problem.rstrip("."), f"{error.problem} {what}")
            return session

    def project_dir_for(self, path: Path) -> Path:
        """Where a plot made from `path` is saved."""
        return project_dir_for(path, self._uploads_folder)

    def save_copy(self, folder: Path) -> None:
        """Save the open plot elsewhere, and go on there: what could not be changed or saved where it was now can be.

        Raises:
            StudioError: It cannot be saved there; says why, and the plot stays as it was.
        """
        session = self._require_session()
        # Masks that are being painted go along.
        self.masks.save()
        saver = save_as(session, folder, label="Save a copy")
        saver.subscribe(self._save_status_changed)
        self._problem_told = ""
        self.refresh_tabs()
        self._each_tab(lambda tab: tab.worker.notify("Saved in a copy", f"{saver.folder}: you go on there.", "success"))

    def place_for_copy(self) -> Path:
        """Where a copy of the open plot may be saved: a folder that is not there yet."""
        document = self._require_session().document
        return place_for_copy(document.plot_id or plot_name(document.source.path), self._uploads_folder)

    def _check_not_open(self, path: Path, folder: Path) -> None:
        """Raise StudioError where a plot would be saved in the folder of the open one: a plot has one writer."""
        session = self.session
        saver = session.saver if session is not None else None
        if session is None or not isinstance(saver, Autosave) or saver.folder.resolve() != folder.resolve():
            return
        source = session.document.source.path
        if path == folder or path.resolve() == source.resolve():
            raise StudioError(f"{path.name} is open already.", "What you change is saved as you go.")
        raise StudioError(
            f"{path.name} would be saved in {folder.name}, where the open plot of {source.name} is.",
            "Rename one of the two files.",
        )

    def find_trunks(self) -> None:
        """Find the trunks of the open plot in a child process; the result is one undoable command."""
        session = self._require_session()
        document = session.document
        call = pipeline.segmentation_call(session, document)

        def done(result: pipeline.Segmentation) -> None:
            before, self.segmentation_notes = self.segmentation_notes, result.notes
            try:
                pipeline.apply_segmentation(session, document, result)
            except StudioError:
                self.segmentation_notes = before
                raise
            if session.document is document:
                self._each_tab(Tab.refresh)

        self.start_job(
            "Finding trunks", pipeline.segment_plot, call, session, done, failed=lambda _: self.measure_missing()
        )

    def measure_missing(self) -> None:
        """Measure in the background the stems that have no measurement yet; nothing where there are none."""
        session = self.session
        if session is None or self._job is not None or not session.unmeasured():
            return
        document = session.document

        def measured(measurements: Any) -> None:
            session.remember_measurements(document, measurements)
            self._each_tab(Tab.measured)

        with contextlib.suppress(BusyError):  # whatever runs goes on with this when it ends
            if session.has_ground():
                call = pipeline.measurement_call(session, document)
                self.start_job("Measuring", pipeline.measure_stems, call, session, measured)
            else:
                fitted = partial(session.remember_ground, document)
                ground_call = pipeline.ground_call(session, document)
                self.start_job("Fitting the ground", pipeline.ground_of, ground_call, session, fitted)

    def _require_session(self) -> Session:
        if self.session is None:
            raise StudioError("No plot is open.", "Open one in step 1.")
        return self.session

    def close(self) -> None:
        """Stop the job, save the plot, end the server."""
        self.cancel_job()
        self.photos.close()
        with contextlib.suppress(StudioError):
            self.masks.save()
        if self.session is not None:
            self._keep_typed()
            self.session.close()
        self.server.stop()
