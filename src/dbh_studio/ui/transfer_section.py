"""The plot beside a LiDAR cloud of the same place: trunks carried over, both diameters. A part of the Export step."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import viser

from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.errors import StudioError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import set_content, set_disabled, set_value, set_visible, typed_path

if TYPE_CHECKING:
    from dbh_studio.app.transfer_plot import TransferReport, TransferRequest
    from dbh_studio.ui.tab import Tab

# Of each open plot the last transfer, and the state it was made of: every tab shows it.
_reports: WeakKeyDictionary[Session, tuple[Document, TransferReport]] = WeakKeyDictionary()

_WAYS = ("with scale (similarity)", "without scale (rigid)")


class TransferSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self._shown_for: Session | None = None
        self._drawn: TransferReport | None = None
        gui, worker = tab.client.gui, tab.worker
        self._folder = gui.add_folder("Compare with LiDAR", expand_by_default=False, visible=False)
        with self._folder:
            self._state = gui.add_html("")
            self._lidar = gui.add_text(
                "LiDAR cloud", "", hint="of the same place, on the computer the studio runs on; a cloud or a saved plot"
            )
            self._scanner = gui.add_text(
                "Scanner's path", "", hint="its trajectory (TUM, KITTI, CSV); empty lays the clouds on by their stems"
            )
            self._camera = gui.add_text(
                "Camera's path", "", hint="its trajectory, or a reconstruction; empty takes the photos of this plot"
            )
            self._rate = gui.add_text(
                "Frames per second", "", hint="of the camera's path, only where it tells no times; 30 for a film"
            )
            self._way = gui.add_dropdown("Fit", _WAYS, hint="without scale only where this plot's scale is exact")
            self._refine = gui.add_checkbox(
                "Fit stems and ground too",
                True,
                hint="takes a while; the clouds then lie on each other to a centimetre",
            )
            self._set_scale = gui.add_checkbox(
                "Take the LiDAR's scale", False, hint="this plot gets it; where it has no trunks they are found by that"
            )
            self._out = gui.add_text("Save in", "", hint="folder for the LiDAR plot and the table; beside this plot")
            self._replace = gui.add_checkbox("Replace an earlier one", False, hint="with the edits made in it")
            self._start = gui.add_button("Carry the trunks over", icon=viser.Icon.ARROWS_RIGHT_LEFT, color="green")
            worker.on_click(self._start, self._start_pressed)
            self._result = gui.add_html("", visible=False)
            self._open = gui.add_button("Open the LiDAR plot", icon=viser.Icon.TREES, color="gray", visible=False)
            worker.on_click(self._open, self._open_pressed)

    def refresh(self) -> None:
        """Say what is needed, or what was found."""
        session = self.tab.session
        set_visible(self._folder, session is not None)
        if session is None:
            return
        if session is not self._shown_for:  # later refreshes leave alone what is being typed
            self._shown_for = session
            for handle in (self._lidar, self._scanner, self._camera, self._rate, self._out):
                set_value(handle, "")  # they spoke of the plot before
            set_value(self._set_scale, not session.document.scale.is_known)
            set_value(self._replace, False)
        document, report = _reports.get(session, (None, None))
        set_visible(self._result, report is not None)
        set_visible(self._open, report is not None)
        if report is None:
            set_content(self._state, html.message(_first_words(session.document)))
            return
        is_old = document is not session.document
        changed = html.message("The plot has changed since. Carry the trunks over again.") if is_old else ""
        place = f"Saved: {report.project_dir.name} and {report.csv_path.name} in {report.project_dir.parent}."
        set_content(self._state, changed + html.message(place, level="ok"))
        if report is not self._drawn:
            from dbh_studio.ui.transfer_html import report_html

            self._drawn = report
            set_content(self._result, report_html(report))

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        for button in (self._start, self._open):
            set_disabled(button, busy)

    def _start_pressed(self) -> None:
        from dbh_studio.app.transfer_plot import apply_scale, photo_side
        from dbh_studio.ui.transfer_job import check_before, transfer

        session, studio = self.tab.require_session(), self.tab.studio
        request = self._request(session)
        check_before(request)

        def done(report: TransferReport) -> None:
            if request.set_scale and not session.is_read_only:
                apply_scale(session, report)
            _reports[session] = session.document, report
            studio.refresh_tabs()

        studio.start_job(
            "Carrying the trunks over", transfer, (*photo_side(session), request), session, done,
            failed=lambda _: studio.measure_missing(),
        )  # fmt: skip

    def _request(self, session: Session) -> TransferRequest:
        from dbh_studio.app.transfer_plot import TransferRequest, plot_file_name
        from dbh_studio.app.transfer_walks import WalkFile

        lidar = typed_path(self._lidar.value)
        if lidar is None:
            raise StudioError("No LiDAR cloud was named.", "Type where it lies.")
        camera, scanner = typed_path(self._camera.value), typed_path(self._scanner.value)
        saved = getattr(session.saver, "folder", None)
        beside = Path(saved if saved is not None else session.document.source.path).absolute()
        out = self._out.value.strip().strip("\"'")
        return TransferRequest(
            lidar,
            beside.parent / os.path.expanduser(out) if out else beside.parent,  # noqa: PTH111 - pathlib's raises
            plot_file_name(beside),
            photo_walk=None if camera is None else WalkFile(camera, rate_hz=self._typed_rate()),
            lidar_walk=None if scanner is None else WalkFile(scanner),
            with_scale=self._way.value == _WAYS[0],
            refine=bool(self._refine.value),
            set_scale=bool(self._set_scale.value),
            overwrite=bool(self._replace.value),
        )

    def _typed_rate(self) -> float | None:
        text = self._rate.value.strip().replace(",", ".")
        if not text:
            return None
        try:
            return float(text)
        except ValueError:
            raise StudioError(f"{text!r} is no number of frames per second.", "Type a number such as 30.") from None

    def _open_pressed(self) -> None:
        session = self.tab.require_session()
        _, report = _reports.get(session, (None, None))
        if report is not None:
            self.tab.studio.open_plot(report.project_dir)


def _first_words(document: Document) -> str:
    if len(document.trunks):
        return (
            "Type where a LiDAR cloud of the same place lies, and the trajectories of both sensors: the trunks are "
            "carried over under their numbers, and both diameters are shown side by side."
        )
    if document.scale.is_known:
        return "Find the trunks first: they are what is carried over."
    return (
        "This plot has no scale. A LiDAR cloud of the same place gives it one, where both sensors' trajectories are "
        "known; the trunks are found by it and carried over."
    )
