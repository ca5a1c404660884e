"""From the sides of markers to metres, or to why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dbh_studio.core.bars import BarResidual, ScaleReport, refused_scale
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.scale import CombinedScale, MeasuredLength, ScaleEstimate, ScaleVerdict, combine_lengths
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_geometry import Marker3D, MarkerKey

# Sides and diagonals of a flat square marker agree far better than this.
_BENT_SHARE = 0.02
_WELL_SEEN = 4


def check_marker(marker: Marker3D) -> Refusal | None:
    """Why a marker cannot give the scale: mirrored poses, or not a flat square; None where it can."""
    if marker.front_share < 0.5:
        return Refusal(
            "mirrored",
            f"{marker.name} appears mirrored: the photos see its printed side from behind.",
            "The poses are mirrored or in another axis convention; export them again.",
        )
    noise = 4 * float(np.sqrt(np.trace(marker.covariance) / 12)) / marker.side_src
    if marker.unevenness > max(_BENT_SHARE, noise):
        return Refusal(
            "bent",
            f"{marker.name} is not a flat square: its sides and diagonals differ by {100 * marker.unevenness:.1f} %.",
            "Mount the marker on a stiff board; one bent round a trunk has no known size.",
        )
    if marker.unevenness > 0.3:
        return Refusal(
            "uncertain_shape",
            f"{marker.name} is seen too poorly to be measured.",
            "Take photos nearer to it and from more sides.",
        )
    return None


def scale_from_markers(
    markers: Sequence[Marker3D],
    sides_m: Mapping[MarkerKey, float] | None = None,
    *,
    settings: MarkerSettings | None = None,
    seen_once: Sequence[MarkerKey] = (),
) -> ScaleReport:
    """The scale that fits all markers' sides and diagonals.

    Args:
        markers: From `triangulate_markers`.
        sides_m: Side of the black square per (dictionary, id); the others have `settings.side_m`.
        settings: The side, its error, and the corner error all photos share.
        seen_once: Codes that were detected but could not be placed, to say so.

    Returns:
        The report, with a residual per marker; its estimate is None, with reason and remedy, where none can be used.
    """
    settings = settings or MarkerSettings()
    sides = {marker.key: float((sides_m or {}).get(marker.key, settings.side_m)) for marker in markers}
    for marker in markers:
        if not (np.isfinite(sides[marker.key]) and sides[marker.key] > 0):
            return refused_scale(
                "no_length",
                f"The side of {marker.name} is given as {sides[marker.key]:g} m.",
                "Give the outer edge of its black square in metres.",
            )
    problems = [problem for problem in map(check_marker, markers) if problem is not None]
    usable = _trusted([marker for marker in markers if check_marker(marker) is None], sides_m or {})
    if not usable:
        return _no_marker(problems, seen_once)
    combined = combine_lengths([_length(marker, sides[marker.key], settings) for marker in usable])
    residuals = tuple(
        BarResidual(
            name=marker.name,
            role="control",
            lie="unknown",
            length_m=sides[marker.key],
            measured_m=marker.side_src * combined.metres_per_unit,
            residual_m=sides[marker.key] * residual,
            residual_pct=100 * residual,
            sigma_pct=100 * sigma,
        )
        for marker, residual, sigma in zip(usable, combined.relative_residuals, combined.relative_sigmas, strict=True)
    )
    estimate = ScaleEstimate(combined.metres_per_unit, "marker", combined.standard_error)
    n_views = min(len(marker.views_used) for marker in usable)
    verdict = _verdict(usable, combined, residuals, n_views, problems)
    return ScaleReport(estimate, residuals, combined.chi2, combined.freedom, None, None, n_views, verdict)


def _trusted(markers: Sequence[Marker3D], named: Mapping[MarkerKey, float]) -> list[Marker3D]:
    """Without codes that nobody named and few photos show, where others are seen well: such may be no markers."""
    if not any(len(marker.views_used) >= _WELL_SEEN for marker in markers):
        return list(markers)
    return [marker for marker in markers if marker.key in named or len(marker.views_used) >= _WELL_SEEN]


def _length(marker: Marker3D, side_m: float, settings: MarkerSettings) -> MeasuredLength:
    # Both ends of every side move outwards or inwards alike.
    systematic = 2 * settings.systematic_px * marker.footprint_src
    return MeasuredLength(
        marker.name, side_m, settings.side_error_mm / 1000, marker.side_src, marker.side_sigma_src, systematic
    )


def _no_marker(problems: Sequence[Refusal], seen_once: Sequence[MarkerKey]) -> ScaleReport:
    if problems:
        return refused_scale(problems[0].code, problems[0].reason, problems[0].remedy)
    if seen_once:
        names = ", ".join(f"{dictionary} {number}" for dictionary, number in sorted(set(seen_once))[:5])
        return refused_scale(
            "one_view",
            f"{names}: seen, but not in two photos from different places that agree.",
            "Take at least five photos of the marker from different sides, or mark its corners by hand.",
        )
    return refused_scale(
        "no_marker",
        "No marker was found in the photos.",
        "Check the dictionary, look whether a marker is in sight and large enough, or mark a known distance by hand.",
    )


def _verdict(
    usable: Sequence[Marker3D],
    combined: CombinedScale,
    residuals: Sequence[BarResidual],
    n_views: int,
    problems: Sequence[Refusal],
) -> ScaleVerdict:
    relative = 100 * combined.standard_error / combined.metres_per_unit
    said = f"The scale is known to ±{relative:.2f} % from {len(usable)} marker{'s' * (len(usable) > 1)}"
    spread = max(r.residual_pct for r in residuals) - min(r.residual_pct for r in residuals)
    worst = max(residuals, key=lambda r: abs(r.residual_pct))
    if combined.freedom and spread > 1.0 and combined.chi2 > 6.6 + 3 * (combined.freedom - 1):
        return ScaleVerdict(
            "caution",
            "inconsistent",
            f"The markers contradict each other by {spread:.1f} %: {worst.name} measures {worst.measured_m:.3f} m, "
            f"given as {worst.length_m:.3f} m.",
            "Check the side given for each: the outer edge of the black square, measured with a ruler.",
        )
    if len({marker.key for marker in usable}) < len(usable):
        return ScaleVerdict(
            "caution",
            "twice",
            f"{said}, but one number stands at two places.",
            "Use each marker number once in a plot.",
        )
    if problems:
        return ScaleVerdict("caution", problems[0].code, f"{said}. Not used: {problems[0].reason}", problems[0].remedy)
    if n_views < _WELL_SEEN:
        return ScaleVerdict(
            "caution", "few_views", f"{said}, seen in {n_views} photos only.", "Take more photos of it, from all sides."
        )
    if relative > 1.0:
        return ScaleVerdict(
            "caution", "uncertain", f"{said} only.", "Use a larger marker, or take photos nearer to it."
        )
    if len(usable) == 1:
        return ScaleVerdict(
            "good", "one_marker", f"{said} in {n_views} photos.", "A second marker or a check bar would test it."
        )
    return ScaleVerdict("good", "agrees", f"{said}, which agree within {spread:.2f} %.")
