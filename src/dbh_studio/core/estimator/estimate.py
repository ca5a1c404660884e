"""A diameter with an honest interval, from a stem of which perhaps only a part was seen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, as_points, finite_points, finite_rows
from dbh_studio.core.axis import StemAxis
from dbh_studio.core.estimator.circle import circle_tube
from dbh_studio.core.estimator.evidence import ODD_SHAPE, Evidence, evidence_of, oval_of
from dbh_studio.core.estimator.fit import fit_tube
from dbh_studio.core.estimator.heap import HeapSigns, heap_signs_of
from dbh_studio.core.estimator.passes import Passes, is_suspect, passes_of
from dbh_studio.core.estimator.posterior import patches_of, posterior_of
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.refusals import no_ring, too_few
from dbh_studio.core.estimator.result import EstimatorResult
from dbh_studio.core.estimator.ring_count import MOST_STEMS, Stems, first_of, stems_of
from dbh_studio.core.estimator.sample import sample_points
from dbh_studio.core.estimator.search import search_rings
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.core.estimator.verdict import Assessment, Found, Told, judged
from dbh_studio.core.measured import Refusal
from dbh_studio.core.medians import median
from dbh_studio.core.robust import Circle
from dbh_studio.settings import EstimatorSettings

_DEFAULTS = EstimatorSettings()
_FURTHEST_M = 1e9  # from the origin: beyond any survey coordinate, and squares stay finite
_NEAR_M = 0.6  # from breast height
_SURE_RING = 0.05  # standard deviation of a ring's points, relative to its radius, where none is told


def estimate_diameter(
    points_m: NDArray[np.floating[Any]],
    *,
    settings: EstimatorSettings = _DEFAULTS,
    scale_sd: float = 0.0,
    drift_m: float = 0.0,
    seed: int | None = None,
) -> EstimatorResult | Refusal:
    """The diameter of one stem at breast height, with a 90 % interval.

    The result depends on the points, the settings and the seed; not on the order of the points.

    Args:
        points_m: (N, 3) points of the stem and what is around it, metres; z is the height above the ground at the
            stem. What is not finite, or outside the stretch of stem used, or farther than 10⁹ m from the
            origin, is left out.
        settings: Method, stretch, priors, limits.
        scale_sd: Relative standard error of the cloud's scale; widens the interval.
        drift_m: How far passes over the stem do not fit together, standard deviation per axis where it is known from
            elsewhere (registration, loop closure); widens the interval.
        seed: Of the random samples; None takes the settings'.

    Raises:
        ValueError: The array has a wrong shape, or `scale_sd` or `drift_m` is negative.
    """
    found = assess_stem(points_m, settings=settings, scale_sd=scale_sd, drift_m=drift_m, seed=seed)
    if found.refusal is not None:
        return found.refusal
    assert found.result is not None
    return found.result


def assess_stem(
    points_m: NDArray[np.floating[Any]],
    *,
    settings: EstimatorSettings = _DEFAULTS,
    scale_sd: float = 0.0,
    drift_m: float = 0.0,
    seed: int | None = None,
    line: StemAxis | None = None,
) -> Assessment:
    """As `estimate_diameter`, but with what was found also where it is refused, to be looked at.

    Args:
        points_m: As there, and the other arguments.
        settings: Of the estimator.
        scale_sd: Of the scale.
        drift_m: Of the passes.
        seed: Of the samples.
        line: Where the stem is, from `stem_line`, if it was looked for already.
    """
    for name, value in (("scale_sd", scale_sd), ("drift_m", drift_m)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} is {value} but must be finite and not negative")
    points = as_points(points_m, name="points_m")
    seed = settings.seed if seed is None else seed
    used = _window(points, settings)
    for stretch, least in ((_stretch(settings), settings.min_points), (_near(settings), settings.min_points // 3)):
        n_there = int(np.count_nonzero((used[:, 2] >= stretch[0]) & (used[:, 2] <= stretch[1])))
        if n_there < least:
            heights = finite_points(points)[:, 2].astype(np.float64)
            return Assessment(None, too_few(heights, n_there, stretch, least))
    local, origin = _local(used, settings, seed)
    stems = _stems(local, origin, line, settings, seed)
    found = no_ring(len(local), settings) if stems is None else _fitted(stems, settings, seed)
    if isinstance(found, Refusal):
        return Assessment(None, found)
    return judged(found, origin, settings, Told(scale_sd, drift_m))


def stem_line(
    points_m: NDArray[np.floating[Any]], *, settings: EstimatorSettings = _DEFAULTS, seed: int | None = None
) -> StemAxis | None:
    """Where the stem is, to start from: its axis and a first radius; None where nothing is round.

    Args:
        points_m: (N, 3) points as for `estimate_diameter`.
        settings: Of the estimator.
        seed: Of the random samples.
    """
    seed = settings.seed if seed is None else seed
    used = _window(as_points(points_m, name="points_m"), settings)
    if len(used) < settings.min_points:
        return None
    local, origin = _local(used, settings, seed)
    stems = _started(local, settings, seed, most=2)
    if stems is None:
        return None
    start = stems.main
    centre = origin + np.array([*start.centre, 0.0])
    return StemAxis(centre, start.frame()[2], Circle(centre[:2], start.radius, start.sigma), "stem")


def heap_signs(
    points_m: NDArray[np.floating[Any]],
    line: StemAxis,
    radius_m: float,
    *,
    settings: EstimatorSettings = _DEFAULTS,
    seed: int | None = None,
) -> HeapSigns | None:
    """What speaks for a heap in place of a stem about a ring that was found otherwise; None where too little is there.

    Args:
        points_m: (N, 3) points as for `estimate_diameter`.
        line: Axis of the ring.
        radius_m: Of the ring.
        settings: Of the estimator.
        seed: Of the sample.
    """
    used = _window(as_points(points_m, name="points_m"), settings)
    if len(used) < settings.min_points:
        return None
    local, origin = _local(used, settings, settings.seed if seed is None else seed)
    ring = Circle(line.point_m[:2], radius_m, _SURE_RING * radius_m)
    prior = StemPrior.from_settings(settings)
    curve = fit_tube(local, _start_at(line, ring, origin), prior)
    return None if curve is None else heap_signs_of(local, curve, prior)


def _window(points: NDArray[np.floating[Any]], settings: EstimatorSettings) -> Float64:
    """(N, 3) points of the stretch of stem used; none that is not finite, or absurdly far away."""
    low, high = _stretch(settings)
    height = points[:, 2]
    rows = np.flatnonzero(finite_rows(points) & (height >= low) & (height <= high))
    used = points.take(rows, axis=0).astype(np.float64)
    is_near = np.abs(used[:, :2]) <= _FURTHEST_M
    return used if is_near.all() else used[is_near.all(axis=1)]


def _stretch(settings: EstimatorSettings) -> tuple[float, float]:
    return settings.breast_height_m - settings.below_m, settings.breast_height_m + settings.above_m


def _near(settings: EstimatorSettings) -> tuple[float, float]:
    """The part of the stretch that must hold points: from farther away breast height would only be guessed."""
    low, high = _stretch(settings)
    return max(low, settings.breast_height_m - _NEAR_M), min(high, settings.breast_height_m + _NEAR_M)


def _local(used: Float64, settings: EstimatorSettings, seed: int) -> tuple[Float64, Float64]:
    """(N, 3) sample of the points about an origin at breast height, and that origin."""
    # Rounded, so that a plot's survey coordinates cost no digits and the sample does not depend on the median's last.
    middle = [median(used[:, 0]), median(used[:, 1])]
    origin = np.array([*np.round(middle, 2), settings.breast_height_m])
    return used[sample_points(used, settings.max_points, seed=seed)] - origin, origin


def _stems(
    local: Float64, origin: Float64, line: StemAxis | None, settings: EstimatorSettings, seed: int
) -> Stems | None:
    """The stem to measure, and those beside it; None where nothing is round."""
    if line is None or line.ring is None:
        return _started(local, settings, seed)
    first = _start_at(line, line.ring, origin)
    return stems_of(local, first, widest_m=settings.max_diameter_cm / 200.0, seed=seed)


def _started(local: Float64, settings: EstimatorSettings, seed: int, *, most: int = MOST_STEMS) -> Stems | None:
    """The same by a search of its own."""
    rng, widest_m = np.random.default_rng([seed, 201]), settings.max_diameter_cm / 200.0
    found = search_rings(local, widest_m=widest_m, taper=settings.taper, rng=rng)
    if not len(found.rings.radius):
        return None
    return stems_of(local, first_of(found), widest_m=widest_m, seed=seed, most=most)


def _start_at(line: StemAxis, ring: Circle, origin: Float64) -> Tube:
    slope = line.direction[:2] / line.direction[2]
    return Tube(line.xy_at(float(origin[2])) - origin[:2], slope, ring.radius_m, 0.0, np.empty(0), ring.sigma_m)


def _fitted(stems: Stems, settings: EstimatorSettings, seed: int) -> Found | Refusal:
    """Fit and posterior; the plain circle where the ring's fit fails."""
    prior = StemPrior.from_settings(settings)
    if settings.method == "ring":
        found = _by("ring", stems, prior, settings, seed)
        if found is not None and oval_of(found.tube) > ODD_SHAPE:
            # A second stem may have been taken for a bulge of this one: a circle does not reach round both.
            circle = _by("circle", stems, prior, settings, seed)
            if circle is not None:
                more = stems_of(stems.points, circle.tube, widest_m=settings.max_diameter_cm / 200.0, seed=seed).others
                if more:
                    return replace(circle, others=(*stems.others, *more))
        if found is not None:
            return found
    found = _by("circle", stems, prior, settings, seed)
    return no_ring(len(stems.points), settings) if found is None else found


def _by(method: str, stems: Stems, prior: StemPrior, settings: EstimatorSettings, seed: int) -> Found | None:
    """What one method finds; None where it finds nothing."""
    local, start, is_ring = stems.points, stems.main, method == "ring"
    curve = fit_tube(local, start, prior)
    tube = curve if is_ring else circle_tube(local, start, prior, settings, seed=seed)
    if tube is None:
        return None
    shown = local if is_ring or settings.axis == "stem" else _about_circle(local, settings)
    patches = patches_of(shown, tube, bloat_chance=settings.bloat_chance, bloat_m=settings.bloat_m)
    if patches is None:
        return None
    posterior = posterior_of(patches, tube, prior if is_ring else replace(prior, highest=1), seed=seed)
    tube = posterior.tube if is_ring else replace(tube, radius=tube.radius + patches.shift_m)
    evidence = evidence_of(shown, tube)
    if evidence is None:
        return None
    signs = None if curve is None else heap_signs_of(local, curve, prior)
    passes = _passes(local, tube, evidence, prior, settings) if is_ring else None
    return Found(local, tube, posterior, patches, evidence, method, signs, stems.others, passes)


def _about_circle(local: Float64, settings: EstimatorSettings) -> Float64:
    """(M, 3) points to hold against an upright circle: those of its band, where they are enough to tell something.

    About a stem that leans the others lie beside it. They would pass for bark that is smeared, and speak against it.
    """
    band = local[np.abs(local[:, 2]) <= 0.5 * settings.band_m]
    return band if len(band) >= settings.min_points else local


def _passes(
    local: Float64, tube: Tube, evidence: Evidence, prior: StemPrior, settings: EstimatorSettings
) -> Passes | None:
    """The section as passes that do not fit together; None where nothing speaks for them."""
    oval = oval_of(tube)
    if not is_suspect(tube, gap_deg=evidence.gap_deg, wall_ratio=evidence.wall_ratio, oval=oval):
        return None
    return passes_of(
        local,
        tube,
        prior,
        gap_deg=evidence.gap_deg,
        wall_ratio=evidence.wall_ratio,
        oval=oval,
        bloat_chance=settings.bloat_chance,
        bloat_m=settings.bloat_m,
    )
