"""What a person draws in the picture of a cross-section, as points of the cloud and places of the source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dbh_studio.app.commands import Command, with_records
from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.corrections import Correction, with_correction
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.core.polygons import inside_polygon
from dbh_studio.core.section import CrossSection
from dbh_studio.core.stem_profile import ProfilePoint
from dbh_studio.errors import CommandError
from dbh_studio.settings import EstimatorSettings

Drawing = Literal["out", "keep", "ring"]
# The stem below and above the section that the estimator looks at beside it: what is left out there goes, too.
_MEASURED = EstimatorSettings()
_MOST_CORNERS = 200


def drawn_points(
    session: Session, document: Document, trunk_id: int, section: CrossSection, polygon_uv_m: Any, *, keep: bool = False
) -> Int64:
    """Indices of the cloud's points that are not to be measured by what was drawn round in the section.

    They are taken from as much of the stem as is measured with the section, not only from the slice that is shown:
    a branch or a neighbour is there above and below it as well.

    Args:
        session: The plot.
        document: Its state.
        trunk_id: Of the stem.
        section: That was drawn in.
        polygon_uv_m: (K, 2) what was drawn, section coordinates.
        keep: What lies outside is left out, not what lies inside.

    Raises:
        CommandError: Nothing would be left out, or nothing would be left.
    """
    trunk = document.trunks[trunk_id]
    z_ground_m = session.measurement(trunk_id, document=document).z_ground_m
    points = session.points_world(document)[trunk.points].astype(np.float64)
    points[:, 2] -= z_ground_m
    low = min(section.band_m[0], section.hom_m - _MEASURED.below_m)
    high = max(section.band_m[1], section.hom_m + _MEASURED.above_m)
    there = (points[:, 2] >= low) & (points[:, 2] <= high)
    there &= ~np.isin(trunk.points, np.array(document.record(trunk_id).correction("left_out") or (), np.int64))
    uv = section.stem_from_section.inverse().apply(points[there])[:, :2]
    polygon = np.asarray(polygon_uv_m, np.float64)
    if len(polygon) > _MOST_CORNERS:
        polygon = polygon[np.linspace(0, len(polygon) - 1, _MOST_CORNERS).astype(int)]
    inside = inside_polygon(uv, polygon)
    chosen = ~inside if keep else inside
    if not chosen.any():
        raise CommandError("No point of the section lies there.", "Draw round the points themselves.")
    if chosen.all():
        raise CommandError("Then no point of the section would be left.", "Draw round fewer points.")
    return np.asarray(trunk.points[np.flatnonzero(there)[chosen]], np.int64)


def left_out_uv_m(session: Session, document: Document, trunk_id: int, section: CrossSection) -> Float64:
    """(N, 2) section coordinates of the points that were left out by hand in the slice that is shown."""
    left_out = document.record(trunk_id).correction("left_out") or ()
    mine = np.intersect1d(np.array(left_out, np.int64), document.trunks[trunk_id].points)
    points = session.points_world(document)[mine].astype(np.float64)
    points[:, 2] -= session.measurement(trunk_id, document=document).z_ground_m
    shown = (points[:, 2] >= section.band_m[0]) & (points[:, 2] <= section.band_m[1])
    return np.asarray(section.stem_from_section.inverse().apply(points[shown])[:, :2], np.float64)


def ring_in_source(
    session: Session, document: Document, trunk_id: int, section: CrossSection, corners_uv_m: Any
) -> tuple[tuple[float, float, float], ...]:
    """A ring drawn in the section, as places of the source."""
    z_ground_m = session.measurement(trunk_id, document=document).z_ground_m
    corners = np.asarray(corners_uv_m, np.float64)
    stem = section.stem_from_section.apply(np.column_stack([corners, np.zeros(len(corners))]))
    return tuple(_place(point) for point in in_source(document, stem + [0.0, 0.0, z_ground_m]))


def in_source(document: Document, points_world: NDArray[Any]) -> Float64:
    """(N, 3) places of the source, units from the cloud's origin, of (N, 3) places of the world."""
    return np.asarray(document.world_from_source.inverse().apply(np.asarray(points_world, np.float64)), np.float64)


def drawn_polygon(payload: Any, *, at_least: int, at_most: int = 4000, largest_m: float = 50.0) -> Float64:
    """(K, 2) section coordinates from what a page sent.

    Raises:
        CommandError: It is no polygon, or one that no stem has.
    """
    try:
        polygon = np.asarray(payload, np.float64)
    except (TypeError, ValueError):
        polygon = np.empty(0)
    is_polygon = polygon.ndim == 2 and polygon.shape[1] == 2 and np.isfinite(polygon).all()
    if not is_polygon or len(polygon) > at_most or np.abs(polygon).max(initial=0.0) > largest_m:
        raise CommandError("What was drawn was not understood.", "Draw it again.")
    if len(polygon) < at_least:
        raise CommandError(f"That is too little: {at_least} corners are needed.", "Draw it again.")
    following = np.roll(polygon, -1, axis=0)
    if not np.sum(polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]):
        raise CommandError("What was drawn encloses nothing.", "Draw once round what you mean.")
    return polygon


def other_heights(profile: tuple[ProfilePoint, ...], breast_height_m: float, *, n: int = 3) -> tuple[ProfilePoint, ...]:
    """The heights nearest to breast height at which the stem has a diameter, nearest first."""
    seen = [point for point in profile if point.diameter is not None]
    nearest = sorted(seen, key=lambda point: (round(abs(point.height_m - breast_height_m), 3), point.height_m))
    return tuple(nearest[:n])


def tape_cm(text: str) -> float:
    """A diameter as read from a tape: ``31.5``, ``31,5 cm``, ``12.4 in``, ``12.4"``, ``315 mm``; cm without a unit.

    Raises:
        CommandError: It is no such number.
    """
    words = text.strip().lower().replace(",", ".")
    factors = {"cm": 1.0, "mm": 0.1, "inches": 2.54, "inch": 2.54, "in": 2.54, '"': 2.54, "″": 2.54, "m": 100.0}
    factor = 1.0
    for unit, cm in factors.items():
        if words.endswith(unit):
            words, factor = words[: -len(unit)].strip(), cm
            break
    try:
        value = float(words)
    except ValueError:
        value = float("nan")
    if not (value > 0 and np.isfinite(value)):
        shown = text.strip()[:30]
        raise CommandError(
            f"The tape value was not understood: {shown!r}." if shown else "The tape value is missing.",
            "Type the diameter in centimetres, such as 31.5, or with its unit: 12.4 in.",
        )
    return value * factor


def keep_tapes(diameters_cm: Mapping[int, float], *, who: str = "", when: str = "", why: str = "") -> Command:
    """Keep what a tape read of trees, by number, beside their estimates, in one step; other trees are left alone."""

    def apply(document: Document) -> Document:
        records = {}
        for i, value in diameters_cm.items():
            record = document.record(i)
            if i in document.trunks and record.correction("tape") != value:
                tape = Correction("tape", value, who, when, why)
                records[i] = replace(record, corrections=with_correction(record.corrections, tape))
        return with_records(document, records)

    return Command(f"Keep the tape values of {len(diameters_cm)} trees", apply)


def moved_words(before: object, after: object) -> str:
    """How a diameter has moved by a correction: ``31.2 → 29.8 cm``; empty where it has not."""
    was = f"{before.dbh_cm:.1f}" if isinstance(before, DbhEstimate) else "no diameter"
    now = f"{after.dbh_cm:.1f} cm" if isinstance(after, DbhEstimate) else "no diameter"
    return "" if was == now.removesuffix(" cm") else f"{was} → {now}"


def _place(point: Float64) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in point)
    return x, y, z
