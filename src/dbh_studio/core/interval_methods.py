"""The methods that come with an interval, shrinkage curve and plain circle, as measurements of a stem.

`core.estimator` finds axis, taper and outline together from 1.6 m of stem. Here its result gets the cross-section that
the studio shows, a grade, and the paper's curves beside it where they are wanted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float64, finite_rows, readonly
from dbh_studio.core.axis import StemAxis
from dbh_studio.core.curve_fits import fit_curve
from dbh_studio.core.curves import CURVES
from dbh_studio.core.curves.base import outline_metrics
from dbh_studio.core.estimator import EstimatorResult, assess_stem, stem_line
from dbh_studio.core.measured import CurveFit, DbhEstimate, Flag, Refusal
from dbh_studio.core.quality import FAIR_HALF_WIDTH, grade_of_interval
from dbh_studio.core.robust import canonical_order
from dbh_studio.core.section import CrossSection, radius_at
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import EstimatorSettings, MeasureSettings

INTERVAL_METHODS: Mapping[str, Literal["ring", "circle"]] = {"shrinkage": "ring", "circle": "circle"}
"""What each is called by the estimator."""

_PICTURE_M = 0.15  # of stem to either side of breast height is shown as the section
_LEAST_SHOWN = 30
_ON_CURVE = 3.0


@lru_cache(maxsize=64)
def estimator_settings(settings: MeasureSettings, method: str) -> EstimatorSettings:
    """What the estimator is to do, by the settings of measuring."""
    return EstimatorSettings(
        method=INTERVAL_METHODS[method],
        axis=settings.axis if method == "circle" else "stem",
        definition=settings.definition,
        breast_height_m=settings.breast_height_m,
        tolerance_m=settings.ransac_tolerance_m,
        roundness=settings.roundness,
        bark_share=settings.bark_share,
        bloat_chance=settings.bloat_chance,
        bloat_m=settings.bloat_m,
        min_points=max(15, settings.min_points),
        min_arc_deg=settings.min_coverage_deg,
        max_half_width=settings.max_half_width,
        min_diameter_cm=settings.min_diameter_cm,
        max_diameter_cm=settings.max_diameter_cm,
        seed=settings.seed,
    )


def measured_with_interval(
    points: NDArray[np.floating[Any]],
    *,
    settings: MeasureSettings,
    seed: int,
    curves: Sequence[str],
    ground_note: str = "",
    scale_sd: float = 0.0,
    line: StemAxis | None = None,
) -> DbhEstimate | Refusal:
    """The diameter of a stem by the settings' method, with its interval.

    Args:
        points: (N, 3) points as for `core.dbh.measure_stem`.
        settings: Method, definition, limits.
        seed: Of the random samples.
        curves: The chosen method, and what else to fit for comparison, on the same section and axis.
        ground_note: Added to the flags.
        scale_sd: Relative standard error of the cloud's scale.
        line: Where the stem is, from `line_of_stem`, if it was looked for already.
    """
    is_finite = finite_rows(points)
    finite = points if is_finite.all() else points[is_finite]
    options = estimator_settings(settings, settings.curve)
    found = assess_stem(finite, settings=options, scale_sd=scale_sd, seed=seed, line=line)
    if found.result is None:
        assert found.refusal is not None
        return found.refusal
    result = found.result
    section = _section(points, is_finite, result, settings)
    fits: dict[str, CurveFit | Refusal] = {settings.curve: _as_fit(settings.curve, result, section.uv_m)}
    fits.update(
        (name, compared_fit(name, finite, section, settings, seed, scale_sd=scale_sd))
        for name in curves
        if name not in fits
    )
    if found.refusal is not None:
        return replace(found.refusal, section=section, fits=fits, rings=result.rings)
    return _estimate(result, settings, section, fits, ground_note)


def line_of_stem(points: NDArray[np.floating[Any]], *, settings: MeasureSettings) -> StemAxis | None:
    """Where the stem is, by the search that these methods begin with; None where nothing is round."""
    return stem_line(points, settings=estimator_settings(settings, settings.curve))


def _estimate(
    result: EstimatorResult,
    settings: MeasureSettings,
    section: CrossSection,
    fits: Mapping[str, CurveFit | Refusal],
    ground_note: str,
) -> DbhEstimate:
    chosen, flags = result.chosen, list(result.flags)
    if chosen.half_width > FAIR_HALF_WIDTH:
        flags.insert(0, Flag("wide_interval", f"uncertain: {chosen.low_cm:.0f} to {chosen.high_cm:.0f} cm"))
    if ground_note:
        flags.append(Flag("ground", ground_note))
    return DbhEstimate(
        dbh_cm=chosen.value_cm,
        curve=settings.curve,
        definition=settings.definition,
        section=section,
        fits=fits,
        quality=grade_of_interval(chosen.half_width),
        flags=tuple(flag.words for flag in flags),
        position_m=result.position_m,
        flag_codes=tuple(flag.code for flag in flags),
        # Of a stretch too short to show it, or about an axis that was assumed, it is the prior's and no measurement.
        taper_cm_per_m=result.taper_cm_per_m if section.axis_source == "stem" else None,
        rings=result.rings,
    )


def _section(
    points: NDArray[np.floating[Any]], is_finite: Bool, result: EstimatorResult, settings: MeasureSettings
) -> CrossSection:
    """The stem about breast height, across the axis that was found; all of it where little was seen there."""
    options = estimator_settings(settings, settings.curve)
    height = points[:, 2] - options.breast_height_m
    low, high = -_PICTURE_M, _PICTURE_M
    chosen = np.flatnonzero(is_finite & (np.abs(height) <= _PICTURE_M))
    if len(chosen) < _LEAST_SHOWN:
        low, high = -options.below_m, options.above_m
        chosen = np.flatnonzero(is_finite & (height >= low) & (height <= high))
    band = points.take(chosen, axis=0).astype(np.float64)
    order = canonical_order(band)
    chosen, band = chosen[order], band[order]
    uv = result.stem_from_section.inverse().apply(band)[:, :2]
    radius = 0.01 * 0.5 * result.diameters["area"].value_cm
    error = np.abs(np.sqrt(uv[:, 0] ** 2 + uv[:, 1] ** 2) - radius)
    gate = settings.ring_gate * radius + settings.ransac_tolerance_m if settings.ring_gate else np.inf
    return CrossSection(
        readonly(uv),
        readonly(chosen),
        result.stem_from_section,
        (options.breast_height_m + low, options.breast_height_m + high),
        options.breast_height_m,
        result.lean_deg,
        _axis_source(result, options),
        result.arc_deg,
        result.gap_deg,
        radius,
        readonly(error < gate),
    )


def _axis_source(result: EstimatorResult, options: EstimatorSettings) -> str:
    """How the axis was found, as `CrossSection.axis_source` has it."""
    if options.axis == "vertical":
        return "vertical"
    return "prior" if any(flag.code == "short_stretch" for flag in result.flags) else "stem"


def _as_fit(name: str, result: EstimatorResult, uv_m: Float64) -> CurveFit:
    """The estimator's outline as one of the curves on (N, 2) section points, in the estimator's own coordinates."""
    outline = result.outline_uv_m
    perimeter, area, girth = outline_metrics(outline)
    radius = np.hypot(outline[:, 0], outline[:, 1])
    u, v = uv_m.T
    error = np.abs(np.sqrt(u * u + v * v) - radius_at(radius, np.arctan2(v, u)))
    # As sure as the diameter on the whole, and as uneven as the posterior.
    sd = result.outline_sd_m * (result.log_sd * float(radius.mean()) / max(float(result.outline_sd_m.mean()), 1e-9))
    return CurveFit(
        name,
        outline,
        perimeter,
        area,
        girth,
        readonly(error < _ON_CURVE * result.spread.sigma_m),
        0.001 * result.residual_mm,
        result.diameters,
        readonly(sd),
        readonly(result.outline_seen > 0),
    )


def compared_fit(
    name: str,
    points: NDArray[np.floating[Any]],
    section: CrossSection,
    settings: MeasureSettings,
    seed: int,
    *,
    scale_sd: float = 0.0,
) -> CurveFit | Refusal:
    """One method's curve on a section, beside the chosen one.

    Args:
        name: Of the method.
        points: (N, 3) finite points of the stem.
        section: Of the chosen method.
        settings: Of the measurement.
        seed: Of the random samples.
        scale_sd: Relative standard error of the scale, for the methods with an interval.
    """
    if name in CURVES:
        return fit_curve(name, section, settings, seed)
    found = assess_stem(points, settings=estimator_settings(settings, name), scale_sd=scale_sd, seed=seed)
    if found.result is None or found.refusal is not None:
        assert found.refusal is not None
        return found.refusal
    moved = section.stem_from_section.inverse() @ found.result.stem_from_section
    fit = _as_fit(name, found.result, _on_plane(moved.inverse(), section.uv_m))
    return replace(fit, outline_uv_m=readonly(_on_plane(moved, fit.outline_uv_m)))


def _on_plane(motion: Similarity, uv_m: Float64) -> Float64:
    """(N, 2) points of one section plane, on another."""
    return np.asarray(motion.apply(np.column_stack([uv_m, np.zeros(len(uv_m))]))[:, :2], np.float64)
