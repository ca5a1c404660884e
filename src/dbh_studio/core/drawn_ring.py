"""A diameter from a ring drawn around a stem by hand, where its points allow no curve or none is right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from dbh_studio.core.arrays import Bool, Float64, readonly
from dbh_studio.core.axis import StemAxis, middle_m
from dbh_studio.core.curves.base import distance_to_outline, outline_centroid, outline_metrics
from dbh_studio.core.measured import CurveFit, DbhEstimate, Flag, Refusal
from dbh_studio.core.polygons import crosses_itself
from dbh_studio.core.quality import FAIR, GOOD
from dbh_studio.core.robust import canonical_order
from dbh_studio.core.section import CrossSection, ring_coverage
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import MeasureSettings

DRAWN = "drawn"
"""What the curve is called in tables."""

_SAME_PLANE_M = 0.02  # a ring drawn in the picture of a section lies in its plane but for rounding
_PICTURE_M = 0.15  # of stem to either side, as in the other methods' sections
_NEAR_M, _NEAR_SHARE = 0.01, 0.08  # noise, and share of the radius a hand may be off by: points so near support it
_AWAY_M = 0.05  # from breast height, as `not_at_height` elsewhere
_LEAST_ARC_DEG = 60.0  # of points along a ring beside the stem's axis from which on it is one of its stems
_COARSE = 0.005  # too thin by its corners, relative, from which on it is said: fewer than 19
_MOST_OF_HULL = 1.01  # of the area of its hull a curve that goes round once encloses at most all
_REDRAW = "Draw the ring again, once around the stem."


def drawn_diameter(
    ring_m: Float64,
    points_m: NDArray[np.floating[Any]],
    measured: DbhEstimate | Refusal,
    *,
    axis: StemAxis,
    settings: MeasureSettings,
    ground_note: str = "",
) -> DbhEstimate | Refusal:
    """The diameter of a ring drawn by hand, at the height where it was drawn; without an interval.

    The ring is looked at along the stem, so that how it was tilted does not matter. Nobody knows how well a person
    draws, so the quality is ``fair`` at best.

    Args:
        ring_m: (M, 3) its corners, stem frame: z above the ground at the stem.
        points_m: (N, 3) points of the stem, likewise; those that are not finite are left out.
        measured: What was measured of the stem without the ring; its section is kept where the ring lies in its plane,
            its curves to compare with.
        axis: Of the stem, for a stem that has no section.
        settings: Of the measurement, with the height of this stem (`along_the_stem`).
        ground_note: Added to the flags.
    """
    section, fits = measured.section, measured.fits
    frame = section.stem_from_section if section is not None else Similarity(axis.rotation(), axis.point_m)
    ring = _in(frame, ring_m)
    off_axis_m = float(np.hypot(*outline_centroid(ring[:, :2])))
    if section is None or abs(float(ring[:, 2].mean())) > _SAME_PLANE_M:
        frame, fits = _at_ring(frame, ring), {}
        ring = _in(frame, ring_m)
        section = _section(points_m, frame, ring[:, :2])
    outline = ring[:, :2].copy()
    perimeter, area, girth = outline_metrics(outline)
    problem = _problem(outline, girth, area, settings)
    if problem:
        return Refusal("implausible", problem, _REDRAW, section, fits)
    inliers, rmse_m = _support(section.uv_m, outline, area)
    seen = section.uv_m[inliers] - outline_centroid(outline)
    arc_deg, gap_deg = ring_coverage(np.arctan2(seen[:, 1], seen[:, 0]))
    radius_m = float(np.sqrt(area / np.pi))
    if off_axis_m > 2.0 * radius_m and arc_deg < _LEAST_ARC_DEG:
        beside = f"The ring drawn by hand lies {off_axis_m:.1f} m beside the stem, where hardly a point of it is."
        # In the section as it was measured: there one sees where the stem is.
        seen_in = section if measured.section is None else measured.section
        return Refusal("implausible", beside, "Draw the ring round the stem's own points.", seen_in, measured.fits)
    section = replace(section, coverage_deg=arc_deg, max_gap_deg=gap_deg, ring_radius_m=radius_m)
    drawn = CurveFit(DRAWN, readonly(outline), perimeter, area, girth, readonly(inliers), rmse_m)
    flags = _flags(section, outline, settings, ground_note)
    middle = np.array([[*outline_centroid(outline), 0.0]])
    return DbhEstimate(
        dbh_cm=100.0 * drawn.diameter_m(settings.definition),
        curve=DRAWN,
        definition=settings.definition,
        section=section,
        fits={**fits, DRAWN: drawn},
        quality="fair" if section.coverage_deg >= FAIR.coverage_deg else "poor",
        flags=tuple(flag.words for flag in flags),
        position_m=readonly(np.asarray(frame.apply(middle)[0], np.float64)),
        flag_codes=tuple(flag.code for flag in flags),
        taper_cm_per_m=measured.taper_cm_per_m if isinstance(measured, DbhEstimate) else None,
    )


def _in(frame: Similarity, points_m: NDArray[np.floating[Any]]) -> Float64:
    """(N, 3) points of the stem's frame in a section's."""
    return np.asarray(frame.inverse().apply(points_m), np.float64)


def _at_ring(frame: Similarity, ring: Float64) -> Similarity:
    """The frame moved along the stem and across it to the middle of a ring given in it."""
    middle = np.array([*outline_centroid(ring[:, :2]), float(ring[:, 2].mean())])
    return Similarity(frame.rotation, np.asarray(frame.apply(middle[None])[0], np.float64))


def _section(points_m: NDArray[np.floating[Any]], frame: Similarity, outline: Float64) -> CrossSection:
    """The stem about the ring, across its axis."""
    hom = float(frame.translation[2])
    near = np.flatnonzero(np.abs(points_m[:, 2] - hom) <= _PICTURE_M)  # NaN is nowhere
    near = near[np.isfinite(points_m[near]).all(axis=1)]
    band = points_m[near].astype(np.float64)
    order = canonical_order(band)
    uv = _in(frame, band[order])[:, :2]
    widest = 2.0 * float(np.hypot(*outline.T).max())
    return CrossSection(
        readonly(uv),
        readonly(near[order]),
        frame,
        (hom - _PICTURE_M, hom + _PICTURE_M),
        hom,
        float(np.degrees(np.arccos(np.clip(frame.rotation[2, 2], -1.0, 1.0)))),
        DRAWN,
        0.0,
        360.0,
        near_ring=readonly(np.hypot(uv[:, 0], uv[:, 1]) < widest),
    )


def _problem(outline: Float64, girth_m: float, area_m2: float, settings: MeasureSettings) -> str:
    """Why an outline is no stem; empty where it may be one."""
    if crosses_itself(outline):
        return "The ring drawn by hand crosses itself."
    diameter_cm = 100.0 * girth_m / np.pi
    # A closed curve of no area: two strokes upon each other.
    if area_m2 < 0.2 * np.pi / 4 * (0.01 * diameter_cm) ** 2:
        return "The ring drawn by hand is hardly more than a line, seen along the stem."
    if area_m2 > _MOST_OF_HULL * ConvexHull(outline).volume:  # in the plane the volume is the area
        return "The ring drawn by hand goes more than once around."
    if not settings.min_diameter_cm <= diameter_cm <= settings.max_diameter_cm:
        limits = f"{settings.min_diameter_cm:g} to {settings.max_diameter_cm:g} cm"
        return f"The ring drawn by hand is {diameter_cm:.1f} cm thick, outside {limits}."
    return ""


def _support(uv_m: Float64, outline: Float64, area_m2: float) -> tuple[Bool, float]:
    """(N,) which points lie along the ring, and their root mean square distance to it; NaN without any."""
    if not len(uv_m):
        return np.empty(0, bool), float("nan")
    distance = distance_to_outline(uv_m, _dense(outline))
    inliers = distance < _NEAR_M + _NEAR_SHARE * float(np.sqrt(area_m2 / np.pi))
    rmse_m = float(np.sqrt((distance[inliers] ** 2).mean())) if inliers.any() else float("nan")
    return inliers, rmse_m


def _dense(outline: Float64) -> Float64:
    """The polygon with eight more corners on each side: a point's nearest corner is then at its nearest side."""
    share = np.arange(8)[None, :, None] / 8.0
    following = np.roll(outline, -1, axis=0)
    return np.asarray((outline[:, None] * (1.0 - share) + following[:, None] * share).reshape(-1, 2))


def _flags(section: CrossSection, outline: Float64, settings: MeasureSettings, ground_note: str) -> list[Flag]:
    words = "drawn by hand: no interval"
    n = len(outline)
    short = 1.0 - n / np.pi * np.sin(np.pi / n)  # of a circle, by its inscribed polygon
    if short > _COARSE:
        words += f"; with {n} corners up to {100 * short:.1f} % too thin"
    flags = [Flag(DRAWN, words)]
    planned_m = middle_m(settings, settings.curve)
    if abs(section.hom_m - planned_m) > _AWAY_M:
        words = f"the ring lies at {section.hom_m:.2f} m, not at {planned_m:.2f} m"
        flags.append(Flag("not_at_height", words))
    if section.coverage_deg < GOOD.coverage_deg:
        flags.append(Flag("partial_arc", f"points along {section.coverage_deg:.0f}° of the ring drawn"))
    if ground_note:
        flags.append(Flag("ground", ground_note))
    return flags
