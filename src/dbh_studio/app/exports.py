"""A plot handed in: inventory, stem map, stand table and cloud, all of one state of the plot, under one name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.names import file_name
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float32, Float64, Int32
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.stand import PlotArea, StandTable, Units, stand_table
from dbh_studio.errors import FileError, SettingError
from dbh_studio.io.inventory_csv import check_not_source

if TYPE_CHECKING:
    from dbh_studio.core.ground import GroundModel
    from dbh_studio.core.inventory import Inventory

Format = Literal["csv", "gpkg", "geojson", "xlsx", "svg", "dxf", "laz", "las"]
FORMATS: tuple[Format, ...] = get_args(Format)
TITLES: dict[Format, str] = {
    "csv": "inventory, one row per stem",
    "gpkg": "GeoPackage: a layer of stems for QGIS and other map programs",
    "geojson": "stems with longitude and latitude",
    "xlsx": "Excel workbook: stems, stand table, how it was measured",
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
        units: Of diameters and heights in tables; the CSV is always metric, so that it can be read back.
        area: The plot, for the stand table and the maps; None takes the rectangle around the cloud's ground.
        class_width: Of the stand table's diameter classes, cm or inches; None takes 5 cm or 2 inches.
        least_dbh_cm: Thinner stems are no part of the stand table.
        overwrite: Replace files of these names.
    """

    formats: tuple[Format, ...]
    units: Units = "metric"
    area: PlotArea | None = None
    class_width: float | None = None
    least_dbh_cm: float = 0.0
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
        SettingError: Nothing, or an unknown format, is asked for.
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
    paths = {each: out_dir / f"{stem}{_ENDINGS.get(each, f'.{each}')}" for each in wanted}
    for path in paths.values():
        check_not_source(path, document.source.used)
        if path.exists() and not request.overwrite:
            raise FileError(
                path, "There is such a file already.", "Choose another folder, or say that it may be replaced."
            )
    share = 0.5 / len(wanted)
    inventory = session.inventory(subprogress(progress, 0.0, 0.5), document=document)
    writer = _Writer(session, document, request, inventory)
    for number, (each, path) in enumerate(paths.items()):
        progress(0.5 + share * number, f"Writing {path.name}")
        writer.write(each, path, subprogress(progress, 0.5 + share * number, 0.5 + share * (number + 1)))
    progress(1.0, "")
    return tuple(paths.values())


_ENDINGS = {"csv": "_inventory.csv", "svg": "_map.svg", "dxf": "_map.dxf", "laz": "_trees.laz", "las": "_trees.las"}


def plot_area(session: Session, document: Document) -> PlotArea:
    """The rectangle, along x and y, in which 98 % of the cloud's points are: stray points are no plot.

    Raises:
        SettingError: The cloud has no extent.
    """
    points = session.points_world(document)
    sample = points[:: max(1, len(points) // 500_000), :2].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    try:
        return PlotArea.extent(np.quantile(sample, [0.01, 0.99], axis=0)) if len(sample) else PlotArea.extent(sample)
    except ValueError as error:
        raise SettingError(f"The plot has no area: {error}.", "Say it, as a circle or a polygon.") from None


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

    def __init__(self, session: Session, document: Document, request: ExportRequest, inventory: Inventory) -> None:
        from dbh_studio.io.exports import table_of

        self.session, self.document, self.request, self.inventory = session, document, request, inventory
        self.table = table_of(inventory, request.units)

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
            exports.write_xlsx(path, self.table, self._stand(), about=self._about())
        elif kind == "svg":
            exports.write_svg(path, self.table, area=self._area())
        elif kind == "dxf":
            exports.write_dxf(path, self.table, area=self._area())
        else:
            tree_id, height = labels_and_heights(self.session, self.document)
            used = self.document.source.used
            values = {"tree_id": tree_id, "height_above_ground": height}
            source = used[0] if len(used) == 1 else None
            exports.write_labelled_cloud(path, self.session.cloud, values, source=source, progress=progress)

    def _area(self) -> PlotArea:
        return self.request.area or plot_area(self.session, self.document)

    def _stand(self) -> StandTable:
        request = self.request
        return stand_table(
            self.inventory,
            self._area(),
            units=request.units,
            class_width=request.class_width,
            least_dbh_cm=request.least_dbh_cm,
        )

    def _about(self) -> dict[str, str]:
        document = self.document
        area, scale = self._area(), document.scale
        error = scale.standard_error
        return {
            "Plot": document.plot_id,
            "Cloud": document.source.path.name,
            "Points": f"{document.source.n_points:,}",
            "Breast height": f"{document.settings.measure.breast_height_m:.2f} m",
            "Curve": document.settings.measure.curve,
            "Scale": f"{scale.metres_per_unit:.6g} m per unit ({scale.source})"
            + (f", standard error {100 * error / scale.metres_per_unit:.2f} %" if error is not None else ""),
            "Plot area": f"{area.area_m2:,.1f} m² ({area.kind})",
            "Stems without a diameter": f"{self.inventory.n_refused} of {len(self.inventory)}; each row says why",
        }


def area_from_text(circle: Sequence[float] | None, polygon: Path | None) -> PlotArea | None:
    """The plot as a person gives it: x, y and radius of a circle, or a file with a corner per line.

    Raises:
        SettingError: It is no plot.
        FileError: The file cannot be read or holds something else.
    """
    if circle is not None and polygon is not None:
        raise SettingError("The plot is either a circle or a polygon.", "Leave one of them away.")
    try:
        if circle is not None:
            return PlotArea.circle(circle[:2], circle[2])
        if polygon is not None:
            return PlotArea.polygon(_corners(polygon))
    except ValueError as error:
        raise SettingError(f"The plot cannot be this: {error}.") from None
    return None


def _corners(path: Path) -> Float64:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"The corners cannot be read ({error}).") from None
    corners = []
    for number, line in enumerate(text.splitlines(), start=1):
        # Where semicolons divide, a comma is the decimal sign.
        divided = line.replace(",", ".").replace(";", " ") if ";" in line else line.replace(",", " ")
        parts = divided.split()
        if not parts or parts[0].startswith("#"):
            continue
        try:
            corners.append([float(part) for part in parts[:2]])
            if len(parts) < 2:
                raise ValueError
        except ValueError:
            if not corners and number == 1:
                continue  # a line of headings
            raise FileError(
                path, f"Line {number} is no corner: {line[:40]!r}.", "Give x and y in metres, a corner per line."
            ) from None
    return np.array(corners, np.float64).reshape(-1, 2)
