"""The only place that touches viser's callbacks.

viser runs ordinary callbacks on a pool of 32 threads that does not keep their order ("click a trunk, press Delete" may
run as "Delete, click"), and coroutines on the event loop, in order, where one that blocks stops every tab. So every
callback here is a coroutine that reads the value and puts work in the queue of its tab; a thread per tab does the work.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import viser
import viser.transforms

from dbh_studio.core.arrays import Float64
from dbh_studio.core.picking import View
from dbh_studio.errors import CancelledError, FileError, StudioError
from dbh_studio.ui import uploads
from dbh_studio.ui.uploads import DEFAULT_MAX_UPLOAD_BYTES, UploadedFile, UploadRule

log = logging.getLogger(__name__)

Level = Literal["info", "success", "warning", "error"]
_COLOURS: dict[Level, Any] = {"info": "blue", "success": "green", "warning": "yellow", "error": "red"}
_CLOSES_AFTER_S: dict[Level, float | None] = {"info": 5.0, "success": 4.0, "warning": 12.0, "error": None}
_MAX_NOTE_CHARS = 600
_MAX_QUEUED = 1000
_DOUBLE_CLICK_S = 0.4
# These move the camera in the page whatever else they are bound to.
CAMERA_KEYS = frozenset("WASDQE") | {"arrowup", "arrowdown", "arrowleft", "arrowright"}


@dataclass(frozen=True, eq=False)
class SceneClick:
    """A left click in the 3D view.

    Attributes:
        ray_origin: (3,) world, where the camera was.
        ray_direction: (3,) unit, world.
        screen_xy: 0..1 from the upper left corner.
        modifier: Keys held, as viser names them, or None.
        view: The camera at that moment.
    """

    ray_origin: Float64
    ray_direction: Float64
    screen_xy: tuple[float, float]
    modifier: str | None
    view: View


@dataclass(frozen=True, eq=False)
class SceneRectangle:
    """A rectangle dragged in the 3D view: corners 0..1 from the upper left, and the camera at that moment."""

    lower_xy: tuple[float, float]
    upper_xy: tuple[float, float]
    view: View


def view_of(camera: viser.CameraHandle) -> View:
    """A tab's camera as plain numbers."""
    rotation = viser.transforms.SO3(np.asarray(camera.wxyz, np.float64)).as_matrix().T.astype(np.float64)
    height, width = max(int(camera.image_height), 1), max(int(camera.image_width), 1)
    return View(np.asarray(camera.position, np.float64), rotation, float(camera.fov), width / height, height)


@dataclass
class _Job:
    work: Callable[..., Any]
    args: tuple[Any, ...]
    key: Hashable | None = None
    finished: Callable[[], None] | None = None


class TabWorker:
    """Does the work of one browser tab, one thing after another, in the order the person asked for it.

    A `StudioError` raised by a handler is shown with its remedy; anything else is shown as unexpected and logged. After
    `close` nothing runs any more. All methods may be called from any thread.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self.client = client
        self._queue: deque[_Job] = deque()
        self._changed = threading.Condition()
        self._running = False
        self._closed = False
        self._cleanups: list[Callable[[], Any]] = []
        self._thread = threading.Thread(target=self._run, name=f"tab-{client.client_id}", daemon=True)
        self._thread.start()

    # -- the queue --------------------------------------------------------------------------------------------------

    def post(self, fn: Callable[..., Any], *args: Any) -> bool:
        """Put work at the end of the queue. False where the tab is closed or hopelessly behind."""
        return self._put(_Job(fn, args))

    def post_latest(self, key: Hashable, fn: Callable[..., Any], *args: Any) -> bool:
        """As `post`, but in place of waiting work with the same key: the latest wins.

        Only work that nothing else was queued behind is replaced, so a press after a drag still sees the drag's end.
        """
        return self._put(_Job(fn, args, key))

    def _put(self, job: _Job) -> bool:
        with self._changed:
            if self._closed:
                return False
            waiting = self._replaceable(job.key)
            if waiting is not None:
                waiting.work, waiting.args = job.work, job.args
                return True
            if len(self._queue) >= _MAX_QUEUED:
                log.warning("Tab %s is too far behind; dropped an event", self.client.client_id)
                return False
            self._queue.append(job)
            self._changed.notify_all()
            return True

    def _replaceable(self, key: Hashable | None) -> _Job | None:
        if key is None:
            return None
        for waiting in reversed(self._queue):
            if waiting.key is None:
                return None
            if waiting.key == key:
                return waiting
        return None

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._queue and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                job = self._queue.popleft()
                self._running = True
            try:
                self.attempt(job.work, *job.args)
            finally:
                if job.finished is not None:
                    job.finished()
                with self._changed:
                    self._running = False
                    self._changed.notify_all()

    def run_at_once(self, fn: Callable[..., Any], *args: Any) -> None:
        """Run `fn` beside the queue: to cancel the work that fills it, and for nothing else."""
        if not self._closed:
            threading.Thread(target=self.attempt, args=(fn, *args), name="at once", daemon=True).start()

    def attempt(self, fn: Callable[..., Any], *args: Any) -> None:
        """Run `fn` here and now; show what goes wrong instead of raising it."""
        try:
            fn(*args)
        except CancelledError as error:
            self.notify("Cancelled", "" if error.problem == "Cancelled." else str(error), "info")
        except StudioError as error:
            self.notify_error(error)
        except Exception:
            if self._closed:  # what it wrote to has gone with the tab
                log.debug("Work of a closed tab failed", exc_info=True)
                return
            log.exception("Unexpected error in tab %s", self.client.client_id)
            self.notify("Unexpected error", "Nothing more was done. The program's log has the details.", "error")

    def join(self, timeout: float) -> bool:
        """Wait until the queue is empty and nothing runs. Returns whether that came to pass."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._queue or self._running), timeout)

    @property
    def is_behind(self) -> bool:
        """Whether work is waiting."""
        return bool(self._queue)

    def is_run_by(self, thread: threading.Thread) -> bool:
        """Whether `thread` is the one that does this tab's work."""
        return thread is self._thread

    @property
    def closed(self) -> bool:
        """Whether the tab has gone."""
        return self._closed

    def on_close(self, fn: Callable[[], Any]) -> None:
        """Call `fn` when the tab closes: remove listeners, cancel jobs. Called at once if it already has."""
        with self._changed:
            if not self._closed:
                self._cleanups.append(fn)
                return
        fn()

    def close(self) -> None:
        """Drop waiting work, remove all listeners, take nothing more. Does not wait for work under way."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            dropped, cleanups = list(self._queue), self._cleanups
            self._queue.clear()
            self._cleanups = []
            self._changed.notify_all()
        for job in dropped:
            if job.finished is not None:
                job.finished()
        for cleanup in cleanups:
            try:
                cleanup()
            except Exception:
                log.exception("Could not clean up after tab %s", self.client.client_id)

    # -- telling the person -----------------------------------------------------------------------------------------

    def notify(self, title: str, body: str = "", level: Level = "info") -> None:
        """Show a note at the corner of the page. Plain text: the page does not interpret it."""
        if not self._closed:
            self.client.add_notification(
                _shortened(title),
                _shortened(body),
                color=_COLOURS[level],
                auto_close_seconds=_CLOSES_AFTER_S[level],
            )

    def notify_error(self, error: StudioError) -> None:
        """Show what happened and what to do."""
        where = f"{error.path.name}: " if isinstance(error, FileError) else ""
        self.notify(f"{where}{error.problem}", error.remedy, "error")

    # -- events -----------------------------------------------------------------------------------------------------

    def _is_mine(self, event: Any) -> bool:
        """Not a change by the program (no client), and not by another tab that shares the element."""
        return event.client is not None and event.client_id == self.client.client_id

    def on_click(self, button: Any, fn: Callable[[], Any], *, once_at_a_time: bool = True) -> None:
        """Run `fn` when the button is pressed.

        Args:
            button: A viser button.
            fn: Takes nothing.
            once_at_a_time: Drop a press while `fn` still waits or runs, and the second one of a double click.
        """
        self._on_press(button.on_click, button, fn, once_at_a_time)

    def on_command(self, command: Any, fn: Callable[[], Any], *, once_at_a_time: bool = False) -> None:
        """Run `fn` when the command is triggered by its hotkey or from the palette."""
        self._on_press(command.on_trigger, command, fn, once_at_a_time)

    def _on_press(self, register: Callable[..., Any], handle: Any, fn: Callable[[], Any], once_at_a_time: bool) -> None:
        pending, pressed_at = threading.Event(), -math.inf

        async def pressed(event: Any) -> None:
            nonlocal pressed_at
            if not self._is_mine(event):
                return
            is_double = pending.is_set() or time.monotonic() - pressed_at < _DOUBLE_CLICK_S
            if once_at_a_time and is_double:
                return
            pressed_at = time.monotonic()
            pending.set()
            if not self._put(_Job(fn, (), finished=pending.clear)):
                pending.clear()

        register(pressed)
        self.on_close(lambda: _forget(handle, pressed))

    def on_update(self, handle: Any, fn: Callable[[Any], Any], *, coalesce: bool = False) -> None:
        """Run `fn(value)` when the person changes an input.

        Args:
            handle: A viser input, or a button group (``fn`` gets the option pressed).
            fn: Takes the value it had at that moment.
            coalesce: While values wait, keep the latest only: for sliders.
        """

        async def updated(event: Any) -> None:
            if self._is_mine(event):
                self._put(_Job(fn, (event.target.value,), (id(handle), id(updated)) if coalesce else None))

        register = handle.on_click if isinstance(handle, viser.GuiButtonGroupHandle) else handle.on_update
        register(updated)
        self.on_close(lambda: _forget(handle, updated))

    def on_scene_click(
        self, client: viser.ClientHandle, fn: Callable[[SceneClick], Any], *, modifier: Any = None
    ) -> None:
        """Run `fn(SceneClick)` on a left click in the 3D view with exactly `modifier` held."""

        async def clicked(event: viser.SceneClickEvent) -> None:
            if not self._is_mine(event):
                return
            direction = np.asarray(event.ray_direction, np.float64)
            direction /= np.linalg.norm(direction)
            origin, view = np.asarray(event.ray_origin, np.float64), view_of(event.client.camera)
            self.post(fn, SceneClick(origin, direction, event.screen_pos, event.modifier, view))

        client.scene.on_click(modifier=modifier)(clicked)  # type: ignore[arg-type]
        self.on_close(lambda: client.scene.remove_click_callback(clicked))

    def on_scene_rectangle(
        self, client: viser.ClientHandle, fn: Callable[[SceneRectangle], Any], *, modifier: Any = "shift"
    ) -> None:
        """Run `fn(SceneRectangle)` when a rectangle is dragged. Without a modifier dragging would no longer orbit."""

        async def dragged(event: viser.SceneRectSelectEvent) -> None:
            if self._is_mine(event):
                corners = np.sort([event.screen_min, event.screen_max], axis=0)
                lower, upper = (tuple(float(v) for v in corner) for corner in corners)
                self.post(fn, SceneRectangle(lower, upper, view_of(event.client.camera)))  # type: ignore[arg-type]

        client.scene.on_rect_select(modifier=modifier)(dragged)  # type: ignore[arg-type]
        self.on_close(lambda: client.scene.remove_rect_select_callback(dragged))

    def on_dragged(self, arrows: viser.TransformControlsHandle, fn: Callable[[Float64], Any]) -> None:
        """Run `fn((3,) world)` when the person lets go of what they dragged. It ends with the arrows."""

        async def moved(event: viser.TransformControlsEvent) -> None:
            if self._is_mine(event) and event.phase == "end":
                self.post(fn, np.array(event.target.position, np.float64))

        arrows.on_update(moved)

    def on_upload(
        self,
        upload_button: Any,
        fn: Callable[[UploadedFile], Any],
        *,
        allowed_suffixes: tuple[str, ...],
        max_bytes: int = DEFAULT_MAX_UPLOAD_BYTES,
        on_progress: Callable[[int, int], Any] | None = None,
    ) -> None:
        """Run `fn(UploadedFile)` when a file has arrived; keep it with `uploads.receive`, else it is deleted.

        Args:
            upload_button: A viser upload button. It accepts nothing before this call. (Its ``mime_type`` may name the
                suffixes for the file dialog: ``".ply,.las"``.)
            fn: Runs in the tab's queue.
            allowed_suffixes: Lower case, with the dot.
            max_bytes: Of this button; larger files are refused with the advice to open them by path.
            on_progress: `on_progress(bytes_received, bytes_total)`, in the queue, the latest only; (0, 0) where nothing
                more comes.
        """
        rule = UploadRule(
            suffixes=allowed_suffixes,
            max_bytes=max_bytes,
            on_done=lambda file: self._take_upload(fn, file),
            on_refused=partial(self._upload_refused, on_progress),
            on_progress=on_progress and partial(self.post_latest, ("upload", id(upload_button)), on_progress),
        )
        uploads.set_rule(upload_button, rule)
        self.on_close(lambda: uploads.set_rule(upload_button, None))

    def _upload_refused(self, on_progress: Callable[[int, int], Any] | None, error: FileError) -> None:
        self.notify_error(error)
        if on_progress is not None:
            self.post(on_progress, 0, 0)

    def _take_upload(self, fn: Callable[[UploadedFile], Any], file: UploadedFile) -> None:
        if not self._put(_Job(fn, (file,), finished=file.discard)):
            file.discard()

    def add_command(
        self,
        label: str,
        fn: Callable[[], Any],
        *,
        hotkey: Any = None,
        modifier: Any = None,
        description: str | None = None,
    ) -> viser.CommandHandle:
        """Add a hotkey and palette entry of this tab.

        Raises:
            ValueError: The key moves the camera as well.
        """
        if hotkey is not None and (hotkey.upper() in CAMERA_KEYS or hotkey.lower() in CAMERA_KEYS):
            raise ValueError(f"{hotkey!r} moves the camera; choose another key than W A S D Q E and the arrows")
        command = self.client.gui.add_command(label, description=description, hotkey=hotkey, modifier=modifier)
        self.on_command(command, fn)
        return command


def for_each_tab(server: viser.ViserServer, open_tab: Callable[[TabWorker], Any]) -> None:
    """Give every tab that connects a worker, run `open_tab(worker)` on it, and close it when the tab goes.

    A reload is a new tab. `worker.on_close` is where a tab undoes what it registered elsewhere.
    """
    workers: dict[int, TabWorker] = {}

    @server.on_client_connect
    async def _(client: viser.ClientHandle) -> None:
        worker = workers[client.client_id] = TabWorker(client)
        worker.post(open_tab, worker)

    @server.on_client_disconnect
    async def _(client: viser.ClientHandle) -> None:
        worker = workers.pop(client.client_id, None)
        if worker is not None:
            worker.close()


def _forget(handle: Any, callback: Any) -> None:
    """Remove a callback from an input or a command; viser has a public way for some kinds only."""
    callbacks = getattr(handle._impl, "trigger_cb" if isinstance(handle, viser.CommandHandle) else "update_cb")
    if callback in callbacks:
        callbacks.remove(callback)


def _shortened(text: str) -> str:
    return text if len(text) <= _MAX_NOTE_CHARS else text[: _MAX_NOTE_CHARS - 1] + "…"
