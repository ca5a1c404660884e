"""A stem's diameter at breast height, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float64, as_points, readonly
from dbh_studio.core.axis import WINDOW, StemAxis, band_m, stem_axis
from dbh_studio.core.curves import CURVE_WORDS, CURVES
from dbh_studio.core.curves.base import contains, distance_to_outline, outline_centroid, outline_metrics
from dbh_studio.core.quality import Quality, disagreement_of, grade, plain_flags
from dbh_studio.core.robust import canonical_order, ransac
from dbh_studio.core.section import CrossSection, cross_section
from dbh_studio.settings import MeasureSettings

_DEFAULTS = MeasureSettings()
_WORST_RATIO = 1.6
_MOST_AXIS_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class CurveFit:
    """One closed curve fitted to a cross-section.

    Attributes:
        curve: Which model: ``fourier``, ``ellipse``, ``bspline``.
        outline_uv_m: (M, 2) closed outline in section coordinates (last point joins the first).
        perimeter_m: Length of the curve.
        area_m2: Area inside it.
        hull_girth_m: Perimeter of its convex hull, which is what a tape measures.
        inliers: (N,) which section points support it.
        rmse_m: Root mean square distance of the inliers to the curve.
    """

    curve: str
    outline_uv_m: Float64
    perimeter_m: float
    area_m2: float
    hull_girth_m: float
    inliers: Bool
    rmse_m: float

    def diameter_m(self, definition: str) -> float:
        """The diameter by definition ``curve`` (perimeter/π), ``tape`` (convex girth/π) or ``area`` (2√(A/π)).

        Raises:
            ValueError: No such definition.
        """
        if definition == "curve":
            return self.perimeter_m / np.pi
        if definition == "tape":
            return self.hull_girth_m / np.pi
        if definition == "area":
            return 2.0 * float(np.sqrt(self.area_m2 / np.pi))
        raise ValueError(f"definition {definition!r} is none of curve, tape, area")


@dataclass(frozen=True, eq=False)
class Refusal:
    """Why a stem has no diameter, and what would give it one. Falsy, so that ``if estimate:`` reads well.

    Attributes:
        code: Short name for tables and tests: ``no_points``, ``no_band``, ``too_few_points``, ``no_ring``,
            ``small_arc``, ``no_curve``, ``implausible``; ``unscaled`` from the stages.
        reason: One sentence for the forester.
        remedy: What to do.
        section: The cross-section, where there is one to look at.
        fits: Curves fitted nonetheless, for the picture only.
    """

    code: str
    reason: str
    remedy: str
    section: CrossSection | None = None
    fits: Mapping[str, CurveFit | Refusal] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, eq=False)
class DbhEstimate:
    """A diameter at breast height with what is needed to judge it.

    Attributes:
        dbh_cm: By `curve` and `definition`.
        curve: The curve it is read from.
        definition: ``curve``, ``tape`` or ``area``.
        section: The cross-section measured.
        fits: Every curve's fit (or refusal) on this section, by name.
        quality: ``good``, ``fair`` or ``poor``, from arc, residual and agreement of the curves.
        flags: What to look at, in plain words; empty where nothing stands out.
        position_m: (3,) centre of the ring in the stem's frame.
    """

    dbh_cm: float
    curve: str
    definition: str
    section: CrossSection
    fits: Mapping[str, CurveFit | Refusal]
    quality: Quality
    flags: tuple[str, ...]
    position_m: Float64

    @property
    def rmse_mm(self) -> float:
        """Root mean square distance of the chosen curve's inliers, millimetres."""
        return 1000.0 * self._chosen.rmse_m

    @property
    def n_points(self) -> int:
        """How many points of the section support the chosen curve."""
        return int(self._chosen.inliers.sum())

    @property
    def _chosen(self) -> CurveFit:
        fit = self.fits[self.curve]
        assert isinstance(fit, CurveFit)
        return fit


def measure_stem(
    points_m: NDArray[np.floating[Any]],
    *,
    settings: MeasureSettings = _DEFAULTS,
    seed: int | None = None,
    curves: Sequence[str] | None = None,
    ground_note: str = "",
    axis: StemAxis | None = None,
) -> DbhEstimate | Refusal:
    """The diameter of one stem at breast height (the paper's section III-E).

    The result depends on the points, the settings and the seed; not on the order of the points.

    Args:
        points_m: (N, 3) points of the stem, metres; z is the height above the ground *at the stem*. Points that are not
            finite are left out.
        settings: Curve, band, definition, RANSAC.
        seed: Of the random samples; None takes the settings'.
        curves: Which curves to fit beside the chosen one; None fits all.
        ground_note: Added to the flags, for what the caller knows of the ground.
        axis: Of the stem, where it is known already (see `axis_of_stem`); else it is found.

    Raises:
        ValueError: The array has a wrong shape, or a curve has no such name.
    """
    points = as_points(points_m, name="points_m")
    names = _curve_names(settings.curve, curves)
    seed = settings.seed if seed is None else seed
    low, high = band_m(settings)
    finite = np.isfinite(points).all(axis=1)
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
    fits = {name: _fit_curve(name, section, settings, seed) for name in names}
    return _judged(section, fits, settings, ground_note)


def axis_of_stem(
    points_m: NDArray[np.floating[Any]], *, settings: MeasureSettings = _DEFAULTS, seed: int | None = None
) -> StemAxis:
    """The axis of a stem about breast height, from (N, 3) points as for `measure_stem`.

    Raises:
        ValueError: The array has a wrong shape, or no point is finite.
    """
    points = as_points(points_m, name="points_m")
    points = points[np.isfinite(points).all(axis=1)]
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
    wanted = list(CURVES) if curves is None else list(curves)
    unknown = [name for name in (chosen, *wanted) if name not in CURVES]
    if unknown:
        raise ValueError(f"curve {unknown[0]!r} is none of {', '.join(CURVES)}")
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


def _fit_curve(name: str, section: CrossSection, settings: MeasureSettings, seed: int) -> CurveFit | Refusal:
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


def _judged(
    section: CrossSection, fits: Mapping[str, CurveFit | Refusal], settings: MeasureSettings, ground_note: str
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
    diameters = {name: fit.diameter_m(settings.definition) for name, fit in fits.items() if isinstance(fit, CurveFit)}
    diameters["circle"] = 2.0 * section.ring_radius_m
    disagreement = disagreement_of(
        diameters[settings.curve], [value for name, value in diameters.items() if name != settings.curve]
    )
    rmse_m, n_points = chosen.rmse_m, int(chosen.inliers.sum())
    return DbhEstimate(
        dbh_cm=100.0 * diameters[settings.curve],
        curve=settings.curve,
        definition=settings.definition,
        section=section,
        fits=fits,
        quality=grade(section, rmse_m=rmse_m, disagreement=disagreement, n_points=n_points),
        flags=plain_flags(
            section,
            rmse_m=rmse_m,
            n_points=n_points,
            disagreement=disagreement,
            diameters_m=diameters,
            ground_note=ground_note,
        ),
        position_m=readonly(section.stem_from_section.apply(_centre(chosen)[None])[0]),
    )


def _centre(fit: CurveFit) -> Float64:
    return np.array([*outline_centroid(fit.outline_uv_m), 0.0])
