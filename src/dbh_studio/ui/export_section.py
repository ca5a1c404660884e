"""Handing in as files: formats, units, the plot's area and the folder. A part of the Export step."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from dbh_studio.app.autosave import Autosave
from dbh_studio.app.doctor import find_chromium
from dbh_studio.app.exports import FORMATS, ExportRequest, Format, export_plot
from dbh_studio.app.jobs import Job
from dbh_studio.app.plot_areas import area_from_text
from dbh_studio.app.report import PictureSize
from dbh_studio.app.session import Session
from dbh_studio.core.progress import Progress
from dbh_studio.core.stand import PlotArea
from dbh_studio.errors import SettingError, StudioError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import set_content, set_disabled, set_value, set_visible, typed_path

if TYPE_CHECKING:
    from collections.abc import Callable

    from dbh_studio.app.document import Document
    from dbh_studio.ui.tab import Tab

_LABELS: dict[Format, str] = {
    "csv": "Inventory (CSV)",
    "gpkg": "Map layer (GeoPackage)",
    "geojson": "Map layer (GeoJSON)",
    "xlsx": "Excel, with stand table",
    "report": "Report (HTML)",
    "pdf": "Report (PDF)",
    "3d": "3D page (HTML)",
    "profile": "Stem profiles (CSV, Excel)",
    "edits": "Edit log (CSV)",
    "svg": "Stem map (SVG)",
    "dxf": "Stem map (DXF)",
    "laz": "Cloud with tree ids (LAZ)",
}
_FIRST: tuple[Format, ...] = ("csv", "gpkg", "xlsx")
_PHOTOS: dict[str, PictureSize] = {"small, to be mailed": "small", "large": "large", "none": "none"}
_UNITS = {"cm, metres, hectares": "metric", "inches, feet, acres": "imperial"}
_EXTENT, _CIRCLE, _POLYGON = "rectangle around the cloud", "circle", "polygon"


class ExportSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self._shown_for: object = None
        self._written: tuple[Path, ...] = ()
        self._written_of: Document | None = None
        gui, worker = tab.client.gui, tab.worker
        self._folder = gui.add_folder("Files to hand in", expand_by_default=False)
        with self._folder:
            offered = [each for each in FORMATS if each in _LABELS and (each != "pdf" or find_chromium() is not None)]
            self._formats = {each: gui.add_checkbox(_LABELS[each], each in _FIRST) for each in offered}
            self._photos = gui.add_dropdown(
                "Photographs in the report", tuple(_PHOTOS), hint="of each tree, where the plot has photos"
            )
            self._units = gui.add_dropdown("Units", tuple(_UNITS), hint="of tables and maps; the CSV is always in cm")
            self._area = gui.add_dropdown(
                "Plot area",
                (_EXTENT, _CIRCLE, _POLYGON),
                hint="stems whose centre is outside are not in the stand table",
            )
            worker.on_update(self._area, lambda _: self._show_area())
            self._centre = gui.add_vector2("Centre x, y (m)", (0.0, 0.0), step=0.1, visible=False)
            self._radius = gui.add_number("Radius (m)", 12.62, min=0.1, max=10_000.0, step=0.1, visible=False)
            self._corners = gui.add_text(
                "File with corners",
                "",
                hint="on the computer the studio runs on: a corner per line, x and y in metres of the plot, or easting "
                "and northing of its map",
                visible=False,
            )
            self._where = gui.add_text("Folder", "", hint="on the computer the studio runs on; made where it is absent")
            self._overwrite = gui.add_checkbox("Replace files of these names", False)
            self._write = gui.add_button("Write the files", icon=viser.Icon.FILE_EXPORT, color="green")
            worker.on_click(self._write, self._write_pressed)
            self._state = gui.add_html("")

    def refresh(self) -> None:
        """Bring the folder in step with the plot, and name the files written."""
        session = self.tab.session
        is_ready = session is not None and len(session.document.trunks) > 0
        set_visible(self._folder, is_ready)
        if session is None:
            return
        if session is not self._shown_for:  # later refreshes leave alone what is being typed
            self._shown_for, self._written = session, ()
            set_value(self._where, str(_beside(session)))
        if not self._written:
            set_content(self._state, "")
            return
        names, folder = ", ".join(path.name for path in self._written), self._written[0].parent
        is_old = session.document is not self._written_of
        old = html.message("The plot has changed since. Write the files again.") if is_old else ""
        set_content(self._state, old + html.message(f"Written to {folder}: {names}.", level="ok"))

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        set_disabled(self._write, busy)

    def _show_area(self) -> None:
        for handle in (self._centre, self._radius):
            set_visible(handle, self._area.value == _CIRCLE)
        set_visible(self._corners, self._area.value == _POLYGON)

    def _request(self) -> ExportRequest:
        area = None
        if self._area.value == _CIRCLE:
            try:
                area = PlotArea.circle(self._centre.value, float(self._radius.value))
            except ValueError as error:
                raise SettingError(f"The plot cannot be this circle: {error}.") from None
        elif self._area.value == _POLYGON:
            corners = typed_path(self._corners.value)
            if corners is None:
                raise StudioError("No file with corners was named.", "Type its path, or choose another plot area.")
            area = area_from_text(None, corners)
        units: Any = _UNITS[self._units.value]
        chosen = tuple(each for each, box in self._formats.items() if box.value)
        return ExportRequest(
            chosen,
            units=units,
            area=area,
            pictures=_PHOTOS[self._photos.value],
            overwrite=bool(self._overwrite.value),
        )

    def _write_pressed(self) -> None:
        session = self.tab.require_session()
        text = self._where.value.strip().strip("\"'")
        if not text:
            raise StudioError("No folder was named.", "Type where the files should go.")
        request, folder = self._request(), _beside(session).parent / os.path.expanduser(text)  # noqa: PTH111 - may raise
        if not request.formats:
            raise StudioError("No file was chosen.", "Tick one or more.")

        def work(progress: Progress, _: Callable[[Job], object]) -> tuple[Path, ...]:
            return export_plot(session, folder, request, progress=progress)

        document = session.document
        done = functools.partial(self._done, document)
        self.tab.studio.start_work("Writing the files", work, session, done)

    def _done(self, document: Document, written: tuple[Path, ...]) -> None:
        self._written, self._written_of = written, document
        self.tab.studio.exported(document)
        self.tab.worker.notify("Files written", f"{len(written)} files in {written[0].parent}.", "success")


def _beside(session: Session) -> Path:
    """A folder beside the saved plot, or beside the cloud."""
    saver = session.saver
    home = saver.folder if isinstance(saver, Autosave) else session.document.source.path
    return home.parent / f"{home.stem} hand-in"
