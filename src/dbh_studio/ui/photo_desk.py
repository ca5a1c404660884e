"""The photos of the open plot: offered where they lie beside the cloud, read by a job, read again on reopening."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.app import commands
from dbh_studio.app.cameras import Cameras, cloud_sample, read_cameras
from dbh_studio.app.document import CameraSource
from dbh_studio.app.jobs import Job, run_job
from dbh_studio.app.session import Session
from dbh_studio.errors import StudioError
from dbh_studio.io.posed import holds_poses, read_posed_images

if TYPE_CHECKING:
    from dbh_studio.ui.studio import Studio
    from dbh_studio.ui.tab import Tab

log = logging.getLogger(__name__)

FORMATS = {"colmap": "COLMAP", "metashape": "Agisoft Metashape", "opensfm": "OpenSfM", "table": "a table of poses"}
_KEPT = 3


@dataclass(frozen=True)
class PhotoOffer:
    """Photos that lie beside the cloud and were not asked for yet.

    Attributes:
        folder: Where.
        n_photos: How many have a pose.
        n_missing: How many of them are not on disk.
        source_format: As `PosedImages.source_format`.
    """

    folder: Path
    n_photos: int
    n_missing: int
    source_format: str


class PhotoDesk:
    """Reads photos for the studio; the session keeps them, and the tabs show them.

    Args:
        studio: Holds the open plot.
        run: Runs a job as `Studio` does.
        tell: Calls something for each tab, on its thread.

    Attributes:
        offer: Photos found beside the cloud of the open plot, or None.
        problem: Why the plot's photos could not be read, or None.
    """

    def __init__(
        self, studio: Studio, *, run: Callable[..., None], tell: Callable[[Callable[[Tab], Any]], None]
    ) -> None:
        self.offer: PhotoOffer | None = None
        self.problem: StudioError | None = None
        self._studio = studio
        self._run = run
        self._tell_tabs = tell
        self._read: list[Cameras] = []
        self._search: Job | None = None
        self._lock = threading.Lock()

    # ---- the open plot

    def plot_opened(self, session: Session) -> None:
        """Read the photos the plot speaks of; where it speaks of none, look for some beside the cloud."""
        self.close()
        self.offer = self.problem = None
        self._read = []
        self._studio.photo_cache.forget()
        if session.document.cameras is not None:
            self.follow(session)
        else:
            threading.Thread(target=self._look_beside, args=(session,), daemon=True, name="photos beside").start()

    def follow(self, session: Session) -> None:
        """Read the photos again where the plot speaks of others than those at hand: on reopening, after Undo."""
        source = session.document.cameras
        if source is None or session.cameras is not None:
            return
        known = next((each for each in self._read if each.source == source), None)
        if known is not None:
            session.remember_cameras(known)
            self._tell()
            return
        if self.problem is None:
            # Where something else runs, the panel offers to read them.
            with contextlib.suppress(StudioError):
                self.read_again(session)

    def close(self) -> None:
        """Stop looking."""
        with self._lock:
            search, self._search = self._search, None
        if search is not None:
            search.cancel()

    # ---- what a person does

    def add(self, session: Session, path: Path, images_dir: Path | None) -> None:
        """Read photos in a child process; that the plot has them is one undoable command.

        Raises:
            BusyError: Another job runs.
        """
        document = session.document

        def done(cameras: Cameras) -> None:
            self._keep(session, cameras)
            session.do(commands.set_cameras(cameras.source), based_on=document, reads=("cameras",))
            self._tell()

        call = (CameraSource.of(path, images_dir), cloud_sample(session.cloud))
        self._run(
            "Reading the photos", read_cameras, call, session, done, failed=lambda _: self._studio.measure_missing()
        )

    def read_again(self, session: Session) -> None:
        """Read the photos the plot speaks of.

        Raises:
            BusyError: Another job runs.
        """
        source = session.document.cameras
        if source is None:
            return

        def done(cameras: Cameras) -> None:
            self._keep(session, cameras)
            self._tell()

        def failed(error: StudioError) -> None:
            self.problem = error
            self._tell()
            self._studio.measure_missing()

        read = partial(read_cameras, is_chosen=True)
        call = (source, cloud_sample(session.cloud))
        self._run("Reading the photos", read, call, session, done, failed=failed)

    def _keep(self, session: Session, cameras: Cameras) -> None:
        self.problem = None
        self._read = [cameras, *self._read][:_KEPT]
        session.remember_cameras(cameras)

    def _tell(self) -> None:
        self._tell_tabs(lambda tab: tab.photos_changed())

    # ---- beside the cloud

    def _look_beside(self, session: Session) -> None:
        """Count the photos beside the cloud, in a child process; nothing is said where there are none."""
        path = session.document.source.path
        folder = path if path.is_dir() else path.parent
        try:
            if not holds_poses(folder):
                return
            with self._lock:
                is_meant = session is self._studio.session
            posed = run_job(read_posed_images, folder, started=self._search_started) if is_meant else None
        except (StudioError, OSError) as error:
            log.debug("No photos beside %s: %s", path, error)
            return
        finally:
            with self._lock:
                self._search = None
        if posed is None or not len(posed) or session is not self._studio.session:
            return
        if session.document.cameras is None:
            n_missing = sum(photo.path is None for photo in posed)
            self.offer = PhotoOffer(folder, len(posed), n_missing, posed.source_format)
            self._tell()

    def _search_started(self, job: Job) -> None:
        with self._lock:
            self._search = job
