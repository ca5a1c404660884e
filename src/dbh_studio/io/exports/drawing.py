"""The stem map as a drawing: SVG to look at and print, DXF (release 12) for CAD. Metres of the plot, north up."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.stand import PlotArea
from dbh_studio.io.exports.columns import Table, written_whole

_WIDTH_PX = 900.0
_MARGIN_M = 2.0
# A stem of unknown diameter is drawn as a cross of this size.
_CROSS_M = 0.3
_TEXT_M = 0.35
_NICE_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)


def write_svg(path: Path | str, table: Table, *, area: PlotArea | None = None, exaggeration: float = 3.0) -> Path:
    """Draw the stems as circles, wider than they are by `exaggeration`, with their numbers and a scale bar.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    with written_whole(path) as file:
        file.write(stem_map_svg(table, area=area, exaggeration=exaggeration).encode())
    return path


def stem_map_svg(table: Table, *, area: PlotArea | None = None, exaggeration: float = 3.0) -> str:
    """The drawing of `write_svg`, to put into a page."""
    placed = _placed(table)
    outline = _outline(area)
    corners = np.array([[row.x_m, row.y_m] for row in placed] + outline, np.float64).reshape(-1, 2)
    if not len(corners):
        corners = np.zeros((1, 2))
    lower, upper = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    size = upper - lower
    scale = _WIDTH_PX / size[0]
    height = scale * size[1]

    def at(x: float, y: float) -> tuple[float, float]:
        return scale * (x - lower[0]), scale * (upper[1] - y)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH_PX:.0f} {height:.0f}" '
        f'width="{_WIDTH_PX:.0f}" height="{height:.0f}" font-family="sans-serif" font-size="12">',
        f'<rect width="{_WIDTH_PX:.0f}" height="{height:.0f}" fill="white"/>',
    ]
    if outline:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (at(*corner) for corner in outline))
        parts.append(f'<polygon points="{path}" fill="#f4f6f2" stroke="#7a8a6a" stroke-width="1.5"/>')
    for row in placed:
        assert row.x_m is not None and row.y_m is not None
        x, y = at(row.x_m, row.y_m)
        title = f"<title>{escape(_said(row, table))}</title>"
        if row.dbh_cm is None:
            reach = 5.0
            lines = f"M{x - reach:.1f},{y - reach:.1f}l10,10m0,-10l-10,10"
            parts.append(f'<g>{title}<path d="{lines}" stroke="#b3261e" stroke-width="2"/></g>')
        else:
            radius = max(2.5, scale * exaggeration * row.dbh_cm / 200)
            parts.append(
                f'<g>{title}<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="#8d6e4f" fill-opacity="0.75" '
                f'stroke="#4e3b28"/></g>'
            )
            reach = radius
        parts.append(f'<text x="{x + reach + 2:.1f}" y="{y + 4:.1f}" fill="#222">{row.stem_id}</text>')
    parts += _scale_bar(scale, height, size[0], exaggeration)
    return "".join([*parts, "</svg>"])


def _scale_bar(scale: float, height: float, width_m: float, exaggeration: float) -> list[str]:
    length = max((nice for nice in _NICE_M if nice <= width_m / 4), default=_NICE_M[0])
    y = height - 12
    return [
        f'<path d="M12,{y:.1f}h{scale * length:.1f}m0,-5v10m{-scale * length:.1f},-10v10" stroke="#222" fill="none"/>',
        f'<text x="12" y="{y - 9:.1f}">{length:g} m</text>',
        f'<text x="{_WIDTH_PX - 12:.0f}" y="{height - 10:.1f}" text-anchor="end" fill="#666">stems drawn '
        f"{exaggeration:g} times as wide; crosses: no diameter</text>",
    ]


def _said(row: InventoryRow, table: Table) -> str:
    number = f"{row.dbh_cm:.1f} cm" if row.dbh_cm is not None else f"no diameter: {row.reason}"
    if row.dbh_cm is not None and table.units == "imperial":
        number = f"{row.dbh_cm / 2.54:.1f} in"
    return f"Stem {row.stem_id}: {number}{f', {row.species}' if row.species else ''}"


def write_dxf(path: Path | str, table: Table, *, area: PlotArea | None = None) -> Path:
    """Draw the stems as circles of their diameter on layer STEMS, numbers on NUMBERS, refused ones on REFUSED.

    In map coordinates where the plot has them, else in the plot's own metres.

    Raises:
        FileError: It cannot be written.
    """
    path = Path(path)
    on_map = table.inventory.n_measured > 0 and any(row.easting is not None for row in table.inventory)
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
    outline = [] if on_map else _outline(area)
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


def _placed(table: Table) -> list[InventoryRow]:
    return [row for row in table.inventory if row.x_m is not None and row.y_m is not None]


def _outline(area: PlotArea | None) -> list[tuple[float, float]]:
    """Corners around the plot; a circle has many."""
    if area is None:
        return []
    if area.outline_m is not None:
        return [(float(x), float(y)) for x, y in area.outline_m]
    assert area.centre_m is not None and area.radius_m is not None
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    return [
        (float(area.centre_m[0] + area.radius_m * np.cos(a)), float(area.centre_m[1] + area.radius_m * np.sin(a)))
        for a in angle
    ]
