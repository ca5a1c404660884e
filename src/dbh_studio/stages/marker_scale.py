"""From the sides of markers to metres, or to why not."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.bars import BarResidual, ScaleReport, refused_scale
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.scale import CombinedScale, MeasuredLength, ScaleEstimate, ScaleVerdict, combine_lengths
from dbh_studio.core.scale_evidence import WELL_SEEN
from dbh_studio.settings import MarkerSettings
from dbh_studio.stages.marker_geometry import Marker3D, MarkerKey

# Sides and diagonals of a flat square agree better than this: to 0.35 % on sixty rendered plots.
_BENT_SHARE = 0.006
# Nobody prints markers outside this.
_SMALLEST_SIDE_M, _LARGEST_SIDE_M = 0.02, 10.0
# Markers that differ by more are not of the sizes given; by more than the second, no mean of them means anything.
_CONTRADICTION = 0.01
_HOPELESS = 0.05
_CONTRADICTION_SIGMAS = 4.0
# A marker with so many times the error of the best would weigh a few percent at most.
_FAR_WORSE = 5.0
# Round a stem thinner than the marker is wide, sides and diagonals differ by more.
_BEND_SHOWS = 0.03
# Where fewer of the photos that show a code agree on where it is, the directions of the photos are wrong.
_AGREEING_SHARE = 0.4
_ENOUGH_SIGHTS = 5


def check_marker(marker: Marker3D) -> Refusal | None:
    """Why a marker cannot give the scale: mirrored poses, or not a flat square; None where it can."""
    agreeing = len(marker.views_used) + len(marker.views_far)
    seen = agreeing + marker.n_lost
    if seen >= _ENOUGH_SIGHTS and agreeing < _AGREEING_SHARE * seen:
        return poses_disagree(marker.name, seen, agreeing)
    if marker.front_share < 0.5:
        return Refusal(
            "mirrored",
            f"{marker.name} appears mirrored: the photos see its printed side from behind.",
            "The poses are mirrored or in another axis convention; export them again.",
        )
    if marker.unevenness > max(_BENT_SHARE, _shape_noise(marker)):
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


def _shape_noise(marker: Marker3D) -> float:
    """By how much a flat square may seem uneven: four standard errors of a corner, as a share of the side."""
    return 4 * float(np.sqrt(np.trace(marker.covariance) / 12)) / marker.side_src


def poses_disagree(name: str, seen: int, agreeing: int) -> Refusal:
    """A code seen in many photos whose directions do not meet."""
    return Refusal(
        "poses_disagree",
        f"{name} is seen in {seen} photos, but the directions of {'only ' + str(agreeing) if agreeing else 'none'} "
        "of them meet in one place.",
        "The camera model or the directions of the photos are wrong (another axis convention, a turned panorama): "
        "check how the poses were exported, and that they belong to these photos.",
    )


def scale_from_markers(
    markers: Sequence[Marker3D],
    sides_m: Mapping[MarkerKey, float] | None = None,
    *,
    settings: MarkerSettings | None = None,
    seen_once: Sequence[MarkerKey] = (),
    sights: Mapping[MarkerKey, int] | None = None,
    left_out: Collection[MarkerKey] = (),
    only_named: bool = False,
) -> ScaleReport:
    """The scale that fits all markers' sides and diagonals.

    Markers whose side somebody gave come first: others that contradict them are left out and named. Where most markers
    agree, the one that does not is left out and named. Two that contradict each other give no scale. A marker known so
    poorly beside others that it would hardly count is not used: whether it is bent cannot be seen on it.

    Args:
        markers: From `triangulate_markers`.
        sides_m: Side of the black square per (dictionary, id); the others have `settings.side_m`.
        settings: The side, its error, and the corner error all photos share.
        seen_once: Codes that were detected but could not be placed, to say so.
        sights: In how many photos each of these was detected, to say why.
        left_out: Markers struck out by the person. For single sights see `triangulate_markers`.
        only_named: Whether markers without a side of their own in `sides_m` are ignored.

    Returns:
        The report, with a residual per marker; its estimate is None, with reason and remedy, where none can be used.
    """
    settings = settings or MarkerSettings()
    struck = set(left_out)
    named = sides_m or {}
    markers = [m for m in markers if m.key not in struck and (m.key in named or not only_named)]
    sides = {marker.key: float(named.get(marker.key, settings.side_m)) for marker in markers}
    for key, side_m in {**named, **sides}.items():
        problem = _bad_side(f"{key[0]} {key[1]}", float(side_m))
        if problem is not None:
            return refused_scale(problem.code, problem.reason, problem.remedy)
    problems = [problem for problem in map(check_marker, markers) if problem is not None]
    usable = _trusted([marker for marker in markers if check_marker(marker) is None], named)
    if not usable:
        return _no_marker(problems, seen_once, sights or {})
    usable, contradictions = _agreeing(_that_count(usable, sides, settings), sides, named, settings)
    if not usable:
        return refused_scale(contradictions[0].code, contradictions[0].reason, contradictions[0].remedy)
    problems += contradictions
    if named and not any(marker.key in named for marker in usable):
        problems.insert(0, _default_side(usable[0], settings.side_m))
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


def _bad_side(name: str, side_m: float) -> Refusal | None:
    remedy = "Give the outer edge of its black square in metres."
    if not (np.isfinite(side_m) and side_m > 0):
        return Refusal("no_length", f"The side of {name} is given as {side_m:g} m.", remedy)
    if not _SMALLEST_SIDE_M <= side_m <= _LARGEST_SIDE_M:
        how = "small" if side_m < _SMALLEST_SIDE_M else "large"
        reason = f"The side of {name} is given as {side_m:g} m; no printed marker is that {how}."
        return Refusal("absurd_length", reason, remedy)
    return None


def _agreeing(
    markers: list[Marker3D],
    sides: Mapping[MarkerKey, float],
    named: Mapping[MarkerKey, float],
    settings: MarkerSettings,
) -> tuple[list[Marker3D], list[Refusal]]:
    """The markers to use, and what is said of the others; none to use where two contradict each other badly."""
    logs = np.array([np.log(sides[marker.key] / marker.side_src) for marker in markers])
    sigmas = _relative_sigmas(markers, sides, settings)
    apart = np.abs(logs[:, None] - logs)
    agree = apart <= np.maximum(_CONTRADICTION, _CONTRADICTION_SIGMAS * np.hypot.outer(sigmas, sigmas))
    if agree.all():
        return markers, []
    is_named = np.array([marker.key in named for marker in markers])
    leaders = is_named if is_named.any() else np.ones(len(markers), bool)
    # Most leaders first, then most of all.
    votes = np.where(leaders, 1000 * (agree & leaders).sum(axis=1) + agree.sum(axis=1), -1)
    best = int(np.argmax(votes))
    kept = agree[best]
    if 2 * int((kept & leaders).sum()) > int(leaders.sum()):
        others = [_other_size(m, sides[m.key], float(logs[best])) for m, k in zip(markers, kept, strict=True) if not k]
        return [m for m, k in zip(markers, kept, strict=True) if k], others
    if apart[np.ix_(leaders, leaders)].max() > _HOPELESS:
        farthest = int(np.argmax(np.where(leaders, apart[best], -1.0)))
        return [], [_contradiction(markers, sides, best, farthest)]
    return [m for m, chosen in zip(markers, leaders, strict=True) if chosen], []


def _relative_sigmas(
    markers: Sequence[Marker3D], sides: Mapping[MarkerKey, float], settings: MarkerSettings
) -> Float64:
    """(N,) standard error of the scale from each marker alone, as a share."""
    lengths = [_length(marker, sides[marker.key], settings) for marker in markers]
    parts = [(one.sigma_src / one.measured_src, one.systematic_src / one.measured_src) for one in lengths]
    ruler = [one.length_se_m / one.length_m for one in lengths]
    return np.asarray(np.sqrt((np.array(parts) ** 2).sum(axis=1) + np.array(ruler) ** 2))


def _that_count(markers: list[Marker3D], sides: Mapping[MarkerKey, float], settings: MarkerSettings) -> list[Marker3D]:
    """Without those that are known far worse than the best, and so poorly that a bend would not show."""
    sigmas = _relative_sigmas(markers, sides, settings)
    return [
        marker
        for marker, sigma in zip(markers, sigmas, strict=True)
        if sigma <= _FAR_WORSE * sigmas.min() or _shape_noise(marker) < _BEND_SHOWS
    ]


def _default_side(marker: Marker3D, side_m: float) -> Refusal:
    return Refusal(
        "default_side",
        f"no marker with a side of its own can be used; {marker.name} is taken to be {side_m:.3f} m.",
        "Give the side of this marker, or strike it out.",
    )


def _other_size(marker: Marker3D, side_m: float, log_scale: float) -> Refusal:
    return Refusal(
        "other_size",
        f"{marker.name} measures {marker.side_src * np.exp(log_scale):.3f} m by the other markers, "
        f"but its side is given as {side_m:.3f} m.",
        "Give its own side, measured at the outer edge of the black square, or strike it out.",
    )


def _contradiction(markers: Sequence[Marker3D], sides: Mapping[MarkerKey, float], one: int, other: int) -> Refusal:
    a, b = markers[one], markers[other]
    side_a, side_b = sides[a.key], sides[b.key]
    ratio = b.side_src / a.side_src
    return Refusal(
        "contradict",
        f"{a.name} and {b.name} contradict each other: given as {side_a:.3f} m and {side_b:.3f} m, but the second is "
        f"{ratio:.3f} times the first. If {a.name} is {side_a:.3f} m, {b.name} is {side_a * ratio:.3f} m; "
        f"if {b.name} is {side_b:.3f} m, {a.name} is {side_b / ratio:.3f} m.",
        "Measure both sides with a ruler at the outer edge of the black square, and give each marker its own.",
    )


def _trusted(markers: Sequence[Marker3D], named: Mapping[MarkerKey, float]) -> list[Marker3D]:
    """Without codes that nobody named and few photos show, where others are seen well: such may be no markers."""
    if not any(len(marker.views_used) >= WELL_SEEN for marker in markers):
        return list(markers)
    return [marker for marker in markers if marker.key in named or len(marker.views_used) >= WELL_SEEN]


def _length(marker: Marker3D, side_m: float, settings: MarkerSettings) -> MeasuredLength:
    # Both ends of every side move outwards or inwards alike.
    drift = 2 * settings.systematic_px * marker.footprint_src
    systematic = drift if marker.size_drift is None else marker.size_drift * marker.side_src
    return MeasuredLength(
        marker.name, side_m, settings.side_error_mm / 1000, marker.side_src, marker.side_sigma_src, systematic
    )


def _no_marker(
    problems: Sequence[Refusal], seen_once: Sequence[MarkerKey], sights: Mapping[MarkerKey, int]
) -> ScaleReport:
    if problems:
        return refused_scale(problems[0].code, problems[0].reason, problems[0].remedy)
    often = max(seen_once, key=lambda key: sights.get(key, 0), default=None)
    if often is not None and sights.get(often, 0) >= _ENOUGH_SIGHTS:
        problem = poses_disagree(f"{often[0]} {often[1]}", sights[often], 0)
        return refused_scale(problem.code, problem.reason, problem.remedy)
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
        intro = "But" if problems[0].code == "default_side" else "Not used:"
        return ScaleVerdict("caution", problems[0].code, f"{said}. {intro} {problems[0].reason}", problems[0].remedy)
    if n_views < WELL_SEEN:
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
