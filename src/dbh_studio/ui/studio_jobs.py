"""The one job of the studio that runs beside it: who may start it, what the tabs show of it, how it is stopped."""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dbh_studio.app.jobs import Job
from dbh_studio.app.session import Session
from dbh_studio.core.progress import Progress
from dbh_studio.errors import CancelledError, StudioError

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

log = logging.getLogger(__name__)


class BusyError(StudioError):
    """Another job is running."""


@dataclass(eq=False)
class RunningJob:
    """What the progress bar shows and Cancel stops."""

    title: str
    stop: Callable[[], object]
    fraction: float = 0.0
    message: str = ""
    if_stopped: str = "nothing was changed."


class StudioJobs(ABC):
    """What of the studio is about long work: at most one job at a time, told in every tab."""

    def __init__(self) -> None:
        self.session: Session | None = None
        self._tabs: dict[int, Tab] = {}
        self._job: RunningJob | None = None
        self._lock = threading.RLock()

    @abstractmethod
    def measure_missing(self) -> None:
        """Start what waits until no job runs."""

    def _each_tab(self, action: Callable[[Tab], Any]) -> None:
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.worker.post(action, tab)

    def cancel_job(self) -> None:
        """Stop what runs; nothing of it is kept."""
        job = self._job
        if job is not None:
            job.stop()

    def start_job(
        self,
        title: str,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        session: Session,
        done: Callable[[Any], None],
        *,
        failed: Callable[[StudioError], object] = lambda _: None,
        if_stopped: str = RunningJob.if_stopped,
    ) -> None:
        """Run `function` in a child process, then `done` with its result if `session` is still the open plot.

        Raises:
            BusyError: Another job runs.
        """

        def finish(result: Any) -> None:
            # The bar goes first: what `done` changes may start the next job.
            self._end(running)
            if session is self.session:
                done(result)
            self.measure_missing()

        def fail(error: StudioError) -> None:
            self._fail(running, error)
            failed(error)

        def progress(fraction: float, message: str = "") -> None:
            self._show_progress(running, fraction, message)

        job = Job(function, args, on_progress=progress, on_done=finish, on_error=fail)
        # Claimed before it starts: a Cancel pressed while the process is being made counts.
        running = RunningJob(title, job.cancel, if_stopped=if_stopped)
        self._claim(running)
        job.start()

    def _fail(self, job: RunningJob, error: StudioError) -> None:
        self._end(job)
        if isinstance(error, CancelledError):
            self._each_tab(lambda tab: tab.worker.notify("Cancelled", f"{job.title}: {job.if_stopped}", "info"))
        else:
            self._each_tab(lambda tab: tab.worker.notify_error(error))

    def _claim(self, job: RunningJob) -> None:
        with self._lock:
            if self._job is not None:
                raise BusyError(f"{self._job.title} is still running.", "Wait for it, or press Cancel.")
            self._job = job
        self._show_job()

    def _show_progress(self, job: RunningJob, fraction: float, message: str = "") -> None:
        job.fraction, job.message = fraction, message
        self._show_job()

    def _end(self, job: RunningJob) -> None:
        """Let go of the claim, unless it is another's by now."""
        with self._lock:
            if self._job is not job:
                return
            self._job = None
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

    def _stoppable(self, running: RunningJob, cancelled: threading.Event) -> tuple[Progress, Callable[[Job], object]]:
        """How work in a thread reports, and how it tells of the child process that Cancel must end."""

        def progress(fraction: float, message: str = "") -> None:
            if cancelled.is_set():
                raise CancelledError
            self._show_progress(running, fraction, message)

        def started(job: Job) -> None:
            def stop() -> None:
                cancelled.set()
                job.cancel()

            running.stop = stop
            if cancelled.is_set():
                job.cancel()

        return progress, started

    def start_work(
        self,
        title: str,
        work: Callable[[Progress, Callable[[Job], object]], Any],
        session: Session,
        done: Callable[[Any], None],
    ) -> None:
        """As `start_job`, for work that starts its child process itself, if it needs one: `work(progress, started)`.

        Raises:
            BusyError: Another job runs.
        """
        cancelled = threading.Event()
        running = RunningJob(title, cancelled.set)
        progress, started = self._stoppable(running, cancelled)

        def run() -> None:
            try:
                result = work(progress, started)
                self._end(running)
                if session is self.session:
                    done(result)
            except StudioError as error:
                self._fail(running, error)
            except Exception:
                log.exception("%s failed", title)
                self._fail(running, StudioError("Unexpected error.", "The program's log has the details."))
            self.measure_missing()

        self._claim(running)
        threading.Thread(target=run, daemon=True, name="work").start()
