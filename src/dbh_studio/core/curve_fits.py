"""The paper's curves on a cross-section: fitted by RANSAC, and refused where they cannot be the stem's outline."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import readonly
from dbh_studio.core.curves import CURVE_WORDS, CURVES
from dbh_studio.core.curves.base import contains, distance_to_outline, outline_metrics
from dbh_studio.core.measured import CurveFit, Refusal
from dbh_studio.core.robust import ransac
from dbh_studio.core.section import CrossSection
from dbh_studio.settings import MeasureSettings

_WORST_RATIO = 1.6


def fit_curve(name: str, section: CrossSection, settings: MeasureSettings, seed: int) -> CurveFit | Refusal:
    """One curve by the paper's RANSAC, on the points near the ring."""
    curve = CURVES[name].configured(settings)
    radius = section.ring_radius_m
    uv = section.uv_m[section.near_ring]
    origin = uv.mean(axis=0) if settings.polar_origin == "centroid" and len(uv) else np.zeros(2)
    tolerance = settings.ransac_tolerance_m
    if settings.tolerance_share:
        tolerance = min(tolerance, settings.tolerance_share * radius)
    found = ransac(
        (uv - origin) / radius,
        curve,
        n_samples=settings.ransac_samples,
        tolerance=tolerance / radius,
        n_iterations=settings.ransac_iterations,
        rng=np.random.default_rng([seed, *name.encode()]),
    )
    if found is None:
        return Refusal("no_curve", f"No closed {CURVE_WORDS[name]} curve follows the points.", _LOOK, section)
    outline = curve.outline(found.params) * radius + origin
    inliers = np.zeros(len(section.uv_m), bool)
    inliers[section.near_ring] = found.inliers
    perimeter, area, girth = outline_metrics(outline)
    distance = distance_to_outline(section.uv_m[inliers], outline)
    rmse = float(np.sqrt((distance**2).mean()))
    fit = CurveFit(name, readonly(outline), perimeter, area, girth, readonly(inliers), rmse)
    problem = _implausible(fit, section, settings)  # falsy, as every refusal
    return fit if problem is None else problem


_LOOK = "Look at the cross-section: remove what is not bark, or record the stem from more sides."


def _implausible(fit: CurveFit, section: CrossSection, settings: MeasureSettings) -> Refusal | None:
    """A refusal where a curve cannot be the stem's outline: it misses the ring, or contradicts it."""
    diameter_cm = 100.0 * fit.diameter_m(settings.definition)
    ring_cm = 200.0 * section.ring_radius_m
    word = CURVE_WORDS[fit.curve]
    if not contains(fit.outline_uv_m, np.zeros(2)):
        return Refusal("implausible", f"The {word} curve does not go round the ring's centre.", _LOOK, section)
    if not 1.0 / _WORST_RATIO < diameter_cm / ring_cm < _WORST_RATIO:
        reason = f"The {word} curve gives {diameter_cm:.1f} cm where a circle gives {ring_cm:.1f} cm."
        return Refusal("implausible", reason, _LOOK, section)
    # Last: only where curve and ring agree does an odd size speak of the scale.
    if not settings.min_diameter_cm <= diameter_cm <= settings.max_diameter_cm:
        limits = f"{settings.min_diameter_cm:g} to {settings.max_diameter_cm:g} cm"
        reason = f"The {word} curve gives {diameter_cm:.1f} cm, outside {limits}."
        return Refusal(
            "implausible", reason, "Check the scale of the cloud; if it is right, change the limits.", section
        )
    return None
