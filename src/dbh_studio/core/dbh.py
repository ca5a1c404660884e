"""A stem's diameter at breast height, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, as_points, finite_points, finite_rows, readonly
from dbh_studio.core.axis import WINDOW, StemAxis, band_m, stem_axis
from dbh_studio.core.curves import CURVES
from dbh_studio.core.curves.base import outline_centroid
from dbh_studio.core.estimator import heap_signs
from dbh_studio.core.estimator.heap import LIKELY_CLUTTER, clutter_flag
from dbh_studio.core.interval_methods import (
    INTERVAL_METHODS,
    compared_fit,
    estimator_settings,
    measured_with_interval,
)
from dbh_studio.core.measured import CurveFit, DbhEstimate, Diameter, Refusal
from dbh_studio.core.quality import disagreement_of, grade, plain_flags
from dbh_studio.core.robust import canonical_order
from dbh_studio.core.section import CrossSection, cross_section
from dbh_studio.settings import MeasureSettings

__all__ = ["CurveFit", "DbhEstimate", "Diameter", "Refusal", "axis_of_stem", "measure_stem"]

_DEFAULTS = MeasureSettings()
_MOST_AXIS_POINTS = 200_000


def measure_stem(
    points_m: NDArray[np.floating[Any]],
    *,
    settings: MeasureSettings = _DEFAULTS,
    seed: int | None = None,
    curves: Sequence[str] | None = None,
    ground_note: str = "",
    axis: StemAxis | None = None,
    scale_sd: float = 0.0,
) -> DbhEstimate | Refusal:
    """The diameter of one stem at breast height, by the settings' method.

    ``shrinkage`` and ``circle`` are `core.estimator`'s and come with an interval; ``fourier``, ``ellipse`` and
    ``bspline`` are the paper's (section III-E).

    The result depends on the points, the settings and the seed; not on the order of the points.

    Args:
        points_m: (N, 3) points of the stem, metres; z is the height above the ground *at the stem*. Points that are not
            finite are left out.
        settings: Curve, band, definition, RANSAC.
        seed: Of the random samples; None takes the settings'.
        curves: Which curves to fit beside the chosen one; None fits the paper's three where one of them is chosen,
            and none where the method is another.
        ground_note: Added to the flags, for what the caller knows of the ground.
        axis: Of the stem, where it is known already (see `axis_of_stem`; of the interval methods only where the search
            starts, see `line_of_stem`); else it is found.
        scale_sd: Relative standard error of the cloud's scale; widens the interval.

    Raises:
        ValueError: The array has a wrong shape, or a curve has no such name.
    """
    points = as_points(points_m, name="points_m")
    names = _curve_names(settings.curve, curves)
    seed = settings.seed if seed is None else seed
    if settings.curve in INTERVAL_METHODS:
        return measured_with_interval(
            points,
            settings=settings,
            seed=seed,
            curves=names,
            ground_note=ground_note,
            scale_sd=scale_sd,
            line=axis,
        )
    low, high = band_m(settings)
    finite = finite_rows(points)
    if not finite.any():
        reason = "The stem has no points." if not len(points) else "None of the stem's points has finite coordinates."
        return Refusal("no_points", reason, "Segment the plot again, or add points to the stem by hand.")
    indices = np.flatnonzero(finite & (points[:, 2] >= low) & (points[:, 2] <= high))
    if len(indices) < settings.min_points:
        return _thin_band(points[finite, 2], len(indices), settings)
    axis = axis_of_stem(points, settings=settings, seed=seed) if axis is None else axis
    band = points[indices].astype(np.float64)
    order = canonical_order(band)
    section = cross_section(band[order], indices[order], axis, settings=settings, seed=seed)
    if section is None:
        return Refusal(
            "no_ring",
            f"The {len(indices)} points between {low:.2f} and {high:.2f} m above ground do not form a ring.",
            "Look at the stem: remove what is not bark, or delete it if it is no tree.",
        )
    finite_points = points[finite]
    fits = {name: compared_fit(name, finite_points, section, settings, seed, scale_sd=scale_sd) for name in names}
    found = _judged(section, fits, settings, ground_note, axis)
    return found if isinstance(found, Refusal) else _warned(found, finite_points, settings, seed)


def axis_of_stem(
    points_m: NDArray[np.floating[Any]], *, settings: MeasureSettings = _DEFAULTS, seed: int | None = None
) -> StemAxis:
    """The axis of a stem about breast height, from (N, 3) points as for `measure_stem`.

    Raises:
        ValueError: The array has a wrong shape, or no point is finite.
    """
    points = as_points(points_m, name="points_m")
    points = finite_points(points)
    if not len(points):
        raise ValueError("a stem without finite points has no axis")
    breast_height = settings.breast_height_m
    near = (points[:, 2] > WINDOW[0] * breast_height) & (points[:, 2] < WINDOW[1] * breast_height)
    used = (points[near] if near.any() else points).astype(np.float64)
    used = used[canonical_order(used)]
    # Coordinates far from zero would cost the slopes their digits.
    offset = np.array([*np.round(np.median(used[:, :2], axis=0)), 0.0])
    # Every k-th of a sorted set: the same points whatever their order was.
    local = used[:: max(1, len(used) // _MOST_AXIS_POINTS)] - offset
    axis = stem_axis(local, settings=settings, seed=settings.seed if seed is None else seed)
    return replace(axis, point_m=axis.point_m + offset)


def _curve_names(chosen: str, curves: Sequence[str] | None) -> list[str]:
    """The chosen curve first, then the others wanted."""
    wanted = list(curves) if curves is not None else [] if chosen in INTERVAL_METHODS else list(CURVES)
    known = (*INTERVAL_METHODS, *CURVES)
    unknown = [name for name in (chosen, *wanted) if name not in known]
    if unknown:
        raise ValueError(f"curve {unknown[0]!r} is none of {', '.join(known)}")
    return list(dict.fromkeys([chosen, *wanted]))


def _thin_band(heights_m: NDArray[np.floating[Any]], n_found: int, settings: MeasureSettings) -> Refusal:
    """Why a band with too few points cannot be measured."""
    low, high = band_m(settings)
    if n_found:
        return Refusal(
            "too_few_points",
            f"Only {n_found} points between {low:.2f} and {high:.2f} m above ground; {settings.min_points} are needed.",
            "Record the stem from nearer, widen the band, or lower the fewest points.",
        )
    lowest, highest = np.quantile(heights_m, [0.01, 0.99])
    if lowest > high:
        where, remedy = f"above it, from {lowest:.2f} to {highest:.2f} m", "add its lower part by hand"
    elif highest < low:
        where, remedy = f"below it, from {lowest:.2f} to {highest:.2f} m", "add its upper part by hand"
    else:
        where, remedy = f"below and above it, from {lowest:.2f} to {highest:.2f} m", "add the part between by hand"
    return Refusal(
        "no_band",
        f"No points between {low:.2f} and {high:.2f} m above ground; the stem is seen only {where}.",
        f"Check the ground and the scale; if they are right, {remedy} or set another breast height.",
    )


def _judged(
    section: CrossSection,
    fits: Mapping[str, CurveFit | Refusal],
    settings: MeasureSettings,
    ground_note: str,
    axis: StemAxis,
) -> DbhEstimate | Refusal:
    """The chosen curve's diameter with its quality, unless something speaks against giving one."""
    if section.coverage_deg < settings.min_coverage_deg:
        return Refusal(
            "small_arc",
            f"Only {section.coverage_deg:.0f}° of the ring were seen; {settings.min_coverage_deg:.0f}° are needed.",
            "Record the stem from its other side.",
            section,
            fits,
        )
    chosen = fits[settings.curve]
    if isinstance(chosen, Refusal):
        return replace(chosen, section=section, fits=fits)
    # Of the paper's curves alone: what else is drawn beside them must not change the grade.
    fitted = {name: fit for name, fit in fits.items() if isinstance(fit, CurveFit) and name in CURVES}
    diameters = {name: fit.diameter_m(settings.definition) for name, fit in fitted.items()}
    diameters["circle"] = 2.0 * section.ring_radius_m
    disagreement = disagreement_of(
        diameters[settings.curve], [value for name, value in diameters.items() if name != settings.curve]
    )
    rmse_m, n_points = chosen.rmse_m, int(chosen.inliers.sum())
    flags = plain_flags(
        section,
        rmse_m=rmse_m,
        n_points=n_points,
        disagreement=disagreement,
        diameters_m=diameters,
        ground_note=ground_note,
    )
    return DbhEstimate(
        dbh_cm=100.0 * diameters[settings.curve],
        curve=settings.curve,
        definition=settings.definition,
        section=section,
        fits=fits,
        quality=grade(section, rmse_m=rmse_m, disagreement=disagreement, n_points=n_points),
        flags=tuple(flag.words for flag in flags),
        position_m=readonly(section.stem_from_section.apply(_centre(chosen)[None])[0]),
        flag_codes=tuple(flag.code for flag in flags),
        taper_cm_per_m=None if axis.taper is None else 200.0 * axis.taper,
    )


def _warned(found: DbhEstimate, points: NDArray[np.floating[Any]], settings: MeasureSettings, seed: int) -> DbhEstimate:
    """With a flag where what was measured looks like no stem. The paper's curves give their number all the same."""
    motion = found.section.stem_from_section
    axis = StemAxis(motion.translation, motion.rotation[:, 2], None, found.section.axis_source)
    options = estimator_settings(settings, "shrinkage")
    signs = heap_signs(points, axis, found.section.ring_radius_m, settings=options, seed=seed)
    if signs is None or signs.chance <= LIKELY_CLUTTER:
        return found
    flag = clutter_flag(signs)
    return replace(found, flags=(flag.words, *found.flags), flag_codes=(flag.code, *found.flag_codes))


def _centre(fit: CurveFit) -> Float64:
    return np.array([*outline_centroid(fit.outline_uv_m), 0.0])
