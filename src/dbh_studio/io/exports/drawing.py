"""The stem map as a drawing: SVG to look at and print, DXF (release 12) for CAD. Metres of the plot, north up."""

from __future__ import annotations

from pathlib import Path

from dbh_studio.core.stand import PlotArea
from dbh_studio.io.exports.columns import Table, written_whole
from dbh_studio.io.exports.stem_map import North, area_outline, stem_map_svg

# A stem of unknown diameter is drawn as a cross of this size.
_CROSS_M = 0.3
_TEXT_M = 0.35


def write_svg(
    path: Path | str,
    table: Table,
    *,
    area: PlotArea | None = None,
    exaggeration: float = 3.0,
    north: North | None = None,
) -> Path:
    """Draw the stems as circles, wider than they are by `exaggeration`, with their numbers and a scale bar.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    with written_whole(path) as file:
        file.write(stem_map_svg(table, area=area, exaggeration=exaggeration, north=north).encode())
    return path


def write_dxf(path: Path | str, table: Table, *, area: PlotArea | None = None) -> Path:
    """Draw the stems as circles of their diameter on layer STEMS, numbers on NUMBERS, refused ones on REFUSED.

    In map coordinates where the plot has them, else in the plot's own metres.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    on_map = any(row.easting is not None for row in table.inventory)
    metre = 1.0 / _metres_per_map_unit(table) if on_map else 1.0
    groups: list[tuple[int, object]] = [(0, "SECTION"), (2, "ENTITIES")]
    for row in table.inventory:
        x, y = (row.easting, row.northing) if on_map else (row.x_m, row.y_m)
        if x is None or y is None:
            continue
        if row.dbh_cm is not None:
            radius = metre * row.dbh_cm / 200
            groups += [(0, "CIRCLE"), (8, "STEMS"), (10, x), (20, y), (30, 0.0), (40, radius)]
        else:
            radius = metre * _CROSS_M / 2
            for sign in (1.0, -1.0):
                groups += [(0, "LINE"), (8, "REFUSED"), (10, x - radius), (20, y - sign * radius), (30, 0.0)]
                groups += [(11, x + radius), (21, y + sign * radius), (31, 0.0)]
        groups += [(0, "TEXT"), (8, "NUMBERS"), (10, x + radius + 0.05 * metre), (20, y), (30, 0.0)]
        groups += [(40, metre * _TEXT_M), (1, str(row.stem_id))]
    outline = [] if on_map else area_outline(area)
    for (xa, ya), (xb, yb) in zip(outline, outline[1:] + outline[:1], strict=True):
        groups += [(0, "LINE"), (8, "PLOT"), (10, xa), (20, ya), (30, 0.0), (11, xb), (21, yb), (31, 0.0)]
    groups += [(0, "ENDSEC"), (0, "EOF")]
    lines = [f"{code}\n{f'{value:.4f}' if isinstance(value, float) else value}\n" for code, value in groups]
    with written_whole(path) as file:
        file.write("".join(lines).encode("ascii"))
    return path


def _metres_per_map_unit(table: Table) -> float:
    """Of the plot's map system, which may be in feet; 1 where that cannot be known."""
    codes = {row.epsg for row in table.inventory if row.epsg is not None}
    try:
        import pyproj
    except ImportError:
        return 1.0
    if len(codes) != 1:
        return 1.0
    return float(pyproj.CRS.from_epsg(codes.pop()).axis_info[0].unit_conversion_factor)
