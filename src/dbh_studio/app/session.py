"""The Session: the only writer of a plot. Browser, command line and tests send it commands."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dbh_studio.app.commands import Command
from dbh_studio.app.derived import UNSCALED_REASON, UNSCALED_REMEDY, Derived
from dbh_studio.app.document import Document
from dbh_studio.app.session_checks import check_fresh, check_scale
from dbh_studio.core.arrays import Float32
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.inventory import Inventory
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.errors import CommandError, ProjectError, UnscaledCloudError

if TYPE_CHECKING:
    from dbh_studio.app.autosave import Autosave
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.app.candidates import Offers
    from dbh_studio.app.last_search import LastSearch
    from dbh_studio.core.datacheck import DataCheck
    from dbh_studio.core.ground import GroundModel
    from dbh_studio.core.stem_profile import ProfilePoint
    from dbh_studio.stages.measure import StemMeasurement

_log = logging.getLogger(__name__)

HISTORY_LIMIT = 200
_TO_WRITE = "Open it for writing to change it, or save a copy and change that (step 1 of the studio)."


@dataclass(frozen=True, eq=False)
class Change:
    """What happened. A listener compares fields by identity: ``after.trunks is not before.trunks``.

    Attributes:
        before: The plot as it was.
        after: The plot as it is.
        label: What was done, for people.
        kind: Whether it was a command, or one taken back or done again.
    """

    before: Document
    after: Document
    label: str
    kind: Literal["do", "undo", "redo"] = "do"

    @property
    def moves_points(self) -> bool:
        """Whether points lie elsewhere in the world frame than before."""
        before, after = self.before.world_from_source, self.after.world_from_source
        parts = ((before.rotation, after.rotation), (before.translation, after.translation))
        return before.scale != after.scale or not all(np.array_equal(was, now) for was, now in parts)


Listener = Callable[[Change], None]


@dataclass(frozen=True, eq=False)
class History:
    """A plot with what Undo and Redo lead to.

    Attributes:
        present: The plot as it is.
        past: What each command was called and the Document before it, the latest last.
        future: What each undone command was called and the Document after it, the next one last.
        next_id: The lowest trunk id never given out, undone commands included.
    """

    present: Document
    past: tuple[tuple[str, Document], ...] = ()
    future: tuple[tuple[str, Document], ...] = ()
    next_id: int = 1


class Session:
    """One open plot: its cloud, its Document, and the Documents it was before.

    Every method may be called from any thread. Listeners are told of changes one at a time and in order, by a
    thread that made one; a listener may itself send commands.

    Args:
        cloud: The points; they never change.
        document: The state to begin with.
        data_check: What was found out about the cloud when it was read.
        mesh: The reconstruction's mesh, for display.
        notes: What the reader of the cloud has to say, in plain words.
        read_only: Refuse every command.
        is_geographic: The coordinates are degrees, which no scale turns into metres.
        history_limit: How many commands can be undone.
        history: What could be undone and redone when the plot was closed; its present is `document`.
        derived: For tests.

    Raises:
        ValueError: The document belongs to a cloud with another number of points.
    """

    def __init__(
        self,
        cloud: PointCloud,
        document: Document,
        *,
        data_check: DataCheck | None = None,
        mesh: Any = None,
        notes: Iterable[str] = (),
        read_only: bool = False,
        is_geographic: bool = False,
        history_limit: int = HISTORY_LIMIT,
        history: History | None = None,
        derived: Derived | None = None,
    ) -> None:
        if document.source.n_points != len(cloud):
            raise ValueError(f"the document is about {document.source.n_points} points but the cloud has {len(cloud)}")
        self.cloud = cloud
        self.data_check = data_check
        self.mesh = mesh
        self.notes = tuple(notes)
        self.is_read_only = read_only
        self._is_geographic = is_geographic
        self.saver: Autosave | None = None
        # What was lost, or brought back, when the saved plot was opened, in plain words.
        self.reopening_notes: tuple[str, ...] = ()
        # Of `reopening_notes` the one that says why it is only read.
        self.read_only_note = ""
        # Who writes the saved plot, where that is why it is only read.
        self.held_by = ""
        # The saved plot it was read from, where it is only read.
        self.read_from: Path | None = None
        self._document = document
        self._derived = derived or Derived(cloud)
        self._cameras: Cameras | None = None
        # How the trunks were found last; beside the Document, for it decides nothing.
        self.last_search: LastSearch | None = None
        # Stems that may be trunks; beside the Document, for they are none until somebody says so.
        self.offers: Offers | None = None
        history = history or History(document)
        self._next_id = max(document.trunks.next_id, history.next_id)
        self._past: deque[tuple[str, Document]] = deque(history.past, maxlen=history_limit)
        self._future: list[tuple[str, Document]] = list(history.future)
        self._lock = threading.RLock()
        self._listeners: list[Listener] = []
        self._recorders: list[Listener] = []
        self._untold: deque[Change] = deque()
        self._telling = threading.RLock()
        self._is_telling = False

    # ---- the state

    @property
    def document(self) -> Document:
        """The plot as it is now; an immutable value that may be kept."""
        return self._document

    @property
    def next_id(self) -> int:
        """The lowest trunk id never given out in this plot, undone commands included."""
        return self._next_id

    @property
    def author(self) -> str:
        """Who decides here; empty where that is not known."""
        return self.saver.author if self.saver is not None else ""

    @property
    def can_undo(self) -> bool:
        """Whether there is a command to undo."""
        return bool(self._past)

    @property
    def can_redo(self) -> bool:
        """Whether there is an undone command."""
        return bool(self._future)

    @property
    def undo_label(self) -> str:
        """What Undo would undo; empty where nothing."""
        with self._lock:
            return self._past[-1][0] if self._past else ""

    @property
    def earlier(self) -> tuple[tuple[str, Document], ...]:
        """What can be undone, oldest first: (what was done, the Document before it)."""
        with self._lock:
            return tuple(self._past)

    @property
    def redo_label(self) -> str:
        """What Redo would do again; empty where nothing."""
        with self._lock:
            return self._future[-1][0] if self._future else ""

    # ---- the only ways to change it

    def do(self, command: Command, *, based_on: Document | None = None, reads: Iterable[str] = ()) -> Change:
        """Apply a command to the plot as it is now.

        Args:
            command: The edit. One that changes nothing leaves no trace.
            based_on: The Document the command's values were computed from, for the result of a job.
            reads: Fields of it that they were computed from: ``scale``, ``settings.trunks``, …; all, if none is named.

        Raises:
            CommandError: It cannot be applied; nothing has changed.
            SettingError: It sets a scale that the cloud cannot have; nothing has changed.
            StaleResultError: A field of `reads` is no longer what it was; nothing has changed, other edits are kept.
        """
        with self._lock:
            self._check_writable()
            before = self._document
            if based_on is not None:
                check_fresh(based_on, before, reads)
            after = self._apply(command, before)
            if after.scale != before.scale:
                check_scale(after.scale, before.source.path.name, is_geographic=self._is_geographic)
            change = Change(before, after, command.label)
            if after is before:
                return change
            self._past.append((command.label, before))
            self._future.clear()
            self._move_to(change)
        self._tell()
        return change

    def undo(self) -> Change:
        """Go back to the Document before the last command.

        Raises:
            CommandError: There is nothing to undo.
        """
        with self._lock:
            self._check_writable()
            if not self._past:
                raise CommandError("There is nothing to undo.")
            label, earlier = self._past.pop()
            self._future.append((label, self._document))
            change = Change(self._document, earlier, f"Undo: {label}", "undo")
            self._move_to(change)
        self._tell()
        return change

    def redo(self) -> Change:
        """Go forward to the Document that was undone.

        Raises:
            CommandError: There is nothing to redo.
        """
        with self._lock:
            self._check_writable()
            if not self._future:
                raise CommandError("There is nothing to redo.")
            label, later = self._future.pop()
            self._past.append((label, self._document))
            change = Change(self._document, later, f"Redo: {label}", "redo")
            self._move_to(change)
        self._tell()
        return change

    def forget_before(self, n_commands: int) -> None:
        """Let no more than the last `n_commands` be undone from now on."""
        with self._lock:
            while len(self._past) > n_commands:
                self._past.popleft()

    def _check_writable(self) -> None:
        if self.is_read_only:
            raise CommandError("The plot is open for reading only.", _TO_WRITE)

    def _apply(self, command: Command, before: Document) -> Document:
        """Apply with ids counted on from all ever given out: an undone trunk's number may stand in somebody's notes."""
        trunks = before.trunks
        if trunks.next_id < self._next_id:
            trunks = replace(trunks, next_id=self._next_id)
        base = before if trunks is before.trunks else replace(before, trunks=trunks)
        after = command.apply(base)
        if after is base:
            return before
        return replace(after, trunks=before.trunks) if after.trunks is trunks is not before.trunks else after

    def _move_to(self, change: Change) -> None:
        self._document = change.after
        self._next_id = max(self._next_id, change.after.trunks.next_id)
        for recorder in tuple(self._recorders):
            self._tell_one(recorder, change)
        self._untold.append(change)

    # ---- listeners

    @contextmanager
    def held(self) -> Iterator[History]:
        """The plot, its past and its future, while nothing can change them; for moments, since everybody waits."""
        with self._lock:
            yield History(self._document, tuple(self._past), tuple(self._future), self._next_id)

    def record_with(self, recorder: Listener) -> Callable[[], None]:
        """Call `recorder` with every change as it happens, before anybody hears of it; returns what ends that.

        It is called in the order of the changes, while no other can happen: it must be quick and send no commands.
        """
        return self._registered(self._recorders, recorder)

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` after every change; returns the function that ends it."""
        return self._registered(self._listeners, listener)

    def _registered(self, listeners: list[Listener], listener: Listener) -> Callable[[], None]:
        with self._lock:
            listeners.append(listener)

        def unregister() -> None:
            with self._lock:
                if listener in listeners:
                    listeners.remove(listener)

        return unregister

    def _tell(self) -> None:
        with self._telling:
            if self._is_telling:
                # A listener sent a command: whoever is telling goes on with this change after the one at hand.
                return
            self._is_telling = True
            try:
                while self._untold:
                    change = self._untold.popleft()
                    for listener in tuple(self._listeners):
                        self._tell_one(listener, change)
            finally:
                self._is_telling = False

    @staticmethod
    def _tell_one(listener: Listener, change: Change) -> None:
        try:
            listener(change)
        except Exception:  # noqa: BLE001
            # The change has happened and the others must hear of it.
            _log.exception("A listener failed after %r", change.label)

    # ---- derived values

    def points_world(self, document: Document | None = None) -> Float32:
        """(N, 3) float32 points in the world frame, read-only; the cloud's memory where the transform is the identity.

        Args:
            document: The state to transform for, where a job must not mix two; the present one by default.
        """
        return self._derived.points_world(document or self._document)

    def ground(self, progress: Progress = ignore_progress, *, document: Document | None = None) -> GroundModel:
        """The ground of the plot as it is now (or was), fitted where it is not known."""
        return self._derived.ground(document or self._document, progress)

    def has_ground(self) -> bool:
        """Whether `ground` answers at once."""
        return self._derived.has_ground(self._document)

    def remember_ground(self, document: Document, ground: GroundModel) -> None:
        """Keep a ground that a job fitted for `document`."""
        self._derived.put_ground(document, ground)

    def measurement(self, trunk_id: int, *, document: Document | None = None) -> StemMeasurement:
        """The diameter of one stem, or why there is none.

        Args:
            trunk_id: Which.
            document: The state to measure in, where others may change the plot meanwhile; the present one by default.

        Raises:
            KeyError: There is no such trunk.
        """
        return self._derived.measurement(document or self._document, trunk_id)

    def compared(self, trunk_id: int, *, document: Document | None = None) -> StemMeasurement:
        """As `measurement`, with every other method fitted beside the chosen one; not remembered."""
        return self._derived.compared(document or self._document, trunk_id)

    def profile(self, trunk_id: int, *, document: Document | None = None) -> tuple[ProfilePoint, ...]:
        """Diameters every 10 cm along one stem, see `core.stem_profile`; not remembered."""
        return self._derived.profile(document or self._document, trunk_id)

    def measurements(self, progress: Progress = ignore_progress) -> tuple[StemMeasurement, ...]:
        """All stems, in order of id."""
        return self._derived.measurements(self._document, progress)

    def unmeasured(self, document: Document | None = None) -> tuple[int, ...]:
        """The stems `measurements` would have to measure."""
        document = document or self._document
        if not document.scale.is_known:
            return ()
        return tuple(i for i in document.trunks.ids if self._derived.known_measurement(document, i) is None)

    def remember_measurements(self, document: Document, measurements: Iterable[StemMeasurement]) -> None:
        """Keep what a job measured for `document`."""
        for measurement in measurements:
            self._derived.put_measurement(document, measurement)

    def inventory(self, progress: Progress = ignore_progress, *, document: Document | None = None) -> Inventory:
        """One row per stem, now or in an earlier state."""
        return self._derived.inventory(document or self._document, progress)

    @property
    def cameras(self) -> Cameras | None:
        """The photos the Document speaks of, where they were read already."""
        cameras, source = self._cameras, self._document.cameras
        return cameras if cameras is not None and cameras.source == source else None

    def remember_cameras(self, cameras: Cameras) -> None:
        """Keep photos that were read for the Document as it is, or as the next command will make it."""
        self._cameras = cameras

    def require_scale(self, document: Document | None = None) -> None:
        """Raise UnscaledCloudError, or SettingError for degrees, unless lengths are in metres; it says what to do."""
        document = document or self._document
        # A plot saved by an earlier version may have a scale that no cloud of degrees can have.
        check_scale(document.scale, document.source.path.name, is_geographic=self._is_geographic)
        if not document.scale.is_known:
            raise UnscaledCloudError(UNSCALED_REASON, UNSCALED_REMEDY)

    def flush(self) -> None:
        """Save what is not saved, now, where the plot is kept in a folder.

        Raises:
            ProjectError: It could not be saved; says why.
        """
        if self.saver is not None and not self.saver.flush():
            raise ProjectError(self.saver.status.problem)

    def close(self) -> None:
        """Save what is left and release the saved plot. The Session must not be used afterwards.

        A last save that fails is logged; where the caller can still do something about it, `flush` comes first.
        """
        saver, self.saver = self.saver, None
        if saver is not None:
            saver.close()
