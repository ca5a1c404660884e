"""Step 2: how long one unit of the file is."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import viser

from dbh_studio.app import commands
from dbh_studio.app.lengths import metres_from_text
from dbh_studio.app.scaling import frame_from_square, scale_from_evidence
from dbh_studio.app.session import Session
from dbh_studio.core.bars import BarRole, ScaleReport
from dbh_studio.core.scale_evidence import MarkerSquare, ScaleBar, ScaleEvidence
from dbh_studio.ui import html, marking_html, scale_html
from dbh_studio.ui.panels.base import Panel, set_content, set_visible, show_anew
from dbh_studio.ui.photos_section import PhotosSection
from dbh_studio.ui.scale_markers import MarkerSection
from dbh_studio.ui.scale_number import NumberSection

_NEEDS_PHOTOS = "This needs the photos and their camera poses. Add them here:"
_WAY_NOTES = {
    "cloud": "Take something whose true length you know: a marker, a pole, a tape on the ground. Zoom in first.",
    "photos": "Click the same point in two or more photos from different sides. It is more exact than in the cloud.",
}


class ScalePanel(Panel):
    """Ways to a scale, one at a time, and the known lengths it rests on. Correctable at any time."""

    step = "scale"

    def build(self) -> None:
        """Add the inputs."""
        gui, bridge = self.gui, self.tab.bridge
        self._chosen_way, self._opened, self._photos_open = "", "", False
        self._seen: Session | None = None
        self._state = gui.add_html("")
        self._set_button = gui.add_button(
            "Set the scale from the known lengths", icon=viser.Icon.RULER_MEASURE, color="green", visible=False
        )
        self.tab.worker.on_click(self._set_button, self._set_from_lengths)
        self._ways = gui.add_html("", visible=False)
        self._note = gui.add_html("", visible=False)
        self._photos_line = gui.add_html("", visible=False)
        self._photos_folder = gui.add_folder(None, visible=False)
        with self._photos_folder:
            self._photos = PhotosSection(self.tab)
        self._markers_folder = gui.add_folder(None, visible=False)
        with self._markers_folder:
            self._markers = MarkerSection(self.tab)
        self._card = gui.add_html("", visible=False)
        self._number_folder = gui.add_folder(None, visible=False)
        with self._number_folder:
            self._number = NumberSection(self.tab)
        self._lengths = gui.add_html("", visible=False)
        for kind, fn in (
            ("scale-way", self._way_chosen),
            ("photos-open", self._opened_photos),
            ("length-open", self._opened_length),
            ("length-true", self._typed_length),
            ("length-role", self._chose_role),
            ("length-remove", self._removed_length),
            ("length-frame", self._used_for_frame),
        ):
            bridge.on(kind, fn)

    # ---- showing

    def refresh(self) -> None:
        """Show where one stands, the way that was chosen, and the known lengths."""
        session = self.tab.session
        for handle in (self._ways, self._lengths, self._set_button, self._card, self._note, self._photos_line):
            if session is None:
                set_visible(handle, False)
        if session is None:
            set_visible(self._state, True)
            set_content(self._state, html.message("Open a plot first."))
            for folder in (self._photos_folder, self._markers_folder, self._number_folder):
                set_visible(folder, False)
            return
        if session is not self._seen:
            self._seen, self._chosen_way, self._opened = session, "", ""
            self.tab.marking.forget()
        set_visible(self._state, not self.tab.marking.is_on)
        report = self._report(session)
        set_content(self._state, scale_html.state(session.document.scale, report, self._size(session)))
        self._show_way(session)
        self._show_lengths(session, report)

    def show(self, visible: bool) -> None:
        """Show or hide the panel, and the known lengths in the picture with it."""
        super().show(visible)
        self.tab.marking.show()

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        self._markers.set_busy(busy)
        self._photos.set_busy(busy)

    def _show_way(self, session: Session) -> None:
        way, has_photos = self._way(session), session.cameras is not None
        usable = {"markers": has_photos, "photos": has_photos, "cloud": True, "number": True}
        needs_photos = way in ("markers", "photos") and not has_photos
        set_content(self._ways, scale_html.ways(way, usable))
        set_visible(self._ways, not self.tab.marking.is_on)
        note = _NEEDS_PHOTOS if needs_photos else _WAY_NOTES.get(way, "")
        set_content(self._note, scale_html.note(note))
        set_visible(self._note, bool(note) and not self.tab.marking.is_on)
        is_about_photos = way in ("markers", "photos") and not self.tab.marking.is_on
        set_visible(self._photos_line, is_about_photos and has_photos)
        if session.cameras is not None:
            set_content(
                self._photos_line, scale_html.photos_line(len(session.cameras.posed), is_open=self._photos_open)
            )
        is_open = self._photos_open or not has_photos or self._photos.needs_attention
        set_visible(self._photos_folder, is_about_photos and is_open)
        self._photos.refresh()
        is_by_marker = way == "markers" and has_photos and not self.tab.marking.is_on
        set_visible(self._markers_folder, is_by_marker)
        if is_by_marker:
            self._markers.refresh(session)
        if self.tab.marking.is_on:
            set_content(self._card, self.tab.marking.card())
        elif way in ("cloud", "photos"):
            set_content(self._card, marking_html.start_card(way))
        set_visible(self._card, self.tab.marking.is_on or (way in ("cloud", "photos") and not needs_photos))
        set_visible(self._number_folder, way == "number" and not self.tab.marking.is_on)
        self._number.refresh(session)

    def _way(self, session: Session) -> str:
        """The way that is shown: the one chosen, else the one that is most likely right."""
        if self._chosen_way:
            return self._chosen_way
        check = session.data_check
        is_offered = self.tab.studio.photos.offer is not None and not session.document.scale.is_known
        if session.document.cameras is not None or is_offered:
            return "markers"
        is_told = check is not None and check.suggested_metres_per_unit is not None
        return "number" if session.document.scale.is_known or is_told else "cloud"

    def _show_lengths(self, session: Session, report: ScaleReport | None) -> None:
        evidence = session.document.evidence
        if self._opened not in evidence:
            self._opened = ""
        details = self._details(session, evidence) if self._opened else ""
        set_content(self._lengths, scale_html.lengths(evidence, report, opened=self._opened, details=details))
        is_shown = len(evidence) > 0 and not self.tab.marking.is_on
        set_visible(self._lengths, is_shown)
        can_set = is_shown and report is not None and report.estimate is not None
        is_open = can_set and report is not None and not scale_html.is_applied(session.document.scale, report)
        set_visible(self._set_button, is_open)

    def _details(self, session: Session, evidence: ScaleEvidence) -> str:
        length = evidence[self._opened]
        if isinstance(length, ScaleBar):
            return scale_html.bar_details(length)
        return scale_html.square_details(length, self._markers.pictures(session, length))

    @staticmethod
    def _report(session: Session) -> ScaleReport | None:
        document = session.document
        return document.evidence.report(np.array(document.up_direction)) if len(document.evidence) else None

    @staticmethod
    def _size(session: Session) -> str:
        """How large the plot is: the quickest way to see a wrong scale."""
        check = session.data_check
        if check is None:
            return ""
        scale = session.document.scale
        factor, unit = (scale.metres_per_unit, "m") if scale.is_known else (1.0, "units")
        width, depth, height = (f"{side:.3g}" for side in check.extent_src * factor)
        return f"{width} × {depth} {unit}, {height} {unit} high"

    # ---- what a person does

    def _way_chosen(self, payload: Any) -> None:
        if isinstance(payload, str) and payload in scale_html.WAYS:
            self._chosen_way = payload
            self.tab.refresh()

    def _set_from_lengths(self) -> None:
        session = self.tab.require_session()
        session.do(scale_from_evidence(session.document))

    def _opened_photos(self, _: Any) -> None:
        self._photos_open = not self._photos_open
        self.tab.refresh()

    def _opened_length(self, payload: Any) -> None:
        if isinstance(payload, str):
            self._opened = "" if payload == self._opened else payload
            self.tab.refresh()

    def _typed_length(self, payload: Any) -> None:
        length = self._length_of(payload, 2)
        if length is None or not isinstance(payload[1], str):
            return
        try:
            true_m = metres_from_text(payload[1], f"The length of {length.name}")
            field = "side_m" if isinstance(length, MarkerSquare) else "length_m"
            self.tab.require_session().do(commands.change_length(length.name, **{field: true_m}))
        except BaseException:
            # What was typed stands in the page only: the field shows again what is kept.
            show_anew(self._lengths, self._lengths.content)
            raise

    def _chose_role(self, payload: Any) -> None:
        length = self._length_of(payload, 2)
        if length is not None and payload[1] in get_args(BarRole):
            self.tab.require_session().do(commands.change_length(length.name, role=payload[1]))

    def _removed_length(self, payload: Any) -> None:
        if isinstance(payload, str):
            self.tab.require_session().do(commands.remove_length(payload))

    def _used_for_frame(self, payload: Any) -> None:
        length = self._length_of(payload, 4)
        if not isinstance(length, MarkerSquare) or not all(isinstance(on, bool) for on in payload[1:]):
            return
        session = self.tab.require_session()
        up, origin, north = payload[1:]
        session.do(frame_from_square(length, session.cloud, up=up, origin=origin, north=north))

    def _length_of(self, payload: Any, n_values: int) -> ScaleBar | MarkerSquare | None:
        """The length that a message ``[name, …]`` is about."""
        session = self.tab.session
        if session is None or not isinstance(payload, list) or len(payload) != n_values:
            return None
        name = payload[0]
        return session.document.evidence[name] if isinstance(name, str) and name in session.document.evidence else None
