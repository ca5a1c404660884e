"""A tube through the points, by iteratively reweighted least squares with priors.

Three things keep what is not bark, or not where the bark is, from moving the radius:

- weights that fall to zero (Tukey) follow the *mode* of the distances. A thick outer tail, of matches that float in
  front of the bark, shifts the mean and hardly the mode;
- the width of the noise is taken from the points inside the median surface alone: clutter and tails lie outside;
- patches of bark count, not points (`tube.cells_of`): the side that is seen a hundred times better does not decide
  alone;
- a point is held against the place on the bark that its error came from (`viewing`), which for what is seen at a
  grazing angle is not the nearest one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.tube import Polar, Tube, cells_of, tukey
from dbh_studio.core.estimator.viewing import OnBark, on_bark, viewing_of
from dbh_studio.core.medians import median

CUT = 3.0
"""Tukey's weights end at so many standard deviations."""

DRIFT = 0.02
"""How much the shape of a section changes along a metre of stem, relative to its radius."""

_SHARED_M = 0.003  # error that a patch's points share
_LEAST_POINTS = 12
_STILL_M = 3e-4


@dataclass(frozen=True, eq=False)
class Near:
    """Points near a tube's surface: where they are, and how far outside it."""

    at: Polar
    error: Float64
    sigma: float


def fit_tube(points: Float64, start: Tube, prior: StemPrior, *, highest: int = 4) -> Tube | None:
    """The tube through most points: first an oval about breast height, then `highest` waves along all of the stem.

    Args:
        points: (N, 3) points, z from breast height, x and y near zero.
        start: From `search`, without waves.
        prior: Of the stem.
        highest: Order of the last wave; 1 for a round tube.

    Returns:
        None where fewer than ten points stay on it.
    """
    tube, viewing = replace(start, taper=float(prior.mean_taper(start.radius))), None
    for reach, rounds, order in ((0.30, 4, min(2, highest)), (np.inf, 6, highest)):
        window = points[np.abs(points[:, 2]) <= reach]
        if len(window) < 20:
            continue
        tube = replace(tube, waves=_padded(tube.waves, order))
        for turn in range(rounds):
            near = near_surface(window, tube)
            if near is None:
                return None
            if turn % 2 == 0:  # that changes little from step to step, and takes as long as a step
                viewing = viewing_of(near.at, near.error, near.sigma)
            bark = on_bark(near.at, near.error, tube, viewing)
            moved = _improved(bark, near.sigma, tube, prior, order, cut=CUT if turn else 1.3 * CUT)
            if moved is None:
                return None
            step = float(np.hypot(*(moved.centre - tube.centre)))
            still = step < _STILL_M and abs(moved.radius - tube.radius) < _STILL_M and turn >= 2
            tube = moved
            if still:
                break
    return tube


def near_surface(points: Float64, tube: Tube) -> Near | None:
    """The points that may be bark, and the width of their noise; None where there are hardly any."""
    at = tube.polar(points)
    gate = min(max(0.06, 3.0 * tube.sigma), 0.45 * tube.radius + 0.01)
    rough = np.abs(at.distance + tube.taper * at.along - tube.radius) < gate + 0.12 * tube.radius
    if rough.sum() < _LEAST_POINTS:
        return None
    at = at.part(rough)
    error = at.distance - tube.surface(at)
    sigma = _inner_sigma(error[np.flatnonzero(np.abs(error) < gate)], tube.radius)
    return None if sigma is None else Near(at, error, sigma)


def _inner_sigma(error: Float64, radius: float) -> float | None:
    if len(error) < _LEAST_POINTS:
        return None
    half = len(error) // 2
    parted = np.partition(error, half)
    inner, middle = parted[:half], float(parted[half])
    if len(error) % 2 == 0:
        middle = 0.5 * (float(inner.max()) + middle)
    inner = inner[inner < middle]
    sigma = 1.4826 * (middle - median(inner)) if len(inner) > 5 else 0.02
    return min(max(sigma, 0.002), 0.045, 0.25 * radius + 0.003)


def _improved(bark: OnBark, sigma: float, tube: Tube, prior: StemPrior, highest: int, *, cut: float) -> Tube | None:
    """One weighted least-squares step; None where too few points are left."""
    weight = tukey(bark.error, cut * sigma * np.sqrt(bark.variance))
    n_on = int((weight > 0.1).sum())
    if n_on < 10:
        return None
    at = bark.at
    cell, n_cells = cells_of(at.angle(), at.along, tube.radius, n_on)
    crowd = np.bincount(cell, weight, n_cells)[cell] + 1e-9
    shared = _SHARED_M**2 * bark.variance + (DRIFT * tube.radius * at.along) ** 2
    weight = weight / (crowd * shared + sigma**2 * bark.variance)
    design = at.design(highest)
    weighted = design * weight
    precision = prior.precision(tube.radius, highest)
    normal = weighted @ design.T
    normal.flat[:: len(normal) + 1] += precision + 1e-6
    u, v, _ = tube.frame()
    target = weighted @ at.distance
    target[2] -= precision[2] * (tube.slope @ u[:2])
    target[3] -= precision[3] * (tube.slope @ v[:2])
    target[5] += precision[5] * prior.mean_taper(tube.radius)
    return _moved(tube, np.asarray(np.linalg.solve(normal, target), np.float64), sigma)


def _moved(tube: Tube, found: Float64, sigma: float) -> Tube:
    """The tube with the parameters found, held back where a step is too long to be trusted."""
    u, v, _ = tube.frame()
    shift, tilt = found[:2], np.clip(found[2:4], -0.2, 0.2)
    length = float(np.hypot(*shift))
    if length > 0.4 * tube.radius:
        shift = shift * (0.4 * tube.radius / length)
    return Tube(
        tube.centre + shift[0] * u[:2] + shift[1] * v[:2],
        np.clip(tube.slope + tilt[0] * u[:2] + tilt[1] * v[:2], -0.6, 0.6),
        float(np.clip(found[4], max(0.008, 0.6 * tube.radius), 1.6 * tube.radius)),
        float(found[5]),
        found[6:],
        sigma,
    )


def _padded(waves: Float64, highest: int) -> Float64:
    return np.concatenate([waves, np.zeros(max(0, 2 * (highest - 1) - len(waves)))])
