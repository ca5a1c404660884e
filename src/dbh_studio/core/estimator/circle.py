"""The plain robust circle: the estimator's rival, and what it falls back on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.fit import fit_tube
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.core.robust import Circle, robust_circle
from dbh_studio.settings import EstimatorSettings


def circle_tube(
    points: Float64, start: Tube, prior: StemPrior, settings: EstimatorSettings, *, seed: int
) -> Tube | None:
    """A robust circle about the axis, in a band at breast height (`core.robust.robust_circle`).

    Args:
        points: (N, 3) points, z from breast height, x and y near zero.
        start: From `search`.
        prior: Of the stem, for the axis.
        settings: Axis, band, tolerance.
        seed: Of the random samples.

    Returns:
        None where there is no circle.
    """
    if settings.axis == "vertical":
        axis: Tube | None = replace(start, slope=np.zeros(2))
    else:
        axis = fit_tube(points, start, prior, highest=1)
    if axis is None:
        return None
    at = axis.polar(points)
    band = np.abs(at.along) <= 0.5 * settings.band_m
    uv = np.stack([at.cos * at.distance, at.sin * at.distance], axis=1)[band]
    ring = robust_circle(
        uv,
        tolerance_m=settings.tolerance_m,
        max_radius_m=settings.max_diameter_cm / 200.0,
        rng=np.random.default_rng([seed, 202]),
        hint=Circle(np.zeros(2), axis.radius, axis.sigma),
    )
    if ring is None:
        return None
    u, v, _ = axis.frame()
    centre = axis.centre + ring.centre_m[0] * u[:2] + ring.centre_m[1] * v[:2]
    return replace(axis, centre=centre, radius=ring.radius_m, waves=np.empty(0))
