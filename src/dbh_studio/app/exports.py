"""A plot handed in: inventory, maps, report, log and cloud, all of one state of the plot, under one name."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from dbh_studio.app.autosave import Autosave
from dbh_studio.app.document import Document
from dbh_studio.app.names import file_name
from dbh_studio.app.plot_areas import AreaFrame, area_from_text, placed_area, plot_area
from dbh_studio.app.report import PictureSize, ReportParts, make_report, north_of, protocol_words, scale_words
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float32, Int32
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.stand import ACRE_M2, PlotArea, StandTable, Units, stand_table
from dbh_studio.errors import FileError, SettingError
from dbh_studio.io.inventory_csv import check_not_source

if TYPE_CHECKING:
    from collections.abc import Iterator

    from dbh_studio.core.ground import GroundModel
    from dbh_studio.core.inventory import Inventory
    from dbh_studio.core.stem_profile import ProfilePoint
    from dbh_studio.io.exports.edit_log import LogEntry
    from dbh_studio.io.exports.report_model import Report

__all__ = [
    "FORMATS",
    "TITLES",
    "ExportRequest",
    "Format",
    "area_from_text",
    "edit_log",
    "export_plot",
    "heights_above",
    "labels_and_heights",
    "plot_area",
]

Format = Literal[
    "csv", "gpkg", "geojson", "xlsx", "report", "pdf", "3d", "profile", "edits", "svg", "dxf", "laz", "las"
]
FORMATS: tuple[Format, ...] = get_args(Format)
TITLES: dict[Format, str] = {
    "csv": "inventory, one row per stem",
    "gpkg": "GeoPackage: a layer of stems for QGIS and other map programs",
    "geojson": "stems with longitude and latitude",
    "xlsx": "Excel workbook: stems, stand table, edits, how it was measured",
    "report": "report to read and print, one HTML file",
    "pdf": "the report as PDF, printed by a Chromium or Chrome of this computer",
    "3d": "the plot to look at in 3D, one HTML file",
    "profile": "diameters along each stem, every 10 cm with their intervals, as CSV and, with xlsx, as a sheet of it; "
    "takes a while",
    "edits": "who changed what and when, as CSV",
    "svg": "stem map to look at and print",
    "dxf": "stem map for CAD",
    "laz": "the cloud, compressed, with tree_id and height above ground",
    "las": "the cloud, with tree_id and height above ground",
}

_CHUNK = 1 << 20


@dataclass(frozen=True)
class ExportRequest:
    """What to hand in.

    Attributes:
        formats: In which files.
        units: Of diameters and heights in tables and pages; CSVs are always metric, so that they can be read back.
        area: The plot, for the stand table and the maps; None takes the rectangle around the cloud, see `plot_area`.
        area_frame: What `area` was given in, see `plot_areas.placed_area`.
        class_width: Of the stand table's diameter classes, cm or inches; None takes 5 cm or 2 inches.
        least_dbh_cm: Thinner stems are no part of the stand table.
        pictures: Photographs in the report; ``small`` ones leave it small enough to be mailed.
        overwrite: Replace files of these names.
    """

    formats: tuple[Format, ...]
    units: Units = "metric"
    area: PlotArea | None = None
    area_frame: AreaFrame = "auto"
    class_width: float | None = None
    least_dbh_cm: float = 0.0
    pictures: PictureSize = "small"
    overwrite: bool = False


def export_plot(
    session: Session, out_dir: Path, request: ExportRequest, *, name: str = "", progress: Progress = ignore_progress
) -> tuple[Path, ...]:
    """Write the files asked for; each is whole or not there.

    Args:
        session: The plot; measured where it is not yet.
        out_dir: Made where it is not there.
        request: What to write.
        name: Of the files; the plot's own by default.
        progress: Called in between.

    Returns:
        The files, in the order asked for.

    Raises:
        UnscaledCloudError: The scale is not known.
        SettingError: Nothing, or an unknown format, is asked for, or the plot's area makes no sense.
        FileError: A file is there already, is what the plot is read from, or cannot be written.
        MissingComponentError: A package for a format is absent; the formats before it are written.
    """
    wanted = tuple(dict.fromkeys(request.formats))
    unknown = [each for each in wanted if each not in FORMATS]
    if unknown or not wanted:
        what = f"There is no format {unknown[0]!r}." if unknown else "No format was chosen."
        raise SettingError(what, f"Choose among {', '.join(FORMATS)}.")
    document = session.document
    session.require_scale(document)
    stem = file_name(name or document.plot_id)
    if out_dir.exists() and not out_dir.is_dir():
        raise FileError(out_dir, "This is a file and no folder.", "Name a folder; it is made where it is not there.")
    paths = {each: out_dir / f"{stem}{_ENDINGS.get(each, f'.{each}')}" for each in wanted}
    for path in paths.values():
        check_not_source(path, document.source.used)
        if path.exists() and not request.overwrite:
            raise FileError(
                path, "There is such a file already.", "Choose another folder, or say that it may be replaced."
            )
    share = 0.5 / len(wanted)
    area = placed_area(session, document, request.area, request.area_frame)
    inventory = session.inventory(subprogress(progress, 0.0, 0.5), document=document)
    writer = _Writer(session, document, request, inventory, area)
    if not _WITH_STAND.isdisjoint(wanted):
        _ = writer.stand  # What makes no sense is said before anything is written.
    for number, (each, path) in enumerate(paths.items()):
        progress(0.5 + share * number, f"Writing {path.name}")
        writer.write(each, path, subprogress(progress, 0.5 + share * number, 0.5 + share * (number + 1)))
    progress(1.0, "")
    return tuple(paths.values())


_WITH_STAND = frozenset({"xlsx", "report", "pdf"})
_ENDINGS = {
    "csv": "_inventory.csv",
    "report": "_report.html",
    "pdf": "_report.pdf",
    "3d": "_3d.html",
    "profile": "_profile.csv",
    "edits": "_edits.csv",
    "svg": "_map.svg",
    "dxf": "_map.dxf",
    "laz": "_trees.laz",
    "las": "_trees.las",
}


def edit_log(session: Session, document: Document, units: Units = "metric") -> tuple[LogEntry, ...]:
    """What was done to the plot, where it is saved, and the corrections and reviews that stand.

    Raises:
        ProjectError: The history cannot be read.
    """
    from dbh_studio.io.exports.edit_log import decisions, history_entries
    from dbh_studio.io.exports.pages import Words
    from dbh_studio.io.history import read_history

    saver = session.saver
    if isinstance(saver, Autosave):
        # What was done a moment ago may not be on disk yet; where it cannot be saved, the studio says so elsewhere.
        saver.flush()
    folder = saver.folder if isinstance(saver, Autosave) else session.read_from
    history = read_history(folder) if folder is not None else []
    return (*history_entries(history), *decisions(document.trees, Words(units)))


def labels_and_heights(session: Session, document: Document) -> tuple[Int32, Float32]:
    """(N,) tree of every point, 0 where none, and (N,) its height above the ground below it, metres."""
    return document.trunks.labels(len(session.cloud)), heights_above(
        session.points_world(document), session.ground(document=document)
    )


def heights_above(points_world: Float32, ground: GroundModel) -> Float32:
    """(N,) height of every point above the ground below it; NaN where a point has no place."""
    heights = np.empty(len(points_world), np.float32)
    for start in range(0, len(points_world), _CHUNK):
        part = points_world[start : start + _CHUNK]
        heights[start : start + _CHUNK] = ground.height_above(part)
    return heights


class _Writer:
    """One state of a plot, on its way into files."""

    def __init__(
        self, session: Session, document: Document, request: ExportRequest, inventory: Inventory, area: PlotArea
    ) -> None:
        from dbh_studio.io.exports import table_of

        self.session, self.document, self.request, self.inventory = session, document, request, inventory
        self.area = area
        self.table = table_of(inventory, request.units)
        self._report: Report | None = None
        self._seen_along: dict[int, tuple[ProfilePoint, ...]] = {}

    def write(self, kind: Format, path: Path, progress: Progress) -> None:
        """Write one file."""
        from dbh_studio.io import exports
        from dbh_studio.io.inventory_csv import write_inventory_csv

        if kind == "csv":
            write_inventory_csv(path, self.inventory)
        elif kind == "gpkg":
            exports.write_geopackage(path, self.table)
        elif kind == "geojson":
            exports.write_geojson(path, self.table)
        elif kind == "xlsx":
            profiles = None
            if "profile" in self.request.formats:  # Else a table of seconds would take minutes.
                profiles = exports.profile_table(self.inventory, self._profiles(progress), self.request.units)
            exports.write_xlsx(path, self.table, self.stand, about=self._about(), log=self.log, profiles=profiles)
        elif kind == "svg":
            exports.write_svg(path, self.table, area=self.area, north=north_of(self.session, self.document))
        elif kind == "dxf":
            exports.write_dxf(path, self.table, area=self.area)
        elif kind == "edits":
            exports.write_edits_csv(path, self.log)
        elif kind == "profile":
            exports.write_profiles_csv(path, self.inventory, self._profiles(progress))
        elif kind in ("report", "pdf"):
            self._write_report(kind, path, progress)
        elif kind == "3d":
            from dbh_studio.app.scene_page import make_scene

            exports.write_scene_html(path, make_scene(self.session, self.document, self.table))
        else:
            self._write_cloud(path, progress)

    def _write_report(self, kind: Format, path: Path, progress: Progress) -> None:
        from dbh_studio.io import exports

        if self._report is None:
            parts = ReportParts(self.table, self.stand, self.area, self.log)
            size = self.request.pictures
            self._report = make_report(self.session, self.document, parts, pictures=size, progress=progress)
        if kind == "report":
            exports.write_report_html(path, self._report)
        else:
            from dbh_studio.app.report_pdf import write_report_pdf

            write_report_pdf(path, exports.report_html(self._report))

    def _profiles(self, progress: Progress) -> Iterator[tuple[int, tuple[ProfilePoint, ...]]]:
        """By number of the stem; what one file looked at is there for the next."""
        ids = [row.stem_id for row in self.inventory]
        for number, stem_id in enumerate(ids):
            if stem_id not in self._seen_along:
                progress(number / len(ids), f"Looking along stem {stem_id}")
                self._seen_along[stem_id] = self.session.profile(stem_id, document=self.document)
            yield stem_id, self._seen_along[stem_id]

    def _write_cloud(self, path: Path, progress: Progress) -> None:
        from dbh_studio.io import exports

        tree_id, height = labels_and_heights(self.session, self.document)
        used = self.document.source.used
        values = {"tree_id": tree_id, "height_above_ground": height}
        source = used[0] if len(used) == 1 else None
        exports.write_labelled_cloud(path, self.session.cloud, values, source=source, progress=progress)

    @cached_property
    def log(self) -> tuple[LogEntry, ...]:
        """What was done to the plot."""
        return edit_log(self.session, self.document, self.request.units)

    @cached_property
    def stand(self) -> StandTable:
        """The stand table."""
        request = self.request
        try:
            return stand_table(
                self.inventory,
                self.area,
                units=request.units,
                class_width=request.class_width,
                least_dbh_cm=request.least_dbh_cm,
            )
        except ValueError as error:
            raise SettingError(f"There is no such stand table: {error}.", "Choose wider diameter classes.") from None

    def _about(self) -> dict[str, str]:
        document, area = self.document, self.area
        acres = f" = {area.area_m2 / ACRE_M2:.4f} acre" if self.request.units == "imperial" else ""
        return {
            "Plot": document.plot_id,
            "Cloud": document.source.path.name,
            "Points": f"{document.source.n_points:,}",
            "Breast height": f"{document.settings.measure.breast_height_m:.2f} m",
            "Protocol": protocol_words(document, self.request.units),
            "Curve": document.settings.measure.curve,
            "Scale": scale_words(document),
            "Plot area": f"{area.area_m2:,.1f} m² ({area.kind}){acres}",
            "Stems without a diameter": f"{self.inventory.n_refused} of {len(self.inventory)}; each row says why",
        }
