"""A diameter with an honest interval, from a stem of which perhaps only a part was seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, as_points, readonly
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.estimator.circle import circle_tube
from dbh_studio.core.estimator.evidence import Evidence, evidence_of, flags_of, stem_beside
from dbh_studio.core.estimator.fit import fit_tube
from dbh_studio.core.estimator.interval import CALIBRATIONS, Calibration, Spread
from dbh_studio.core.estimator.posterior import N_OUTLINE, Patches, Posterior, patches_of, posterior_of
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.result import Diameter, EstimatorResult, Flag
from dbh_studio.core.estimator.sample import sample_points
from dbh_studio.core.estimator.search import find_rings
from dbh_studio.core.estimator.tube import Tube, wave_basis
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import EstimatorSettings

_DEFAULTS = EstimatorSettings()
_REMEDY = "Record the stem from its other side, or enter a tape value."


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
            stem. What is not finite, or outside the stretch of stem used, is left out.
        settings: Method, stretch, priors, limits.
        scale_sd: Relative standard error of the cloud's scale; widens the interval.
        drift_m: How far passes over the stem do not fit together, standard deviation per axis where it is known from
            elsewhere (registration, loop closure); widens the interval.
        seed: Of the random samples; None takes the settings'.

    Raises:
        ValueError: The array has a wrong shape, or `scale_sd` or `drift_m` is negative.
    """
    for name, value in (("scale_sd", scale_sd), ("drift_m", drift_m)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} is {value} but must be finite and not negative")
    points = as_points(points_m, name="points_m")
    seed = settings.seed if seed is None else seed
    finite = np.isfinite(points).all(axis=1)
    low, high = settings.breast_height_m - settings.below_m, settings.breast_height_m + settings.above_m
    used = points[finite & (points[:, 2] >= low) & (points[:, 2] <= high)].astype(np.float64)
    if len(used) < settings.min_points:
        return _too_few(points[finite, 2], len(used), low, high, settings)
    # Rounded, so that a plot's survey coordinates cost no digits and the sample does not depend on the median's last.
    origin = np.array([*np.round(np.median(used[:, :2], axis=0), 2), settings.breast_height_m])
    local = used[sample_points(used, settings.max_points, seed=seed)] - origin
    found = _fitted(local, settings, seed)
    if isinstance(found, Refusal):
        return found
    return _judged(found, origin, settings, _Told(scale_sd, drift_m))


@dataclass(frozen=True)
class _Told:
    """What the caller knows of errors that a stem's points do not show."""

    scale_sd: float
    drift_m: float


@dataclass(frozen=True, eq=False)
class _Found:
    """All that was found of a stem."""

    points: Float64
    tube: Tube
    posterior: Posterior
    patches: Patches
    evidence: Evidence
    method: str


def _fitted(local: Float64, settings: EstimatorSettings, seed: int) -> _Found | Refusal:
    """Search, fit and posterior; the plain circle where the ring's fit fails."""
    prior = StemPrior.from_settings(settings)
    rng = np.random.default_rng([seed, 201])
    rings, _ = find_rings(local, widest_m=settings.max_diameter_cm / 200.0, taper=settings.taper, rng=rng)
    if not len(rings.radius):
        return _no_ring(local, settings)
    start = Tube(rings.middles()[0], rings.slope[0], float(rings.radius[0]), 0.0, np.empty(0), float(rings.sigma[0]))
    for method in ("ring", "circle") if settings.method == "ring" else ("circle",):
        tube = (
            fit_tube(local, start, prior) if method == "ring" else circle_tube(local, start, prior, settings, seed=seed)
        )
        patches = None if tube is None else patches_of(local, tube, bloat_chance=settings.bloat_chance)
        if tube is None or patches is None:
            continue
        belief = prior if method == "ring" else replace(prior, highest=1)
        posterior = posterior_of(patches, tube, belief, seed=seed)
        tube = posterior.tube if method == "ring" else replace(tube, radius=tube.radius + patches.shift_m)
        evidence = evidence_of(local, tube)
        if evidence is not None:
            return _Found(local, tube, posterior, patches, evidence, method)
    return _no_ring(local, settings)


def _judged(found: _Found, origin: Float64, settings: EstimatorSettings, told: _Told) -> EstimatorResult | Refusal:
    """The result, unless it says too little or is no tree."""
    logs = dict(found.posterior.quantiles)
    if found.method == "circle":  # its own radius, with the width of a round tube's posterior
        logs = {name: _moved_to(values, np.log(2.0 * found.tube.radius)) for name, values in logs.items()}
    logs["tape"] = _moved_to(logs["tape"], logs["tape"][1] + np.log1p(settings.bark_share))
    calibration = CALIBRATIONS[found.method]
    spreads = {name: _spread(values, found) for name, values in logs.items()}
    diameters = {name: _diameter(logs[name][1], calibration, spread, told) for name, spread in spreads.items()}
    chosen = diameters[settings.definition]
    if not settings.min_diameter_cm <= chosen.value_cm <= settings.max_diameter_cm:
        limits = f"{settings.min_diameter_cm:g} to {settings.max_diameter_cm:g} cm"
        reason = f"The ring is {chosen.value_cm:.1f} cm thick, outside {limits}."
        return Refusal("implausible", reason, "Check the scale of the cloud; if it is right, change the limits.")
    spread = spreads[settings.definition]
    log_sd = calibration.log_sd(spread, scale_sd=told.scale_sd, drift_m=told.drift_m)
    if calibration.factor * log_sd > settings.max_half_width or found.evidence.arc_deg < settings.min_arc_deg:
        return _too_uncertain(found.evidence, chosen)
    return _result(found, origin, settings, diameters, spread, log_sd)


def _result(
    found: _Found,
    origin: Float64,
    settings: EstimatorSettings,
    diameters: dict[str, Diameter],
    spread: Spread,
    log_sd: float,
) -> EstimatorResult:
    tube, evidence = found.tube, found.evidence
    u, v, w = tube.frame()
    lean = float(np.degrees(np.arctan(np.hypot(*tube.slope))))
    position = origin + np.array([*tube.centre, 0.0])
    angle = np.arange(N_OUTLINE) * (2 * np.pi / N_OUTLINE)
    radius = tube.radius + tube.waves @ wave_basis(np.cos(angle), np.sin(angle), 1 + len(tube.waves) // 2)
    beside = stem_beside(found.points, tube, widest_m=settings.max_diameter_cm / 200.0, seed=settings.seed)
    flags = flags_of(evidence, tube, lean_deg=lean, neighbour=beside)
    if found.method != settings.method:
        flags = (*flags, Flag("fallback", "the closed curve found no hold; a plain circle was fitted"))
    return EstimatorResult(
        diameters=diameters,
        definition=settings.definition,
        method=found.method,
        arc_deg=evidence.arc_deg,
        gap_deg=evidence.gap_deg,
        residual_mm=1000.0 * evidence.residual_m,
        n_points=evidence.n_points,
        lean_deg=lean,
        taper_cm_per_m=200.0 * tube.taper,
        height_m=settings.breast_height_m,
        position_m=readonly(position),
        stem_from_section=Similarity(np.column_stack([u, v, w]), position),
        outline_uv_m=readonly(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)),
        outline_sd_m=readonly(found.posterior.outline_sd_m),
        outline_seen=readonly(evidence.seen),
        spread=spread,
        log_sd=log_sd,
        flags=flags,
    )


def _spread(logs: tuple[float, float, float], found: _Found) -> Spread:
    return Spread(
        posterior=(logs[2] - logs[0]) / 3.29,
        sigma_m=found.tube.sigma,
        scatter_m=found.patches.scatter_m,
        gap=found.evidence.gap_deg / 360.0,
        bloat_m=float(np.hypot(found.patches.shift_m, found.patches.shift_sd_m)),
        walls_m=found.evidence.two_walls_m,
        waves=float(np.sqrt(0.5 * (found.tube.waves**2).sum())) / found.tube.radius,
        diameter_m=float(np.exp(logs[1])),
    )


def _diameter(log_m: float, calibration: Calibration, spread: Spread, told: _Told) -> Diameter:
    half = calibration.factor * calibration.log_sd(spread, scale_sd=told.scale_sd, drift_m=told.drift_m)
    return Diameter(
        100.0 * float(np.exp(log_m)), 100.0 * float(np.exp(log_m - half)), 100.0 * float(np.exp(log_m + half))
    )


def _moved_to(logs: tuple[float, float, float], middle: float) -> tuple[float, float, float]:
    shift = middle - logs[1]
    return logs[0] + shift, logs[1] + shift, logs[2] + shift


def _too_few(
    heights_m: NDArray[np.floating[Any]], n_used: int, low: float, high: float, settings: EstimatorSettings
) -> Refusal:
    if not len(heights_m):
        return Refusal("no_points", "The stem has no points.", "Segment the plot again, or add points by hand.")
    if n_used:
        reason = (
            f"Only {n_used} points between {low:.2f} and {high:.2f} m above ground; {settings.min_points} are needed."
        )
        return Refusal("too_few_points", reason, "Record the stem from nearer, or enter a tape value.")
    lowest, highest = np.quantile(heights_m, [0.01, 0.99])
    return Refusal(
        "no_band",
        f"No points between {low:.2f} and {high:.2f} m above ground; they lie from {lowest:.2f} to {highest:.2f} m.",
        "Check the ground and the scale; if they are right, set another breast height.",
    )


def _no_ring(local: Float64, settings: EstimatorSettings) -> Refusal:
    return Refusal(
        "no_ring",
        f"The {len(local)} points about {settings.breast_height_m:.2f} m above ground do not form a ring.",
        "Look at the stem: remove what is not bark, or delete it if it is no tree.",
    )


def _too_uncertain(evidence: Evidence, chosen: Diameter) -> Refusal:
    between = f"anything from {chosen.low_cm:.0f} to {chosen.high_cm:.0f} cm would agree with the points"
    if evidence.gap_deg >= 120.0:
        return Refusal("small_arc", f"Only {evidence.arc_deg:.0f}° of the ring seen: {between}.", _REMEDY)
    return Refusal("too_uncertain", f"The points are too few or too scattered; {between}.", _REMEDY)
