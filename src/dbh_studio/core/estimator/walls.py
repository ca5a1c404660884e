"""One radius and several walls: the shape of a stem whose passes are shifted against each other, fitted.

The points are taken as

    r(t) = R + c · n(t) + dₖ · n(t) + Σ aⱼ cos j t + bⱼ sin j t,   pass k, normal n(t),

with R and the waves of the stem alike for all passes, a shift dₖ of each, and the share of each pass in every sector of
the ring. It is fitted by expectation and maximisation: how likely every point is of each pass (Student's t, over a
floor of clutter), then radius, waves and shifts by weighted least squares with priors, the width of the noise, the
shares, and how large shifts are. One pass, two and three are fitted, from sectors that begin at several angles, all at
once. A patch of bark counts, not a point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.sample import sample_points
from dbh_studio.core.estimator.tube import Tube, cells_of, wave_basis

RADIUS, FIRST_WAVE, FIRST_SHIFT = 2, 3, 7
"""Where they are in the parameters: a common shift (2), radius, two waves (4), shifts of the passes (6)."""

MOST_PASSES = 3

_POINTS, _LEAST_POINTS = 800, 60
_GATE_M, _GATE = 0.06, 4.0  # from the tube, metres or standard deviations
_HIGHEST = 3  # wave
_SECTORS = 24
_SECTOR_RAD = (np.arange(_SECTORS) + 0.5) * (2 * np.pi / _SECTORS) - np.pi
_GAP_DEG = 40.0  # from which on passes begin at the gap
_STARTS = 3
_SOFT = 0.35  # width of the bounds between passes, relative to a pass
_ROUNDS = 15
_TAIL = 3.0  # degrees of freedom
_PEAK = 0.3675  # Student's t density at zero
_CLUTTER = 0.2  # per metre
_SHIFT_M, _SHIFT_WEIGHT = 0.02, 4.0
_LEAST_SIGMA_M, _MOST_SIGMA_M = 0.002, 0.04
_CENTRE, _RADIUS = 0.3, 0.2  # standard deviations relative to the radius


@dataclass(frozen=True, eq=False)
class Bark:
    """Points about the tube's axis.

    Attributes:
        basis: (7, N) cosine and sine, one, waves: what a shift, the radius and waves do to the distance.
        error: (N,) distance from the axis, less the radius of a round tube there.
        sector: (N,) of 24.
        weight: (N,) how much each counts; those of a patch together one.
        first: Angle at which passes may begin, radians.
        arc: That they cover, radians.
    """

    basis: Float64
    error: Float64
    sector: Int64
    weight: Float64
    first: float
    arc: float


@dataclass(frozen=True, eq=False)
class Walls:
    """H fits; the first of one pass.

    Attributes:
        found: (H, 13) common shift, radius, waves, shifts of passes.
        sigma: (H,) noise.
        evidence: (H,) logarithm.
        radius_sd: (H,).
        share: (H, 3) of the points.
        off: (H, N) distances of points to the likeliest wall.
    """

    found: Float64
    sigma: Float64
    evidence: Float64
    radius_sd: Float64
    share: Float64
    off: Float64


def bark_of(points: Float64, tube: Tube, gap_deg: float) -> Bark | None:
    """At most 800 points near the tube; None where there are hardly any."""
    at = tube.polar(points)
    near = np.flatnonzero(np.abs(at.distance - tube.surface(at)) < max(_GATE * tube.sigma, _GATE_M))
    if len(near) < _LEAST_POINTS:
        return None
    near = near[sample_points(points[near], _POINTS, seed=0)]
    cos, sin, distance, along = at.cos[near], at.sin[near], at.distance[near], at.along[near]
    angle = np.arctan2(sin, cos)
    sector = ((angle + np.pi) * (_SECTORS / (2 * np.pi))).astype(np.int64) % _SECTORS
    cell, n_cells = cells_of(angle, along, tube.radius, len(near))
    first, arc = -np.pi, 2 * np.pi
    if gap_deg >= _GAP_DEG:
        on = np.sort(angle[np.abs(distance - tube.surface(at)[near]) < 3.0 * tube.sigma])
        if len(on) > 1:
            steps = np.diff(np.append(on, on[0] + 2 * np.pi))
            widest = int(steps.argmax())
            first, arc = float(on[(widest + 1) % len(on)]), float(2 * np.pi - steps[widest])
    basis = np.concatenate([np.stack([cos, sin, np.ones_like(cos)]), wave_basis(cos, sin, _HIGHEST)])
    error = distance - (tube.radius - tube.taper * along)
    return Bark(basis, error, sector, 1.0 / np.bincount(cell, minlength=n_cells)[cell], first, arc)


def _starts(bark: Bark) -> Float64:
    """(H, 3, 24) shares of passes by sector to begin with: one pass, then two and three in turn about the ring."""
    starts = [np.zeros((MOST_PASSES, _SECTORS))]
    starts[0][0] = 1.0
    for n_passes in range(2, MOST_PASSES + 1):
        turns = np.arange(_STARTS) * (2 * np.pi / (_STARTS * n_passes)) if bark.arc > 6.28 else np.zeros(1)
        for turn in turns:
            place = (_SECTOR_RAD - bark.first - turn) % (2 * np.pi) * (n_passes / bark.arc)
            place = np.minimum(place, n_passes)[None] - np.arange(1, n_passes)[:, None]
            # The logistic curve in place of the normal distribution's.
            beyond = 1.0 / (1.0 + np.exp(-1.702 * place / _SOFT))
            edges = np.concatenate([np.ones((1, _SECTORS)), beyond, np.zeros((MOST_PASSES - n_passes + 1, _SECTORS))])
            starts.append(edges[:-1] - edges[1:])
    return np.stack(starts)


def walls_of(bark: Bark, tube: Tube, prior: StemPrior) -> Walls:
    """All fits, side by side."""
    starts = _starts(bark)
    is_there = (starts.max(axis=2) > 0.0).astype(np.float64)  # (H, 3)
    n_fits, n_passes = len(starts), is_there.sum(axis=1)
    basis, n_points = bark.basis, len(bark.error)
    squares = np.ascontiguousarray((basis[:, None] * basis[None]).reshape(-1, n_points).T)
    target = np.ascontiguousarray((basis * bark.error).T)
    precision = _precision(tube, prior, n_fits)
    share: Float64 = (0.9 * starts + 0.1 / n_passes[:, None, None]) * is_there[:, :, None]
    found = np.zeros((n_fits, precision.shape[1]))
    n_known = min(len(tube.waves), FIRST_SHIFT - FIRST_WAVE)
    found[:, FIRST_WAVE : FIRST_WAVE + n_known] = tube.waves[:n_known]
    sigma = np.full(n_fits, max(0.8 * tube.sigma, 0.003))
    key = (np.arange(n_fits * MOST_PASSES)[:, None] * _SECTORS + bark.sector).ravel()
    off = _off(bark, found)
    for turn in range(_ROUNDS):
        wide = 1.0 + (off / sigma[:, None, None]) ** 2 / _TAIL
        density = share[:, :, bark.sector] * (_PEAK / (wide * wide)) / sigma[:, None, None]
        total = density.sum(axis=1) + _CLUTTER
        of_pass = density / total[:, None]
        held = of_pass * bark.weight
        weight = held * ((_TAIL + 1.0) / _TAIL) / wide
        normal, right = _normal(weight, squares, target, sigma, precision)
        found = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
        off = _off(bark, found)
        sigma = np.sqrt((weight * off**2).sum(axis=(1, 2)) / held.sum(axis=(1, 2)))
        sigma = np.clip(sigma, _LEAST_SIGMA_M, _MOST_SIGMA_M)
        count = np.bincount(key, of_pass.ravel(), len(starts) * MOST_PASSES * _SECTORS).reshape(starts.shape)
        beside = np.roll(count, 1, axis=2) + np.roll(count, -1, axis=2)
        share = (count + 0.5 * beside + 2.0 * starts + 0.2) * is_there[:, :, None]
        share /= share.sum(axis=1, keepdims=True)
        if turn >= 3:  # how large the shifts are, once they are known at all
            square = (found[:, FIRST_SHIFT:] ** 2).sum(axis=1)
            usual = (_SHIFT_WEIGHT * _SHIFT_M**2 + square) / (_SHIFT_WEIGHT + 2.0 * n_passes)
            precision[:, FIRST_SHIFT:] = 1.0 / usual[:, None]
    evidence = (np.log(total) * bark.weight).sum(axis=1) - 0.5 * (precision * found**2).sum(axis=1)
    evidence = evidence - 0.5 * np.linalg.slogdet(normal)[1] + 0.5 * np.log(precision).sum(axis=1)
    radius_sd = np.sqrt(np.linalg.inv(normal)[:, RADIUS, RADIUS])
    nearest = np.take_along_axis(off, of_pass.argmax(axis=1)[:, None], axis=1)[:, 0]
    counted = of_pass.sum(axis=2)
    return Walls(found, sigma, evidence, radius_sd, counted / counted.sum(axis=1, keepdims=True), nearest)


def _precision(tube: Tube, prior: StemPrior, n_fits: int) -> Float64:
    """(H, 13) inverse variances of common shift, radius, waves and shifts."""
    place = [(_CENTRE * tube.radius) ** -2.0] * RADIUS + [(_RADIUS * tube.radius) ** -2.0]
    waves = prior.precision(tube.radius, _HIGHEST)[-2 * (_HIGHEST - 1) :]
    return np.tile(np.concatenate([place, waves, np.full(2 * MOST_PASSES, _SHIFT_M**-2.0)]), (n_fits, 1))


def _off(bark: Bark, found: Float64) -> Float64:
    """(H, 3, N) how far points are outside each pass's wall."""
    shifts = found[:, FIRST_SHIFT:].reshape(-1, MOST_PASSES, 2)
    off: Float64 = (bark.error - found[:, :FIRST_SHIFT] @ bark.basis)[:, None] - shifts @ bark.basis[:2]
    return off


def _normal(
    weight: Float64, squares: Float64, target: Float64, sigma: Float64, precision: Float64
) -> tuple[Float64, Float64]:
    """(H, 13, 13) normal matrices and (H, 13) right sides, of (H, 3, N) weights."""
    n_fits, n_params = precision.shape
    rows = weight.reshape(-1, weight.shape[-1]) / np.repeat(sigma**2, MOST_PASSES)[:, None]
    block = (rows @ squares).reshape(n_fits, MOST_PASSES, FIRST_SHIFT, FIRST_SHIFT)
    pull = (rows @ target).reshape(n_fits, MOST_PASSES, FIRST_SHIFT)
    normal, right = np.zeros((n_fits, n_params, n_params)), np.zeros((n_fits, n_params))
    normal[:, :FIRST_SHIFT, :FIRST_SHIFT], right[:, :FIRST_SHIFT] = block.sum(axis=1), pull.sum(axis=1)
    for k in range(MOST_PASSES):
        own = slice(FIRST_SHIFT + 2 * k, FIRST_SHIFT + 2 * k + 2)
        normal[:, :FIRST_SHIFT, own], normal[:, own, :FIRST_SHIFT] = block[:, k, :, :2], block[:, k, :2, :]
        normal[:, own, own], right[:, own] = block[:, k, :2, :2], pull[:, k, :2]
    normal[:, np.arange(n_params), np.arange(n_params)] += precision
    return normal, right
