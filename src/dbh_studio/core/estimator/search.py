"""Where the stem is among leaves, stubs, ground and neighbours: several rings are tried and the likeliest is taken.

Three-point circles in slices of the stem start leaning tubes, all refined at once; a tube is judged by the likelihood
of all points under "a noisy ring and, everywhere else, clutter, but hardly any inside, for stems are opaque".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int64, readonly
from dbh_studio.core.medians import quantiles
from dbh_studio.core.robust import circumcircles

_SLICES = 5
_HYPOTHESES = 80  # per slice
_SLICE_POINTS = 220
_POINTS = 700
_KEPT_PER_SLICE = 3
_FINALISTS, _CANDIDATES = 5, 10
_REACHES_M = np.array([0.12, 0.3, 0.7, np.inf])
_TOLERANCES_M = (0.012, 0.03)
_N_BINS = 24
_INSIDE = 0.05  # density of clutter inside a stem, relative to outside
_LEAN_SD = 0.12
_OPAQUE = -3.5  # standard deviations below the surface from which on it is inside
_SMALLEST_M = 0.01
_APART = 0.8  # of the sum of their radii: nearer, two rings are two readings of one stem


@dataclass(frozen=True, eq=False)
class Rings:
    """H leaning rings.

    Attributes:
        centre: (H, 2) at height `h0`.
        slope: (H, 2) horizontal metres per metre of height.
        radius: (H,) at breast height.
        sigma: (H,) standard deviation of their points.
        h0: (H,) height the centre belongs to.
    """

    centre: Float64
    slope: Float64
    radius: Float64
    sigma: Float64
    h0: Float64

    def at(self, rows: Int64 | slice) -> Rings:
        """Some of them."""
        return Rings(self.centre[rows], self.slope[rows], self.radius[rows], self.sigma[rows], self.h0[rows])

    def middles(self) -> Float64:
        """(H, 2) centres at breast height."""
        return self.centre - self.slope * self.h0[:, None]


class Search(NamedTuple):
    """The likeliest rings, best first, and what two of them together would explain.

    Attributes:
        rings: H of them; none where nothing is round.
        score: (H,) log-likelihood of all points, one stem supposed.
        pair: Rows of the two that are likeliest as two stems beside each other; None where no two are apart.
        gain: Log-likelihood of the two together, less that of the likeliest one, per point.
    """

    rings: Rings
    score: Float64
    pair: tuple[int, int] | None
    gain: float


def find_rings(points: Float64, *, widest_m: float, taper: float, rng: np.random.Generator) -> tuple[Rings, Float64]:
    """The likeliest rings, best first, and their log-likelihoods; none where nothing is round.

    Args:
        points: (N, 3) points, z from breast height, x and y near zero.
        widest_m: Largest radius considered.
        taper: Expected loss of radius, metres per metre, of stems thicker than 30 cm.
        rng: Source of the samples.
    """
    found = search_rings(points, widest_m=widest_m, taper=taper, rng=rng)
    return found.rings, found.score


def search_rings(points: Float64, *, widest_m: float, taper: float, rng: np.random.Generator) -> Search:
    """As `find_rings`, and whether two rings beside each other explain the points better than any one.

    Where two thin stems touch, a wide ring round both may be likelier than either of them alone. So the two compete
    with it together.
    """
    low, high = quantiles(points[:, 2], (0.01, 0.99))
    window = (max(low, -0.40), min(high, 0.50))
    start = _starts(points, window, widest_m, rng)
    if not len(start):
        nothing = np.empty(0)
        none = Rings(np.empty((0, 2)), np.empty((0, 2)), nothing, nothing, nothing)
        return Search(none, nothing, None, 0.0)
    near = points[(points[:, 2] >= window[0]) & (points[:, 2] <= window[1])]
    used = near if len(near) >= 60 else points
    used = used if len(used) <= _POINTS else used[rng.permutation(len(used))[:_POINTS]]
    some = used[: len(used) if len(used) < 60 else max(60, len(used) // 2)]
    sigma = np.minimum(0.025, 0.25 * start[:, 2] + 0.003)
    rings = Rings(start[:, :2], np.zeros((len(start), 2)), start[:, 2], sigma, start[:, 3])
    rings = _refined(rings, some, (0.10, 0.14, 0.2, 0.3), widest_m, taper)
    area = _box_area(used[:, 0], used[:, 1])
    told = _densities(rings, some, taper)
    ranked = _distinct(rings, np.argsort(-_likelihood(told, area), kind="stable"), _CANDIDATES)
    best = ranked[:_FINALISTS]
    pair, _ = _best_pair(rings.at(ranked), told.at(ranked), area)
    if pair is not None:
        best = np.array([*best, *(ranked[row] for row in pair if row >= _FINALISTS)])
    rings = _refined(rings.at(best), used, (0.3, 0.45, np.inf, np.inf, np.inf), widest_m, taper)
    told = _densities(rings, used, taper)
    score = _likelihood(told, area)
    order = np.argsort(-score, kind="stable")
    order = _distinct(rings, order[np.isfinite(score[order])], len(order))
    rings, score = rings.at(order), score[order]
    pair, together = _best_pair(rings, told.at(order), area)
    return Search(rings, score, pair, 0.0 if pair is None else (together - float(score[0])) / len(used))


def _distinct(rings: Rings, order: Int64, n_most: int) -> Int64:
    """The first rows of an order that are not the same ring as one before."""
    place = np.column_stack([rings.middles(), rings.radius])[order]
    apart = np.abs(place[:, None] - place).sum(axis=2)
    is_other = apart > 0.1 * np.minimum(place[:, 2, None], place[:, 2])
    left = np.ones(len(order), bool)
    kept: list[int] = []
    for at in range(len(order)):
        if left[at]:
            kept.append(at)
            if len(kept) == n_most:
                break
            left &= is_other[at]
    return order[kept]


def _starts(points: Float64, window: tuple[float, float], widest_m: float, rng: np.random.Generator) -> Float64:
    """(H, 4) x, y, radius and height of distinct circles in the slices."""
    edges = np.linspace(*window, _SLICES + 1)
    found = []
    for low, high in pairwise(edges):
        piece = points[(points[:, 2] >= low) & (points[:, 2] < high), :2]
        if len(piece) < 12:
            continue
        if len(piece) > _SLICE_POINTS:
            piece = piece[rng.integers(0, len(piece), _SLICE_POINTS)]
        circles = _slice_circles(piece, _HYPOTHESES, widest_m, rng)
        found.append(np.column_stack([circles, np.full(len(circles), 0.5 * (low + high))]))
    if not any(len(circles) for circles in found):  # too few per slice: all of them as one
        piece = points[rng.permutation(len(points))[:250], :2]
        circles = _slice_circles(piece, _SLICES * _HYPOTHESES, widest_m, rng)
        found = [np.column_stack([circles, np.zeros(len(circles))])]
    return np.concatenate(found)


def _slice_circles(xy: Float64, n_hypotheses: int, widest_m: float, rng: np.random.Generator) -> Float64:
    """(<= 3, 3) x, y and radius of the best circles that differ.

    The other two points of a triple are drawn near the first, at several reaches: in a slice with three neighbours a
    triple from anywhere is hardly ever of one stem.
    """
    x, y = xy.T
    first = rng.integers(0, len(xy), n_hypotheses)
    others = rng.integers(0, len(xy), (n_hypotheses, 10))
    apart = (x[others] - x[first][:, None]) ** 2 + (y[others] - y[first][:, None]) ** 2
    far = apart > (_REACHES_M[np.arange(n_hypotheses) % len(_REACHES_M)] ** 2)[:, None]
    pair = np.argsort(far, axis=1, kind="stable")[:, :2]
    second, third = others[np.arange(n_hypotheses), pair.T]
    centres, radii = circumcircles(np.stack([xy[first], xy[second], xy[third]], axis=1))
    circles = np.column_stack([centres, radii])
    # A radius that is finite is that of a finite centre.
    circles = circles[(radii > _SMALLEST_M) & (radii < widest_m)]
    if not len(circles):
        return circles
    ranked = circles[np.argsort(-_slice_score(x, y, circles), kind="stable")]
    # Numbers, not arrays of three: most of the time would go into taking these apart.
    best, *rest = ranked[:40].tolist()
    kept = [best]
    for circle in rest:
        if all(_apart(circle, other) > 0.3 * min(circle[2], other[2]) for other in kept):
            kept.append(circle)
            if len(kept) == _KEPT_PER_SLICE:
                break
    # And one beside the best, for it may be another stem's.
    beside = np.hypot(*(ranked[:, :2] - ranked[0, :2]).T) > _APART * (ranked[:, 2] + ranked[0, 2])
    if beside.any() and not any(_is_beside(circle, best) for circle in kept[1:]):
        kept[_KEPT_PER_SLICE - 1 :] = [ranked[int(beside.argmax())].tolist()]
    return np.array(kept)


def _apart(one: list[float], other: list[float]) -> float:
    return math.hypot(one[0] - other[0], one[1] - other[1]) + abs(one[2] - other[2])


def _is_beside(one: list[float], other: list[float]) -> bool:
    return math.hypot(one[0] - other[0], one[1] - other[1]) > _APART * (one[2] + other[2])


def _slice_score(x: Float64, y: Float64, circles: Float64) -> Float64:
    """(H,) support of the circles (MSAC), less the points inside, made comparable between small and large circles."""
    radius = circles[:, 2:]
    error, off = x - circles[:, :1], y - circles[:, 1:2]
    # In place from here on: of arrays of this size new memory costs as much as the sum.
    error *= error
    off *= off
    error += off
    np.sqrt(error, out=error)
    error -= radius
    area = _box_area(x, y)
    score = np.full(len(circles), -np.inf)
    for tolerance in _TOLERANCES_M:
        width = np.minimum(tolerance, 0.25 * radius + 0.004)
        ratio = np.divide(error, width, out=off)
        inside = (ratio < -2.5).sum(axis=1)
        ratio *= ratio
        np.subtract(1.0, ratio, out=ratio)
        np.maximum(ratio, 0.0, out=ratio)
        rarity = 1.0 + np.log1p(area / (4 * np.pi * radius * width))[:, 0]
        score = np.maximum(score, (ratio.sum(axis=1) - 0.5 * inside) * rarity)
    return score


def _box_area(x: Float64, y: Float64) -> float:
    (west, east), (south, north) = quantiles(x, (0.04, 0.96)), quantiles(y, (0.04, 0.96))
    return (east - west + 0.2) * (north - south + 0.2)


def offsets(rings: Rings, points: Float64, taper: float) -> tuple[Float64, Float64, Float64, Float64]:
    """(H, N) arrays: height over the rings' own, unit vector outwards (x, y), distance to their surface."""
    x, y, z = points.T
    height = z - rings.h0[:, None]
    dx = x - rings.centre[:, :1] - rings.slope[:, :1] * height
    dy = y - rings.centre[:, 1:] - rings.slope[:, 1:] * height
    distance = dx * dx
    distance += dy * dy
    np.sqrt(distance, out=distance)
    distance += 1e-9
    dx /= distance
    dy /= distance
    distance -= rings.radius[:, None]
    distance += (0.8 * taper * np.minimum(1.0, rings.radius / 0.15))[:, None] * z
    return height, dx, dy, distance


def _refined(rings: Rings, points: Float64, reaches: tuple[float, ...], widest_m: float, taper: float) -> Rings:
    """Robust Gauss-Newton on centre, slope and radius of all rings, with ever more of the stem."""
    centre, slope, radius, sigma = rings.centre, rings.slope, rings.radius, rings.sigma
    for reach in reaches:
        now = Rings(centre, slope, radius, sigma, rings.h0)
        height, out_x, out_y, error = offsets(now, points, taper)
        weight = _falling(error, (4.2 * sigma)[:, None])
        weight *= weight
        if np.isfinite(reach):
            weight *= _falling(height, 1.5 * reach)
        total = weight.sum(axis=1) + 1e-9
        spread = 1.5 * np.matmul(weight[:, None], np.abs(error)[..., None])[:, 0, 0] / total
        sigma = np.minimum(np.maximum(spread, 0.003), np.minimum(0.04, 0.2 * radius + 0.003))
        design = np.empty((len(radius), 5, len(points)))
        design[:, 0], design[:, 1], design[:, 4] = out_x, out_y, 1.0
        np.multiply(design[:, :2], height[:, None], out=design[:, 2:4])
        step = _step(slope, sigma, weight, total, design, error)
        aside, ahead, _, _, wider = np.abs(step.T)
        step *= np.minimum(1.0, 0.3 * radius / (np.maximum(np.maximum(aside, ahead), wider) + 1e-9))[:, None]
        centre = centre + step[:, :2]
        tilt = np.minimum(np.maximum(step[:, 2:4], -0.25), 0.25)
        slope = np.minimum(np.maximum(slope + tilt, -0.6), 0.6)
        radius = np.minimum(np.maximum(radius + step[:, 4], 0.5 * _SMALLEST_M), 1.2 * widest_m)
    return Rings(centre, slope, radius, sigma, rings.h0)


def _falling(distance: Float64, width: float | Float64) -> Float64:
    """1 at zero, falling with the square of (H, N) distances to 0 at the width and beyond."""
    weight = distance / width
    weight *= weight
    np.subtract(1.0, weight, out=weight)
    return np.maximum(weight, 0.0, out=weight)


def _step(slope: Float64, sigma: Float64, weight: Float64, total: Float64, design: Float64, error: Float64) -> Float64:
    """(H, 5) Gauss-Newton steps from (H, 5, N) derivatives, with a prior of upright stems."""
    normal = np.matmul(design * weight[:, None], design.transpose(0, 2, 1))
    ridge = np.array([1e-4, 1e-4, 0.0, 0.0, 1e-4]) * total[:, None] + 1e-9
    ridge[:, 2:4] += (3.0 * sigma**2 / _LEAN_SD**2)[:, None]
    normal[:, np.arange(5), np.arange(5)] += ridge
    pull = np.matmul(design, (weight * error)[..., None])[..., 0]
    pull[:, 2:4] -= ridge[:, 2:4] * slope
    step: Float64 = np.linalg.solve(normal, pull[..., None])[..., 0]
    return step


class _Densities(NamedTuple):
    """What H rings say of N points.

    Attributes:
        ring: (H, N) density, if all points were the ring's.
        ratio: (H, N) distance to the ring, in standard deviations.
        n_on: (H,) how many points are on it.
    """

    ring: Float64
    ratio: Float64
    n_on: Int64

    def at(self, rows: Int64) -> _Densities:
        """Of some of the rings."""
        return _Densities(self.ring[rows], self.ratio[rows], self.n_on[rows])


def _densities(rings: Rings, points: Float64, taper: float) -> _Densities:
    _, out_x, out_y, error = offsets(rings, points, taper)
    sigma = np.maximum(rings.sigma, 0.004)[:, None]
    ratio = error / sigma
    on: Bool = np.abs(ratio) < 3.0
    n_on = on.sum(axis=1)
    sector = ((np.arctan2(out_y, out_x) + np.pi) * (_N_BINS / (2 * np.pi))).astype(np.int64)
    sector[sector == _N_BINS] = 0
    sector += _N_BINS * np.arange(len(n_on))[:, None]
    share = np.bincount(sector[on], minlength=_N_BINS * len(n_on)).reshape(-1, _N_BINS) + 0.2
    share = share / share.sum(axis=1, keepdims=True)
    # The arc that is really covered: a ring only explains what lies where its points are.
    arc_m = np.exp(-(share * np.log(share)).sum(axis=1)) * (2 * np.pi / _N_BINS) * rings.radius
    return _Densities(np.exp(-0.5 * ratio * ratio) / (2.5066 * sigma * arc_m[:, None]), ratio, n_on)


def _likelihood(told: _Densities, area: float) -> Float64:
    """(H,) log-likelihood of all points; -inf for a ring of fewer than ten."""
    share = (told.n_on / told.ratio.shape[1])[:, None]
    clutter = np.where(told.ratio < _OPAQUE, _INSIDE, 1.0) * (1.02 - share) / area
    return np.where(told.n_on >= 10, np.log(share * told.ring + clutter).sum(axis=1), -np.inf)


@lru_cache(maxsize=32)
def _pairs(n_rings: int) -> tuple[Int64, Int64]:
    """Rows of all pairs."""
    one, other = np.triu_indices(n_rings, 1)
    return readonly(one), readonly(other)


def _best_pair(rings: Rings, told: _Densities, area: float) -> tuple[tuple[int, int] | None, float]:
    """The two rings, apart from each other, that explain the points best together, and their log-likelihood."""
    one, other = _pairs(len(rings.radius))
    place = rings.middles()
    apart = np.hypot(*(place[one] - place[other]).T) > _APART * (rings.radius[one] + rings.radius[other])
    fit = apart & (np.minimum(told.n_on[one], told.n_on[other]) >= 10)
    if not fit.any():
        return None, -np.inf
    one, other = one[fit], other[fit]
    off, off_other = np.abs(told.ratio[one]), np.abs(told.ratio[other])
    # A point on both counts for the nearer: else a small ring laid over a stretch of bark would count it twice.
    share = ((off < 3.0) & (off <= off_other)).mean(axis=1)[:, None]
    share_other = ((off_other < 3.0) & (off_other < off)).mean(axis=1)[:, None]
    inside = (told.ratio[one] < _OPAQUE) | (told.ratio[other] < _OPAQUE)
    clutter = np.where(inside, _INSIDE, 1.0) * (1.02 - share - share_other) / area
    score = np.log(share * told.ring[one] + share_other * told.ring[other] + clutter).sum(axis=1)
    best = int(score.argmax())
    return (int(one[best]), int(other[best])), float(score[best])
