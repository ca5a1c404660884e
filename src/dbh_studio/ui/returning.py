"""A page that comes back: after a lost connection, a laptop that slept or a reload it gets its place in the plot again.

viser makes a new tab of it, with nothing chosen. The page keeps a name (`returning.js`), under which the studio
remembers what its last tab was looking at; what was typed about a tree is kept as when another is chosen.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
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


@dataclass(frozen=True, eq=False)
class _Place:
    """What a page was looking at when its tab went."""

    session: Session
    document: Document
    view: ViewState
    camera: tuple[Float64, Float64, Float64]


class LostPages:
    """The places of pages whose tab has gone, the latest only."""

    def __init__(self) -> None:
        self._places: OrderedDict[str, _Place] = OrderedDict()
        self._lock = threading.Lock()

    def put(self, page: str, place: _Place) -> None:
        """Remember a place."""
        with self._lock:
            self._places.pop(page, None)
            self._places[page] = place
            while len(self._places) > _MOST_PAGES:
                self._places.popitem(last=False)

    def clear(self) -> None:
        """Forget all: another plot is open, and a place holds the whole cloud of its own."""
        with self._lock:
            self._places.clear()

    def take(self, page: str) -> _Place | None:
        """What was remembered of a page."""
        with self._lock:
            return self._places.pop(page, None)


class Returning:
    """Keeps the place of one tab, and gives it that of the tab its page had before."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._page = ""
        tab.bridge.on("page", self._page_named)
        tab.worker.on_close(self._tab_gone)

    def ask(self) -> None:
        """Ask the page for its name, once the tab shows the plot."""
        script = resources.files("dbh_studio.ui").joinpath("returning.js").read_text(encoding="utf-8")
        self._tab.bridge.run(script)

    def _page_named(self, payload: Any) -> None:
        is_sound = isinstance(payload, list) and len(payload) == 2 and isinstance(payload[0], str)
        if not is_sound or not 0 < len(payload[0]) <= _LONGEST_NAME or self._page:
            return
        self._page = payload[0]
        place = self._tab.studio.lost_pages.take(self._page)
        if place is not None and place.session is self._tab.session:
            self._give_back(place)

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
        tab.worker.notify("Connected again", _meanwhile(place, session), "info")

    def _tab_gone(self) -> None:
        """Called by the event loop, which must not wait."""
        session, view, camera = self._tab.session, self._tab.view, self._tab.client.camera
        if session is None:
            return
        if self._page:
            where = tuple(np.array(part, np.float64) for part in (camera.position, camera.look_at, camera.up_direction))
            place = _Place(session, session.document, replace(view), where)  # type: ignore[arg-type]
            self._tab.studio.lost_pages.put(self._page, place)
        threading.Thread(target=self.keep_typed, name="page gone", daemon=True).start()

    def keep_typed(self) -> None:
        """Keep what was typed about a tree and not sent off: the page, or the plot, is going, and with it the input."""
        for panel in self._tab.panels:
            try:
                panel.leave_tree()
            except Exception:
                log.warning("What was typed in a page that is gone could not be kept", exc_info=True)


def _meanwhile(place: _Place, session: Session) -> str:
    if session.document is place.document:
        return "Nothing has changed meanwhile."
    last = f" Last of all: «{session.undo_label}»." if session.undo_label else ""
    return f"The plot was changed meanwhile, and is shown as it is now.{last}"
