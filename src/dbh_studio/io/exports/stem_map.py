"""The stem map as SVG, to look at and print: to scale, with north and a scale bar, ids beside their stems."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.markup import markup
from dbh_studio.core.stand import CM_PER_INCH, PlotArea
from dbh_studio.io.column_names import M_PER_FOOT
from dbh_studio.io.exports.columns import Table

_WIDTH_PX = 900.0
_FOOT_PX = 40.0
_MARGIN_M = 2.0
_CROSS_PX = 5.0
_TEXT_PX = 12.0
_LETTER_PX = 7.2
_NICE = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
# Where an id may stand about its stem, in order of liking: right, left, above, below, then the corners.
_PLACES = ((1, 0), (-1, 0), (0, -1), (0, 1), (0.8, -0.8), (-0.8, -0.8), (0.8, 0.8), (-0.8, 0.8))


@dataclass(frozen=True)
class North:
    """Where +y of the plot points.

    Attributes:
        letter: At the arrow: ``N``, or ``y`` where north is not known.
        words: What is known of it.
    """

    letter: str = "y"
    words: str = "up is the plot's own y axis; north is not known"


def stem_map_svg(
    table: Table,
    *,
    area: PlotArea | None = None,
    exaggeration: float = 3.0,
    north: North | None = None,
    links: bool = False,
) -> str:
    """The map as an SVG element.

    Args:
        table: The stems; its units are those of the words.
        area: Drawn as an outline.
        exaggeration: Stems are drawn so many times as wide as they are.
        north: At the arrow; none is drawn without it.
        links: Link each stem to ``#stem-ID`` of the page the map is put into.
    """
    placed = [row for row in table.inventory if row.x_m is not None and row.y_m is not None]
    outline = area_outline(area)
    frame = _Frame.around([(row.x_m or 0.0, row.y_m or 0.0) for row in placed] + outline)
    radii = [_radius(row, frame, exaggeration) for row in placed]
    at = [frame.at(row.x_m or 0.0, row.y_m or 0.0) for row in placed]
    height = frame.height_px + _FOOT_PX
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH_PX:.0f} {height:.0f}" width="{_WIDTH_PX:.0f}" '
        f'height="{height:.0f}" font-family="sans-serif" font-size="{_TEXT_PX:.0f}">',
        f'<rect width="{_WIDTH_PX:.0f}" height="{height:.0f}" fill="white"/>',
    ]
    if outline:
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in (frame.at(*corner) for corner in outline))
        parts.append(f'<polygon points="{corners}" fill="#f4f6f2" stroke="#7a8a6a" stroke-width="1.5"/>')
    parts += _trees(placed, at)
    for row, (x, y), radius in zip(placed, at, radii, strict=True):
        stem = f"<g><title>{markup(_said(row, table))}</title>{_stem(row, x, y, radius)}</g>"
        parts.append(f'<a href="#stem-{row.stem_id}">{stem}</a>' if links else stem)
    parts += _ids(placed, at, radii, (_WIDTH_PX, frame.height_px))
    parts += _foot(frame, height, exaggeration, table)
    if north is not None:
        parts.append(_arrow(north))
    return "".join([*parts, "</svg>"])


@dataclass(frozen=True)
class _Frame:
    """Metres of the plot to pixels of the picture."""

    left_m: float
    top_m: float
    px_per_m: float
    width_m: float
    height_px: float

    @classmethod
    def around(cls, places: Sequence[tuple[float, float]]) -> _Frame:
        corners = np.array(places or [(0.0, 0.0)], np.float64)
        lower, upper = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
        width, height = (float(side) for side in upper - lower)
        # A plot along north is not drawn as high as it is narrow: it would fill pages.
        room = max(width, height / 1.25)
        left = float(lower[0]) - 0.5 * (room - width)
        scale = _WIDTH_PX / room
        return cls(left, float(upper[1]), scale, room, scale * height)

    def at(self, x: float, y: float) -> tuple[float, float]:
        return self.px_per_m * (x - self.left_m), self.px_per_m * (self.top_m - y)


def _radius(row: InventoryRow, frame: _Frame, exaggeration: float) -> float:
    return _CROSS_PX if row.dbh_cm is None else max(2.5, frame.px_per_m * exaggeration * row.dbh_cm / 200)


def _stem(row: InventoryRow, x: float, y: float, radius: float) -> str:
    if row.dbh_cm is None:
        return f'<path d="M{x - 5:.1f},{y - 5:.1f}l10,10m0,-10l-10,10" stroke="#b3261e" stroke-width="2"/>'
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="#8d6e4f" fill-opacity="0.75" '
        'stroke="#4e3b28" stroke-width="0.8"/>'
    )


def _trees(rows: Sequence[InventoryRow], at: Sequence[tuple[float, float]]) -> list[str]:
    """A line through the stems of each multi-stem tree."""
    stems: dict[int, list[tuple[float, float]]] = {}
    for row, place in zip(rows, at, strict=True):
        stems.setdefault(row.tree_id, []).append(place)
    lines = (" ".join(f"{x:.1f},{y:.1f}" for x, y in places) for places in stems.values() if len(places) > 1)
    return [
        f'<polyline points="{line}" fill="none" stroke="#4e3b28" stroke-width="1.2" stroke-dasharray="3 3"/>'
        for line in lines
    ]


def _ids(
    rows: Sequence[InventoryRow],
    at: Sequence[tuple[float, float]],
    radii: Sequence[float],
    room: tuple[float, float],
) -> list[str]:
    """The ids, each where it covers as little as can be of stems and other ids."""
    stems = np.array([(x - r, y - r, x + r, y + r) for (x, y), r in zip(at, radii, strict=True)], np.float64)
    boxes = np.empty((0, 4)) if not len(stems) else stems
    parts = []
    for k, (row, (x, y), radius) in enumerate(zip(rows, at, radii, strict=True)):
        text = str(row.stem_id)
        half, high = 0.5 * _LETTER_PX * len(text), 0.5 * _TEXT_PX
        others = np.delete(boxes, k, axis=0)
        tried = []
        for rank, (side, down) in enumerate(_PLACES):
            cx, cy = x + side * (radius + 3 + half), y + down * (radius + 2 + high)
            box = np.array([cx - half, cy - high, cx + half, cy + high])
            is_out = min(box[0], box[1], room[0] - box[2], room[1] - box[3]) < 0
            tried.append((_overlap(box, others) + 1e4 * is_out, rank, cx, cy, box))
        _, _, cx, cy, box = min(tried, key=lambda each: each[:2])
        boxes = np.vstack([boxes, box])
        parts.append(f'<text x="{cx:.1f}" y="{cy + 4:.1f}" text-anchor="middle" fill="#222">{text}</text>')
    return parts


def _overlap(box: Float64, others: Float64) -> float:
    """Area of a box that others cover."""
    across = np.minimum(box[2], others[:, 2]) - np.maximum(box[0], others[:, 0])
    down = np.minimum(box[3], others[:, 3]) - np.maximum(box[1], others[:, 1])
    return float(np.sum(np.maximum(across, 0.0) * np.maximum(down, 0.0)))


def _foot(frame: _Frame, height: float, exaggeration: float, table: Table) -> list[str]:
    unit, metres = ("m", 1.0) if table.units == "metric" else ("ft", M_PER_FOOT)
    length = max((nice for nice in _NICE if nice * metres <= frame.width_m / 4), default=_NICE[0])
    bar = frame.px_per_m * length * metres
    y = height - 12
    words = f"stems drawn {exaggeration:g} times as wide"
    if any(row.dbh_cm is None for row in table.inventory):
        words += "; crosses: no diameter"
    return [
        f'<path d="M12,{y:.1f}h{bar:.1f}m0,-5v10m{-bar:.1f},-10v10" stroke="#222" fill="none"/>',
        f'<text x="{18 + bar:.1f}" y="{y + 4:.1f}">{length:g} {unit}</text>',
        f'<text x="{_WIDTH_PX - 12:.0f}" y="{y + 4:.1f}" text-anchor="end" fill="#666">{words}</text>',
    ]


def _arrow(north: North) -> str:
    x = _WIDTH_PX - 24
    return (
        f'<g><title>{markup(north.words)}</title><path d="M{x:.0f},52v-32m-5,9l5,-10l5,10" fill="none" '
        f'stroke="#222" stroke-width="1.5"/><text x="{x:.0f}" y="15" text-anchor="middle" font-weight="bold">'
        f"{markup(north.letter)}</text></g>"
    )


def _said(row: InventoryRow, table: Table) -> str:
    number = f"{row.dbh_cm:.1f} cm" if row.dbh_cm is not None else f"no diameter: {row.reason}"
    if row.dbh_cm is not None and table.units == "imperial":
        number = f"{row.dbh_cm / CM_PER_INCH:.1f} in"
    return f"Stem {row.stem_id}: {number}{f', {row.species}' if row.species else ''}"


def area_outline(area: PlotArea | None) -> list[tuple[float, float]]:
    """Corners around the plot, metres; a circle has many."""
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
