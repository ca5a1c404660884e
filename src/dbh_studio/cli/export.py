"""`dbh-studio export`: hand in a saved plot, in the formats asked for."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from dbh_studio.cli.common import add_relocation_option, finite_number, path_argument, plain, progress_for

_FORMATS = ("csv", "gpkg", "geojson", "xlsx", "report", "pdf", "3d", "profile", "edits", "svg", "dxf", "laz", "las")


def add_commands(commands: Any) -> None:
    """Register the command."""
    export = commands.add_parser(
        "export",
        help="write inventory, report, maps, stand table and labelled cloud of a saved plot",
        description="Write a saved plot (NAME.dbh) in the formats it is handed in. All of them are made of one table: "
        "the same ids and numbers everywhere, an empty cell for what is not known.",
    )
    export.add_argument("plot", type=path_argument, help="a saved NAME.dbh")
    export.add_argument(
        "--format",
        action="append",
        default=[],
        dest="formats",
        metavar="FORMAT",
        choices=_FORMATS,
        help=f"one of {', '.join(_FORMATS)}; may be given several times; csv, gpkg and xlsx where none is named",
    )
    export.add_argument("--out", type=path_argument, default=Path(), metavar="DIR", help="where to; here by default")
    export.add_argument(
        "--imperial", action="store_true", help="diameters in inches, heights in feet, areas in acres; not in the CSV"
    )
    area = export.add_argument_group("plot area, for the stand table and the maps")
    area.add_argument(
        "--circle", type=finite_number, nargs=3, metavar=("X", "Y", "RADIUS"), help="a circular plot, metres"
    )
    area.add_argument("--polygon", type=path_argument, metavar="FILE", help="a text file with a corner per line: x, y")
    frame = area.add_mutually_exclusive_group()
    frame.add_argument(
        "--map",
        action="store_const",
        const="map",
        dest="area_frame",
        default="auto",
        help="circle or polygon are easting and northing of the cloud's map system; the radius stays in metres. By "
        "default they are taken for that where they lie off the cloud in the plot's own metres, and so lie on it",
    )
    frame.add_argument(
        "--plot-metres",
        action="store_const",
        const="plot",
        dest="area_frame",
        default="auto",
        help="circle or polygon are in the plot's own metres, as the stem map has them",
    )
    area.add_argument(
        "--least-dbh", type=finite_number, default=0.0, metavar="CM", help="thinner stems are not in the stand table"
    )
    area.add_argument(
        "--class-width", type=finite_number, metavar="WIDTH", help="of diameter classes; 5 cm or 2 inches by default"
    )
    export.add_argument(
        "--photos",
        choices=("none", "small", "large"),
        default="small",
        help="photographs of the trees in the report, where the plot has photos; small ones leave it small enough to "
        "be mailed",
    )
    export.add_argument("--overwrite", action="store_true", help="replace files of these names")
    add_relocation_option(export)
    export.add_argument("--json", action="store_true", help="print the files as JSON")
    export.add_argument("--quiet", action="store_true", help="no progress")
    export.set_defaults(command=export_saved)


def export_saved(options: argparse.Namespace) -> int:
    """Write the files and name them."""
    from dbh_studio.app.exports import ExportRequest, area_from_text, export_plot
    from dbh_studio.app.opening import open_plot
    from dbh_studio.errors import SettingError
    from dbh_studio.io.project import is_project

    if not is_project(options.plot):
        raise SettingError(
            f"{options.plot.name} is no saved plot.", "Give a NAME.dbh; `dbh-studio run` makes one of a cloud."
        )
    if options.class_width is not None and options.class_width <= 0:
        raise SettingError("Diameter classes must be wider than 0.", "Leave --class-width away, or give a width.")
    request = ExportRequest(
        formats=tuple(options.formats) or ("csv", "gpkg", "xlsx"),
        units="imperial" if options.imperial else "metric",
        area=area_from_text(options.circle, options.polygon),
        area_frame=options.area_frame,
        class_width=options.class_width,
        least_dbh_cm=options.least_dbh,
        pictures=options.photos,
        overwrite=options.overwrite,
    )
    with progress_for(options) as progress:
        session = open_plot(
            options.plot, relocate=options.cloud, read_only=True, background_save=False, progress=progress
        )
        try:
            written = export_plot(session, options.out, request, progress=progress)
        finally:
            session.close()
    if options.json:
        print(json.dumps({"files": [str(path) for path in written]}))
    else:
        for path in written:
            print(plain(str(path)))
    return 0
