"""A page that comes back: after a lost connection, a laptop that slept or a reload it gets its place in the plot again.

viser makes a new tab of it, with nothing chosen. Each time the page is asked it takes a new name and says which it had
before (`returning.js`); under these the studio finds what it was looking at, and keeps what was typed about a tree as
when another is chosen.

The tab that the page had before may still be counted as there: of a connection that died without a word (a laptop that
slept, another network) the server learns only when its pings stay unanswered, half a minute later, and the end of a
page that is loaded anew may be heard after its beginning. So a place is taken from such a tab as well. That the name is
new each time keeps two things apart: for the place of a tab that ends late nobody asks any more, and the copy of a page
in a second browser tab, which takes the names of the first along, is another page from then on.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float64
from dbh_studio.ui.view_state import ViewState

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

log = logging.getLogger(__name__)

_MOST_PAGES = 50
_LONGEST_NAME = 64
_MOST_NAMES = 10
# The server gives a connection up 40 s after the last answer.
_UNHEARD_S = 60.0


@dataclass(frozen=True, eq=False)
class _Place:
    """What a page was looking at when its tab went."""

    session: Session
    document: Document
    view: ViewState
    camera: tuple[Float64, Float64, Float64]


class LostPages:
    """Where the pages that have a tab now are, and the places of those whose tab has gone, the latest only."""

    def __init__(self) -> None:
        self._here: dict[str, Returning] = {}
        self._places: OrderedDict[str, _Place] = OrderedDict()
        self._lock = threading.Lock()

    def arrive(self, page: str, tab: Returning, earlier: Sequence[str]) -> Returning | _Place | None:
        """A page names itself.

        Args:
            page: Its name from now on.
            tab: Its tab.
            earlier: The names it had before, the latest first.

        Returns:
            The tab it had before, where that is still counted as there, or the place that was kept of it.
        """
        with self._lock:
            self._here[page] = tab
            known = (self._here.get(name) or self._places.get(name) for name in earlier if name != page)
            return next((found for found in known if found is not None), None)

    def leave(self, page: str, place: _Place | None) -> None:
        """The tab of a page has gone; remember where it was."""
        with self._lock:
            self._here.pop(page, None)
            if place is None:
                return
            self._places.pop(page, None)
            self._places[page] = place
            while len(self._places) > _MOST_PAGES:
                self._places.popitem(last=False)

    def clear(self) -> None:
        """Forget all places: another plot is open, and a place holds the whole cloud of its own."""
        with self._lock:
            self._places.clear()

    def knows(self, page: str) -> bool:
        """Whether a page with this name has a tab, or left a place."""
        with self._lock:
            return page in self._here or page in self._places


class Returning:
    """Keeps the place of one tab, and gives it that of the tab its page had before."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._page = ""
        # The place that is being given back: until it is, that is where the page is.
        self._on_its_way: _Place | None = None
        self._changed_elsewhere: tuple[tuple[float, Document], ...] = ()
        tab.bridge.on("page", self._page_named)
        tab.worker.on_close(self._tab_gone)

    def ask(self) -> None:
        """Ask the page for its name; the answer takes its turn in the tab's queue."""
        script = resources.files("dbh_studio.ui").joinpath("returning.js").read_text(encoding="utf-8")
        self._tab.bridge.run(script)

    def _page_named(self, payload: Any) -> None:
        if self._page or not _is_sound(payload):
            return
        self._page, earlier = payload
        pages = self._tab.studio.lost_pages
        before = pages.arrive(self._page, self, earlier)
        if self._tab.worker.closed:  # meanwhile, perhaps too early to be taken off the list
            pages.leave(self._page, None)
            return
        if isinstance(before, Returning):
            self._on_its_way = before.place(is_gone=False)
            # The tab may be gone for good, so what was typed in it is kept now; by a thread that is no tab's, or the
            # others were told of it as of something done here.
            before.keep_typed_beside().join()
        else:
            self._on_its_way = before
        if self._on_its_way is not None and self._on_its_way.session is self._tab.session:
            self._give_back(self._on_its_way)
        self._on_its_way = None

    def _give_back(self, place: _Place) -> None:
        tab = self._tab
        session, view = tab.require_session(), place.view
        ids = set(session.document.trunks.ids)
        tab.controls.set_mode(view.mode)
        tab.view.sort_column, tab.view.sort_descending = view.sort_column, view.sort_descending
        tab.view.review_filter, tab.view.n_inspected = view.review_filter, view.n_inspected
        tab.view.step = view.step
        if view.selected in ids:
            tab.select(view.selected, several=view.several if view.several <= ids else frozenset())
            tab.view.step, tab.view.n_inspected = view.step, view.n_inspected
        tab.refresh()
        with tab.client.atomic():
            tab.client.camera.position, tab.client.camera.look_at, tab.client.camera.up_direction = place.camera
        tab.worker.notify("Back where you were", _meanwhile(place, session), "info")

    def changed_elsewhere(self, before: Document) -> None:
        """Something else than this tab changed the plot; `before` is what the tab showed until then."""
        self._changed_elsewhere = (*self._not_surely_seen(), (time.monotonic(), before))

    def _not_surely_seen(self) -> tuple[tuple[float, Document], ...]:
        since = time.monotonic() - _UNHEARD_S
        return tuple(each for each in self._changed_elsewhere if each[0] > since)

    def plot_opened(self) -> None:
        """Forget what was before: it was another plot."""
        self._changed_elsewhere = ()

    def place(self, *, is_gone: bool = True) -> _Place | None:
        """Where the tab is, or was; None where no plot is open.

        Args:
            is_gone: Its end was heard. Else it may have gone unheard, and not have seen what others did since.
        """
        session, camera, on_its_way = self._tab.session, self._tab.client.camera, self._on_its_way
        if on_its_way is not None or session is None:
            return on_its_way
        document = session.document
        if not is_gone:
            document = next((before for _, before in self._not_surely_seen()), document)
        where = tuple(np.array(part, np.float64) for part in (camera.position, camera.look_at, camera.up_direction))
        return _Place(session, document, replace(self._tab.view), where)  # type: ignore[arg-type]

    def _tab_gone(self) -> None:
        """Called by the event loop, which must not wait."""
        place = self.place()
        if self._page:
            self._tab.studio.lost_pages.leave(self._page, place)
        if place is not None:
            self.keep_typed_beside()

    def keep_typed_beside(self) -> threading.Thread:
        """As `keep_typed`, in a thread of its own; returns it."""
        thread = threading.Thread(target=self.keep_typed, name="page gone", daemon=True)
        thread.start()
        return thread

    def keep_typed(self) -> None:
        """Keep what was typed about a tree and not sent off: the page, or the plot, is going, and with it the input."""
        for panel in self._tab.panels:
            try:
                panel.leave_tree()
            except Exception:
                log.warning("What was typed in a page that is gone could not be kept", exc_info=True)


def _is_sound(payload: Any) -> bool:
    """Whether this is a name and the names before it; it comes from a browser."""
    if not isinstance(payload, list) or len(payload) != 2 or not isinstance(payload[1], list):
        return False
    names = [payload[0], *payload[1]]
    return len(names) <= _MOST_NAMES and all(isinstance(each, str) and 0 < len(each) <= _LONGEST_NAME for each in names)


def _meanwhile(place: _Place, session: Session) -> str:
    if session.document is place.document:
        return "Nothing has changed meanwhile."
    last = f" Last of all: «{session.undo_label}»." if session.undo_label else ""
    return f"The plot was changed meanwhile, and is shown as it is now.{last}"
