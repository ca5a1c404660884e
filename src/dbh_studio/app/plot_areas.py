"""The ground a plot's stems are counted on: as a person gives it, in metres of the plot or of its map, or as found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float64
from dbh_studio.core.stand import PlotArea
from dbh_studio.errors import FileError, SettingError

AreaFrame = Literal["auto", "plot", "map"]

_MOST_SAMPLED = 500_000
# Stray points are no plot: cells at the rim do not count beyond this share of them, nor those with less than this share
# of the points of a usual cell.
_STRAY, _LEAST_FILLED = 0.01, 0.05
_CELL_M, _CELLS_ACROSS = 0.5, 50


def plot_area(session: Session, document: Document) -> PlotArea:
    """The rectangle, along x and y, around the ground the cloud covers, without stray points.

    Raises:
        SettingError: The cloud has no extent.
    """
    points = session.points_world(document)
    sample = points[:: max(1, len(points) // _MOST_SAMPLED), :2].astype(np.float64)
    try:
        return PlotArea.extent(_covered(sample[np.isfinite(sample).all(axis=1)]))
    except ValueError as error:
        raise SettingError(f"The plot has no area: {error}.", "Say it, as a circle or a polygon.") from None


def _covered(places: Float64) -> Float64:
    """(2, 2) lower and upper corner around nearly all of the ground that (N, 2) places cover; (0, 2) of none.

    Ground is counted and not points: most points are about the stems and the scanner, and the rectangle around nearly
    all of them leaves out the plot's rim, by which every figure per hectare would be too large.
    """
    if not len(places):
        return places
    dense = np.quantile(places, [_STRAY, 1 - _STRAY], axis=0)
    cell = min(_CELL_M, float((dense[1] - dense[0]).max()) / _CELLS_ACROSS)
    if not cell > 0.0:
        return dense
    # As complex numbers, which are sorted in a tenth of the time that pairs take.
    cells, counts = np.unique(np.floor(places / cell) @ np.array([1, 1j]), return_counts=True)
    filled = cells[counts >= _LEAST_FILLED * np.median(counts)]
    middles = (np.column_stack([filled.real, filled.imag]) + 0.5) * cell
    low, high = np.quantile(middles, [_STRAY, 1 - _STRAY], axis=0)
    # What evenly covered ground loses to the share that may be stray, and to the middles of its cells.
    rim = (high - low) * _STRAY / (1 - 2 * _STRAY) + 0.5 * cell
    return np.array([np.maximum(low - rim, places.min(axis=0)), np.minimum(high + rim, places.max(axis=0))])


def placed_area(session: Session, document: Document, area: PlotArea | None, frame: AreaFrame = "auto") -> PlotArea:
    """The plot in its own metres.

    Args:
        session: The plot.
        document: Its state.
        area: As given; None takes `plot_area`.
        frame: What it was given in: metres of the ``plot``, or easting and northing of its ``map``; ``auto`` takes it
            for the map's where it would else lie off the cloud and so lies on it.

    Raises:
        SettingError: The cloud has no extent, or no map system and one was asked for.
    """
    if area is None:
        return plot_area(session, document)
    if frame == "plot":
        return area
    has_map = _has_map(session, document)
    if frame == "map":
        if not has_map:
            raise SettingError(
                "The cloud has no map system that easting and northing could be of.",
                "Give the plot in its own metres, as the stem map shows them.",
            )
        return _from_map(session, document, area)
    if not has_map:
        return area
    extent = plot_area(session, document)
    moved = _from_map(session, document, area)
    return moved if not _meets(area, extent) and _meets(moved, extent) else area


def _has_map(session: Session, document: Document) -> bool:
    """Whether the source's x and y are easting and northing."""
    from dbh_studio.io.inventory_csv import projected_epsg

    return document.up_direction == (0.0, 0.0, 1.0) and projected_epsg(session.cloud.crs)[0]


def _from_map(session: Session, document: Document, area: PlotArea) -> PlotArea:
    """Places of the map as places of the plot; a radius stays, in metres."""

    def moved(xy: Float64) -> Float64:
        offset = np.column_stack([xy - session.cloud.origin[:2], np.zeros(len(xy))])
        return np.asarray(document.world_from_source.apply(offset)[:, :2], np.float64)

    if area.outline_m is not None:
        return PlotArea.polygon(moved(area.outline_m), kind="polygon" if area.kind == "polygon" else "extent")
    assert area.centre_m is not None and area.radius_m is not None
    return PlotArea.circle(moved(area.centre_m[None, :])[0], area.radius_m)


def _meets(one: PlotArea, other: PlotArea) -> bool:
    """Whether the rectangles around two areas overlap."""
    (low_1, high_1), (low_2, high_2) = _bounds(one), _bounds(other)
    return bool((low_1 <= high_2).all() and (low_2 <= high_1).all())


def _bounds(area: PlotArea) -> tuple[Float64, Float64]:
    if area.outline_m is not None:
        return area.outline_m.min(axis=0), area.outline_m.max(axis=0)
    assert area.centre_m is not None and area.radius_m is not None
    return area.centre_m - area.radius_m, area.centre_m + area.radius_m


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


# Two numbers or more, each with a comma of its own, and blanks or tabs between them.
_DECIMAL_COMMAS = re.compile(r"[+-]?\d+,\d+(\s+[+-]?\d+,\d+)+")


def _corners(path: Path) -> Float64:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"The corners cannot be read ({error}).") from None
    corners: list[list[float]] = []
    firsts: list[float] = []
    for number, line in enumerate(text.splitlines(), start=1):
        # Where something else divides, a comma is the decimal sign.
        is_decimal = ";" in line or _DECIMAL_COMMAS.fullmatch(line.strip()) is not None
        divided = line.replace(",", ".").replace(";", " ") if is_decimal else line.replace(",", " ")
        parts = divided.split()
        if not parts or parts[0].startswith("#"):
            continue
        try:
            corners.append([float(part) for part in parts[:2]])
            if len(parts) < 2:
                raise ValueError
            firsts += [float(parts[0])] if len(parts) > 2 else []
        except ValueError:
            if not corners and number == 1:
                continue  # a line of headings
            raise FileError(
                path, f"Line {number} is no corner: {line[:40]!r}.", "Give x and y in metres, a corner per line."
            ) from None
    if len(corners) > 2 and firsts in ([float(k + start) for k in range(len(corners))] for start in (0, 1)):
        raise FileError(
            path,
            "The first column numbers the corners, and the next would be taken for y.",
            "Leave the numbers out: x and y in metres, a corner per line.",
        )
    return np.array(corners, np.float64).reshape(-1, 2)
