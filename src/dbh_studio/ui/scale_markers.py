"""Scale by markers that a program finds in the photos: the side, one button, and what was left out."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import viser

from dbh_studio.app.found_markers import change_side
from dbh_studio.app.lengths import metres_from_text
from dbh_studio.app.session import Session
from dbh_studio.core.scale_evidence import MarkerSquare
from dbh_studio.ui import scale_html
from dbh_studio.ui.panels.base import set_content, set_disabled, show_anew

if TYPE_CHECKING:
    from dbh_studio.stages.marker_detect import Detection
    from dbh_studio.ui.tab import Tab

_DEFAULT_SIDE_M = 1.0


class MarkerSection:
    """The inputs, built at the GUI's current place."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._side_m = _DEFAULT_SIDE_M
        self._side_of: Session | None = None
        gui = tab.client.gui
        self._side = gui.add_html("")
        self._find = gui.add_button("Find markers in the photos", icon=viser.Icon.QRCODE, color="green")
        self._problems = gui.add_html("")
        tab.worker.on_click(self._find, self._find_pressed)
        tab.bridge.on("marker-side", self._side_typed)
        tab.bridge.on("strike", self._struck)
        tab.bridge.on("use-marker", self._used)

    def refresh(self, session: Session) -> None:
        """Show the side, and why markers were left out."""
        sides = Counter(s.side_m for s in session.document.evidence.squares if s.marker is not None)
        if session is not self._side_of:
            self._side_of, self._side_m = session, _DEFAULT_SIDE_M
        if sides and self._side_m not in sides:
            # After Undo, or where another tab or the list below gave them another.
            self._side_m = sides.most_common(1)[0][0]
        set_content(self._side, scale_html.side_input(self._side_m))
        finds, markers = self._tab.studio.markers.of(session), self._tab.studio.markers
        text = scale_html.problems(markers.problems)
        if finds is not None and not finds:
            text = scale_html.note("No marker was found in any photo. Mark its corners by hand, or a known distance.")
        placed = {square.marker for square in session.document.evidence.squares}
        left_out: dict[tuple[str, int], list[Detection]] = {}
        for find in finds or ():
            if find.key not in placed:
                left_out.setdefault(find.key, []).append(find)
        text += "".join(
            scale_html.left_out(key, found, session.document.evidence.struck, self._side_m)
            for key, found in left_out.items()
        )
        set_content(self._problems, text)
        label = "Find markers in the photos" if finds is None else "Find the markers again"
        if self._find.label != label:
            self._find.label = label

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        set_disabled(self._find, busy)

    def pictures(self, session: Session, square: MarkerSquare) -> str:
        """The finds of one marker."""
        if square.marker is None:
            return ""
        finds = [each for each in self._tab.studio.markers.of(session) or () if each.key == square.marker]
        used = sorted({sight.image for corner in square.corners for sight in corner.sights})
        return scale_html.pictures(finds, session.document.evidence.struck, used)

    def _find_pressed(self) -> None:
        self._tab.studio.markers.search(self._side_m)

    def _side_typed(self, payload: Any) -> None:
        if not isinstance(payload, str):
            return
        session = self._tab.require_session()
        try:
            side_m = metres_from_text(payload, "The side of the black square")
            before, self._side_m = self._side_m, side_m
            session.do(change_side(session.document, before, side_m))
        finally:
            # What was typed stands in the page only: the field shows again what is in use.
            show_anew(self._side, scale_html.side_input(self._side_m))

    def _used(self, payload: Any) -> None:
        if not isinstance(payload, list) or len(payload) != 3:
            return
        dictionary, number, text = payload
        if isinstance(dictionary, str) and isinstance(number, int) and isinstance(text, str):
            side_m = metres_from_text(text, "The side of the black square")
            self._tab.studio.markers.use(self._tab.require_session(), (dictionary, number), side_m, self._side_m)

    def _struck(self, payload: Any) -> None:
        if (
            not isinstance(payload, list)
            or len(payload) != 2
            or not isinstance(payload[0], list)
            or len(payload[0]) != 3
            or not isinstance(payload[1], bool)
        ):
            return
        image, dictionary, number = payload[0]
        if isinstance(image, str) and isinstance(dictionary, str) and isinstance(number, int):
            session = self._tab.require_session()
            self._tab.studio.markers.strike(session, (image, dictionary, number), self._side_m, struck=payload[1])
