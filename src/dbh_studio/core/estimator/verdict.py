"""What is made of a fit: its diameters with their intervals, or why none may be given."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.estimator.bark import bark_share
from dbh_studio.core.estimator.evidence import Evidence, bulge_share, flags_of, oval_of
from dbh_studio.core.estimator.heap import HeapSigns
from dbh_studio.core.estimator.interval import CALIBRATIONS, HALF_90, Calibration, Spread
from dbh_studio.core.estimator.passes import Passes
from dbh_studio.core.estimator.posterior import N_OUTLINE, Patches, Posterior
from dbh_studio.core.estimator.refusals import (
    clutter,
    implausible,
    no_surface,
    too_shallow,
    too_uncertain,
    two_rings,
)
from dbh_studio.core.estimator.result import EstimatorResult
from dbh_studio.core.estimator.ring_count import OtherStem
from dbh_studio.core.estimator.tube import Tube, wave_basis
from dbh_studio.core.measured import Diameter, Flag, Refusal, SectionRing
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import EstimatorSettings

_THIN = 0.75
"""A curve among points that are wide beside the stem reads thin: by this times (noise / diameter)², relative. Found on
development seeds; 0.05 % of a stem of 40 cm with 1 cm of noise, 0.8 % of one of 10."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """What was found of a stem, and why it is no diameter where it is none.

    Attributes:
        result: None where nothing round was found.
        refusal: None where the result may be given.
    """

    result: EstimatorResult | None
    refusal: Refusal | None


@dataclass(frozen=True)
class Told:
    """What the caller knows of errors that a stem's points do not show.

    Attributes:
        scale_sd: Relative standard error of the cloud's scale.
        drift_m: How far passes over the stem do not fit together, standard deviation per axis.
    """

    scale_sd: float
    drift_m: float


@dataclass(frozen=True, eq=False)
class Found:
    """All that was found of a stem.

    Attributes:
        points: (N, 3) points, x and y from the sample's middle, z from breast height.
        tube: The section, its axis and taper.
        posterior: Of its diameters.
        patches: Of bark.
        evidence: How the tube agrees with the points.
        method: ``ring`` or ``circle``.
        signs: Of a heap; None where they cannot be told, or a swelling is what speaks against a stem.
        others: Stems beside it.
        passes: The section as passes that do not fit together; None where nothing speaks for them.
    """

    points: Float64
    tube: Tube
    posterior: Posterior
    patches: Patches
    evidence: Evidence
    method: str
    signs: HeapSigns | None
    others: tuple[OtherStem, ...] = ()
    passes: Passes | None = None


def judged(found: Found, origin: Float64, settings: EstimatorSettings, told: Told) -> Assessment:
    """The result, with a refusal where it says too little or is no tree.

    Args:
        found: Of the stem.
        origin: (3,) what its points are counted from, metres.
        settings: Of the estimator.
        told: By the caller.
    """
    logs = dict(found.posterior.quantiles)
    if found.method == "circle":  # its own radius, with the width of a round tube's posterior
        logs = {name: _moved_to(values, np.log(2.0 * found.tube.radius)) for name, values in logs.items()}
    else:
        thin = _THIN * (found.tube.sigma / (2.0 * found.tube.radius)) ** 2
        logs = {name: _moved_to(values, values[1] + thin) for name, values in logs.items()}
        found = replace(found, tube=found.tube.larger(float(np.exp(thin))))
    bark, _ = bark_share(found.points, found.tube, expected=settings.bark_share)
    logs["tape"] = _moved_to(logs["tape"], logs["tape"][1] + np.log1p(bark))
    if found.passes is not None:
        shift = found.passes.log_shift(logs["area"][1])
        logs = {name: _moved_to(values, values[1] + shift) for name, values in logs.items()}
        found = replace(found, tube=found.tube.larger(float(np.exp(shift))))
    calibration = _calibration(found, settings)
    spreads = {name: _spread(values, found) for name, values in logs.items()}
    diameters = {name: _diameter(logs[name][1], calibration, spread, told) for name, spread in spreads.items()}
    spread = spreads[settings.definition]
    log_sd = calibration.log_sd(spread, scale_sd=told.scale_sd, drift_m=told.drift_m)
    result = _result(found, origin, settings, diameters, spread, log_sd)
    return Assessment(result, _refusal(found, settings, diameters[settings.definition], spread, log_sd))


def _calibration(found: Found, settings: EstimatorSettings) -> Calibration:
    """Of the method; a circle about an upright axis has one of its own."""
    is_upright = found.method == "circle" and settings.axis == "vertical"
    return CALIBRATIONS["circle, upright" if is_upright else found.method]


def _refusal(
    found: Found, settings: EstimatorSettings, chosen: Diameter, spread: Spread, log_sd: float
) -> Refusal | None:
    """Why a result may not be given; None where it may."""
    if found.evidence.is_heap(is_askew=found.method == "circle" and settings.axis == "vertical"):
        return no_surface(settings)
    if found.signs is not None and found.signs.chance > settings.max_clutter:
        return clutter(found.signs, settings)
    if any(each.may_be_meant for each in found.others):
        return two_rings(found.tube, found.others, settings)
    if spread.depth_noise > settings.max_depth_noise:
        return too_shallow(found.evidence, spread.sigma_m)
    if not settings.min_diameter_cm <= chosen.value_cm <= settings.max_diameter_cm:
        return implausible(chosen, settings)
    is_wide = HALF_90 * log_sd > settings.max_half_width
    if is_wide or found.evidence.arc_deg < settings.min_arc_deg:
        return too_uncertain(found.evidence, chosen, settings)
    return None


def _result(
    found: Found,
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
    flags = flags_of(
        evidence,
        tube,
        lean_deg=lean,
        beside=found.others,
        drift_chance=_calibration(found, settings).drift_chance(spread),
        signs=found.signs,
    )
    if found.method != settings.method:
        words = "the closed curve had no hold, or reached round two stems: a plain circle was fitted"
        flags = (*flags, Flag("fallback", words))
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
        rings=_rings(found, origin),
    )


def _rings(found: Found, origin: Float64) -> tuple[SectionRing, ...]:
    """The stem measured, and those beside it."""
    tubes = [(found.tube, found.evidence.n_points), *((each.tube, each.n_points) for each in found.others)]
    return tuple(
        SectionRing(readonly(origin[:2] + tube.centre), float(tube.radius), n_points) for tube, n_points in tubes
    )


def _spread(logs: tuple[float, float, float], found: Found) -> Spread:
    evidence = found.evidence
    return Spread(
        posterior=(logs[2] - logs[0]) / 3.29,
        sigma_m=found.tube.sigma,
        outline_m=float(found.posterior.outline_sd_m.mean()),
        scatter_m=found.patches.scatter_m,
        n_points=evidence.n_points,
        gap=evidence.gap_deg / 360.0,
        waves=oval_of(found.tube),
        wall_ratio=evidence.wall_ratio,
        diameter_m=float(np.exp(logs[1])),
        passes=0.0 if found.passes is None else found.passes.probability,
        apart=0.0 if found.passes is None else found.passes.separation_m / float(np.exp(logs[1])),
        # A circle is of the points just there, and follows a swelling.
        bulge=bulge_share(evidence, found.tube) if found.method == "ring" else 0.0,
    )


def _diameter(log_m: float, calibration: Calibration, spread: Spread, told: Told) -> Diameter:
    half = HALF_90 * calibration.log_sd(spread, scale_sd=told.scale_sd, drift_m=told.drift_m)
    return Diameter(
        100.0 * float(np.exp(log_m)), 100.0 * float(np.exp(log_m - half)), 100.0 * float(np.exp(log_m + half))
    )


def _moved_to(logs: tuple[float, float, float], middle: float) -> tuple[float, float, float]:
    shift = middle - logs[1]
    return logs[0] + shift, logs[1] + shift, logs[2] + shift
