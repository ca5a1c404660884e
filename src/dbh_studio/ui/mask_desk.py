"""The masks of the open plot, shared by all tabs: which photos have one, what is painted, and what was said of each.

What is painted is saved stroke by stroke, as everything in the studio is; a mask a person brought was copied beside the
plot before, so that no file of theirs is ever written.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dbh_studio.app.mask_click import ClickSegmenter
from dbh_studio.app.plot_masks import MaskState, kept_mask, mask_states, put_painted, set_review
from dbh_studio.app.vote_cache import kept_votes
from dbh_studio.errors import CommandError, FileError, StudioError
from dbh_studio.ui.label_counts import LabelCounts
from dbh_studio.ui.mask_canvas import MaskCanvas

if TYPE_CHECKING:
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.app.image_trunks import ImageTrunks
    from dbh_studio.app.session import Session
    from dbh_studio.core.mask_record import MaskRecord
    from dbh_studio.core.votes import Votes
    from dbh_studio.io.masks import Review
    from dbh_studio.io.models.store import ModelStore
    from dbh_studio.ui.studio import Studio
    from dbh_studio.ui.tab import Tab

_CANVAS_BYTES = 400_000_000


class MaskDesk:
    """Keeps the masks that are looked at, and writes what is painted; any thread may call.

    Args:
        studio: Holds the open plot.
        tell: Calls something for each tab, on its thread.

    Attributes:
        writing: Whether a job writes masks now: then nobody else may; see `set_writing`.
        problem: Why the masks of the plot cannot be read; None where they can.
    """

    def __init__(self, studio: Studio, *, tell: Callable[[Callable[[Tab], Any]], None]) -> None:
        self.writing = False
        self.problem: FileError | None = None
        self._studio = studio
        self._tell = tell
        self._for: tuple[Session, Cameras] | None = None
        self._states: dict[str, MaskState] | None = None
        self._canvases: OrderedDict[str, MaskCanvas] = OrderedDict()
        self._saved: dict[str, int] = {}
        self._segmenter: ClickSegmenter | None = None
        self._models: ModelStore | None = None
        self._votes: Votes | None = None
        self._votes_for: tuple[Session, MaskRecord | None] | None = None
        self._counts: LabelCounts | None = None
        self._counts_for: tuple[object, object] | None = None
        self._lock = threading.RLock()

    # ---- what is there

    def states(self) -> dict[str, MaskState]:
        """Photo → what is known of its mask, for every photo of the plot; empty where there are no photos.

        Also where the list of masks cannot be read: `problem` says why.
        """
        with self._lock:
            plot = self._plot()
            if plot is None:
                return {}
            if self._states is None:
                self.problem = None
                try:
                    self._states = {state.photo: state for state in mask_states(plot[0], plot[1].posed)}
                except FileError as error:
                    self.problem, self._states = error, {}
            return self._states

    def state(self, name: str) -> MaskState | None:
        """Of one photo; None where the plot has no such photo."""
        return self.states().get(name)

    def with_masks(self) -> list[str]:
        """The photos that have one, in the order of capture."""
        return [name for name, state in self.states().items() if state.has_mask]

    def canvas(self, name: str, *, new: bool = False) -> MaskCanvas | None:
        """The mask of a photo to look at or paint; None where it has none and none is begun.

        Args:
            name: Of the photo.
            new: Begin one where there is none.

        Raises:
            FileError: The list of masks cannot be read.
        """
        with self._lock:
            plot, state = self._plot(), self.state(name)
            if plot is None or state is None:
                return None
            known = self._canvases.get(name)
            if known is None:
                mask = kept_mask(plot[0], name) if state.has_mask else None
                if mask is None and not new:
                    return None
                known = MaskCanvas(mask, plot[1].posed.by_name(name).camera)
                self._canvases[name], self._saved[name] = known, known.version
            self._canvases.move_to_end(name)
            self._make_room()
            return known

    def segmenter(self) -> ClickSegmenter:
        """What outlines a trunk at a click."""
        with self._lock:
            if self._segmenter is None:
                self._segmenter = ClickSegmenter(self.models)
            return self._segmenter

    @property
    def models(self) -> ModelStore:
        """Where the models are."""
        from dbh_studio.io.models.store import ModelStore

        with self._lock:
            if self._models is None:
                self._models = ModelStore()
            return self._models

    def use_models(self, models: ModelStore) -> None:
        """Take the models from elsewhere than the user's cache."""
        with self._lock:
            self._models, self._segmenter = models, None

    # ---- votes

    def votes_counted(self, session: Session, result: ImageTrunks) -> None:
        """Remember what masks have just said of the cloud; call it before the trunks come into the plot."""
        with self._lock:
            self._votes, self._votes_for = result.votes, (session, result.record)

    def label_counts(self) -> LabelCounts | None:
        """Colours of the points that are shown; None where the plot's trunks came from no masks.

        On reopening and after Undo the votes are read from beside the plot.
        """
        with self._lock:
            display, session = self._studio.display, self._studio.session
            if display is None or session is None:
                return None
            voted = (session, session.document.masks)
            if self._votes_for != voted:
                self._votes, self._votes_for = kept_votes(session), voted
            votes = self._votes if voted[1] is not None else None
            if votes is None or len(votes) != len(session.cloud):
                return None
            if self._counts_for is None or self._counts_for[0] is not votes or self._counts_for[1] is not display:
                self._counts, self._counts_for = LabelCounts(votes, display.indices), (votes, display)
            return self._counts

    # ---- what is changed

    def why_not(self) -> str:
        """Why no mask can be changed now; empty where it can."""
        session = self._studio.session
        if session is None or session.cameras is None:
            return "The plot has no photos."
        if session.is_read_only:
            return "The plot is open for reading only."
        return "Masks are being made; wait for it, or press Cancel." if self.writing else ""

    def check_writable(self) -> None:
        """Raise CommandError where no mask can be changed now."""
        if why := self.why_not():
            raise CommandError("The mask cannot be changed.", why)

    def set_writing(self, writing: bool) -> None:
        """Say that a job writes masks from now on, or does not any more; brushes are put down meanwhile."""
        if writing:
            self.save()
        self.writing = writing
        if writing:
            self._tell(lambda tab: tab.masks.changed())

    def save(self) -> None:
        """Write what was painted since it was last written; returns when it is on the disk.

        Raises:
            StudioError: It cannot be written. It is tried again the next time.
        """
        saved = []
        with self._lock:
            plot = self._for
            if plot is None or self.writing:
                return
            for name, canvas in list(self._canvases.items()):
                version = canvas.version
                if version != self._saved[name]:
                    put_painted(plot[0], plot[1].posed.by_name(name), canvas.mask())
                    self._saved[name] = version
                    self._states = None
                    saved.append(name)
        if saved:
            self._tell(lambda tab: tab.masks.changed(*saved))

    def review(self, name: str, review: Review) -> None:
        """Accept or reject a mask, or take that back.

        Raises:
            StudioError: There is none, or it cannot be written.
        """
        self.check_writable()
        with self._lock:
            plot = self._plot()
            if plot is None:
                return
            set_review(plot[0], name, review)
            self._states = None
        self._tell(lambda tab: tab.masks.changed(name))

    def plot_opened(self) -> None:
        """Another plot is open: what was about the one before is forgotten."""
        with self._lock:
            # Nearly always there is nothing left to save, for every stroke was.
            with contextlib.suppress(StudioError):
                self.save()
            self.writing = False
            self._votes = self._votes_for = self._counts = self._counts_for = None
            self._canvases.clear()
            self._saved.clear()
            self._states = self._for = None

    def forget(self) -> None:
        """Read all masks again: another plot is open, or a job has made some. What is not saved is saved first."""
        with self._lock:
            try:
                self.save()
            finally:
                self._canvases.clear()
                self._saved.clear()
                self._states = self._for = None
        self._tell(lambda tab: tab.masks.changed())

    def _plot(self) -> tuple[Session, Cameras] | None:
        """The plot and its photos; what is known of another plot, or of other photos, is forgotten."""
        session = self._studio.session
        cameras = session.cameras if session is not None else None
        if session is None or cameras is None:
            return None
        if self._for is None or self._for[0] is not session or self._for[1] is not cameras:
            if self._for is not None and self._for[0] is session:
                self.save()
            self._canvases.clear()
            self._saved.clear()
            self._states = None
            self._for = session, cameras
        return self._for

    def _make_room(self) -> None:
        """Let go of what was looked at longest ago, never of what is not saved."""
        kept = sum(canvas.n_bytes for canvas in self._canvases.values())
        for name in list(self._canvases)[:-1]:
            if kept <= _CANVAS_BYTES:
                return
            if self._canvases[name].version == self._saved[name]:
                kept -= self._canvases.pop(name).n_bytes
                del self._saved[name]
