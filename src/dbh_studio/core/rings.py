"""Circles in many small sets of points at once: RANSAC and Gauss-Newton, batched over the sets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float32, Float64, Int32

N_SECTORS = 24
_N_SAMPLE = 128
_N_TRIALS = 96
# Sets handled together, so that what is computed for each of their trials or points stays within some megabytes.
_BATCH = 400
# Circles compared with all points of their sets together: these arrays then stay in the processor's own memory, which
# is several times quicker than writing them out and reading them back.
_CIRCLES_IN_CACHE = 384


@dataclass(frozen=True, eq=False)
class Rings:
    """Circles found, one row each.

    Attributes:
        group: (K,) which set it was found in.
        xy: (K, 2) centre.
        radius: (K,)
        coverage_deg: (K,) how much of the circle has points on it.
        n_on: (K,) points on it, of at most 128 drawn from the set.
        inside_share: (K,) points well inside, relative to those on it: a stem's surface is hollow.
        clutter_share: (K,) points just outside, relative to those on it.
    """

    group: Int32
    xy: Float64
    radius: Float64
    coverage_deg: Float64
    n_on: Int32
    inside_share: Float64
    clutter_share: Float64

    def __len__(self) -> int:
        return len(self.group)

    def subset(self, rows: NDArray[Any]) -> Rings:
        """The rings at `rows` (integers or a mask)."""
        return Rings(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @classmethod
    def joined(cls, parts: list[Rings]) -> Rings:
        """All rings of several results."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


def find_rings(
    xy: NDArray[Any],
    group: NDArray[Any],
    *,
    radius_min: float,
    radius_max: float,
    tolerance: float,
    n_rounds: int = 2,
    seed: int = 0,
) -> Rings:
    """The best circle of every set, then the best among what it leaves over, and so on.

    Args:
        xy: (N, 2) points.
        group: (N,) the set each belongs to, 0…G-1.
        radius_min: Of the circles considered.
        radius_max: Of the circles considered.
        tolerance: Distance to the circle at which a point stops counting; grows by 5 % of the radius, as stems are not
            quite round.
        n_rounds: Circles sought per set (two stems may touch).
        seed: Of the random samples.

    Returns:
        All circles found, good and bad: judging them is the caller's.
    """
    if not len(xy):
        nothing = np.empty(0)
        return Rings(np.empty(0, np.int32), np.empty((0, 2)), nothing, nothing, np.empty(0, np.int32), nothing, nothing)
    rng = np.random.default_rng(seed)
    sample, real, names = _padded_samples(xy, group, rng)
    found: list[Rings] = []
    for start in range(0, len(sample), _BATCH):
        points, left = sample[start : start + _BATCH], real[start : start + _BATCH].copy()
        batch_names = names[start : start + _BATCH]
        for _ in range(n_rounds):
            rings, on = _best_rings(points, left, batch_names, radius_min, radius_max, tolerance, rng)
            found.append(rings)
            left &= ~on
            more = left.sum(axis=1) >= 8
            points, left, batch_names = points[more], left[more], batch_names[more]
            if not len(points):
                break
    rings = Rings.joined(found)
    return rings.subset(np.isfinite(rings.radius) & (rings.n_on >= 5))


def _padded_samples(xy: NDArray[Any], group: NDArray[Any], rng: np.random.Generator) -> tuple[Float32, Bool, Int32]:
    """(G, P, 2) at most P random points of each set, (G, P) which are real, (G,) the sets' numbers."""
    # One sum as the key in place of two keys: an order within the sets at random, several times quicker.
    order = np.argsort(group + rng.random(len(xy)))
    ranked = group[order]
    start = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    names, count = ranked[start], np.diff(start, append=len(ranked))
    rank = np.arange(len(xy)) - np.repeat(start, count)
    row = np.repeat(np.arange(len(names)), count)
    kept = rank < _N_SAMPLE
    sample = np.zeros((len(names), min(_N_SAMPLE, int(count.max())), 2), np.float32)
    real = np.zeros(sample.shape[:2], bool)
    # Centred, so that float32 is exact to micrometres wherever the plot lies.
    sample[row[kept], rank[kept]] = xy[order[kept]]
    real[row[kept], rank[kept]] = True
    return sample, real, names.astype(np.int32)


def refit_rings(
    xy: NDArray[Any],
    group: NDArray[Any],
    centres: Float64,
    radii: Float64,
    *,
    tolerance: float,
    seed: int = 0,
) -> tuple[Rings, Float64]:
    """Fit every set's circle again, starting from a guess.

    Args:
        xy: (N, 2) points.
        group: (N,) the set each belongs to, 0…G-1.
        centres: (G, 2) guesses.
        radii: (G,) guesses.
        tolerance: As in `find_rings`.
        seed: Of the random samples.

    Returns:
        One ring for each set that has points, and (K,) the median distance of the points on it to it (infinite where
        none are).
    """
    sample, real, names = _padded_samples(xy, group, np.random.default_rng(seed))
    centre, radius = centres[names].astype(np.float64), radii[names].astype(np.float64)
    local = sample - centre[:, None, :].astype(np.float32)
    start = np.zeros_like(centre)
    for _ in range(6):
        start, radius = _gauss_newton(local, real, start, radius, tolerance)
    rings, on = _judged(local, real, names, start, radius, tolerance)
    gap = np.abs(np.hypot(*(local - start[:, None, :]).transpose(2, 0, 1)) - radius[:, None])
    # The median by sorting, points off the circle last: `nanmedian` would loop over the sets.
    ranked = np.sort(np.where(on, gap, np.inf), axis=1)
    typical = ranked[np.arange(len(names)), np.maximum(on.sum(axis=1) - 1, 0) // 2]
    return replace(rings, xy=rings.xy + centre), typical


def _best_rings(
    points: Float32,
    real: Bool,
    names: Int32,
    radius_min: float,
    radius_max: float,
    tolerance: float,
    rng: np.random.Generator,
) -> tuple[Rings, Bool]:
    """The best circle of each of (G, P, 2) sets, and the (G, P) points it takes away."""
    middle = (points * real[:, :, None]).sum(axis=1) / np.maximum(real.sum(axis=1), 1)[:, None]
    local = points - middle[:, None, :]
    xy, radius = _random_circles(local, real, rng)
    radius = np.where((radius >= radius_min) & (radius <= radius_max), radius, np.nan)
    row = np.arange(len(local))
    best = _scores(local, real, xy, radius, tolerance).argmax(axis=1)
    centre, size = xy[row, best].astype(np.float64), radius[row, best].astype(np.float64)
    centre = np.where(np.isfinite(size)[:, None], centre, 0.0)
    for _ in range(6):
        centre, size = _gauss_newton(local, real, centre, size, tolerance)
    size = np.where((size >= 0.9 * radius_min) & (size <= 1.1 * radius_max), size, np.nan)
    rings, taken = _judged(local, real, names, centre, size, tolerance)
    return replace(rings, xy=rings.xy + middle), taken


def _judged(
    local: Float32, real: Bool, names: Int32, centre: Float64, radius: Float64, tolerance: float
) -> tuple[Rings, Bool]:
    """The circles with what speaks for and against them, and the (G, P) points on or inside them."""
    offset = local - centre[:, None, :]
    width = _width(radius, tolerance)[:, None]
    gap = np.hypot(offset[:, :, 0], offset[:, :, 1]) - radius[:, None]
    on = real & (np.abs(gap) < width)
    inside = real & (gap < -1.5 * width)
    clutter = real & (gap >= width) & (gap < 3.0 * width + 0.5 * radius[:, None])
    sector = np.floor((np.arctan2(offset[:, :, 1], offset[:, :, 0]) / (2 * np.pi) % 1.0) * N_SECTORS).astype(int)
    seen = np.zeros((len(local), N_SECTORS + 1), bool)
    seen[np.arange(len(local))[:, None], np.where(on, np.minimum(sector, N_SECTORS - 1), N_SECTORS)] = True
    n_on = on.sum(axis=1)
    rings = Rings(
        names,
        centre,
        radius,
        seen[:, :N_SECTORS].sum(axis=1) * (360.0 / N_SECTORS),
        n_on.astype(np.int32),
        inside.sum(axis=1) / np.maximum(n_on, 1),
        clutter.sum(axis=1) / np.maximum(n_on, 1),
    )
    return rings, on | inside


def _width(radius: Any, tolerance: float) -> Any:
    """How far from a circle a point still belongs to it; never more than half the radius of a thin stem."""
    return np.minimum(tolerance + 0.05 * radius, np.maximum(0.6 * radius, 0.4 * tolerance))


def _random_circles(local: Float32, real: Bool, rng: np.random.Generator) -> tuple[Float32, Float32]:
    """(G, T, 2) centres and (G, T) radii of circles through three random points of each set."""
    n_real = real.sum(axis=1)
    # Real points first in each row, so that a random rank is a real point.
    order = np.argsort(~real, axis=1, kind="stable")
    rank = (rng.random((len(local), _N_TRIALS, 3)) * n_real[:, None, None]).astype(int)
    chosen = np.take_along_axis(order, rank.reshape(len(local), -1), axis=1)
    corner = np.take_along_axis(local, chosen[:, :, None], axis=1).reshape(len(local), _N_TRIALS, 3, 2)
    a, b, c = corner[:, :, 0], corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]
    twice_area = 2.0 * (b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0])
    bb, cc = (b**2).sum(axis=-1), (c**2).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ux = (c[..., 1] * bb - b[..., 1] * cc) / twice_area
        uy = (b[..., 0] * cc - c[..., 0] * bb) / twice_area
    return np.stack([a[..., 0] + ux, a[..., 1] + uy], axis=-1), np.hypot(ux, uy)


def _scores(local: Float32, real: Bool, xy: Float32, radius: Float32, tolerance: float) -> Float32:
    """(G, T) support of each circle: near points count for it, points inside count against it; -inf where unusable."""
    score = np.full(radius.shape, -np.inf, np.float32)
    group, trial = np.nonzero(np.isfinite(radius))
    x, y = np.ascontiguousarray(local[:, :, 0]), np.ascontiguousarray(local[:, :, 1])
    counted = real.astype(np.float32)
    for start in range(0, len(group), _CIRCLES_IN_CACHE):
        of, at = group[start : start + _CIRCLES_IN_CACHE], trial[start : start + _CIRCLES_IN_CACHE]
        size = radius[of, at, None].astype(np.float32)
        dx, dy = x[of], y[of]
        dx -= xy[of, at, 0, None]
        dy -= xy[of, at, 1, None]
        dx *= dx
        dy *= dy
        dx += dy
        gap = np.sqrt(dx, out=dx)
        gap -= size
        gap /= _width(size, tolerance).astype(np.float32)
        against = gap < -1.5
        np.multiply(gap, gap, out=gap)
        np.subtract(np.float32(1), gap, out=gap)
        np.maximum(gap, 0, out=gap)
        gap -= np.float32(0.7) * against
        gap *= counted[of]
        score[of, at] = gap.sum(axis=1)
    return score


def _gauss_newton(
    local: Float32, real: Bool, xy: Float64, radius: Float64, tolerance: float
) -> tuple[Float64, Float64]:
    """One robust (biweight) step towards the geometric circle fit."""
    x, y = local[:, :, 0] - xy[:, :1], local[:, :, 1] - xy[:, 1:]
    distance = np.maximum(np.hypot(x, y), 1e-9)
    gap = distance - radius[:, None]
    with np.errstate(invalid="ignore"):
        weight = np.clip(1.0 - (gap / _width(radius, tolerance)[:, None]) ** 2, 0.0, None) ** 2
    weight = np.where(real & np.isfinite(gap), weight, 0.0)
    gap = np.where(np.isfinite(gap), gap, 0.0)
    # The derivatives are the unit vectors outwards, and one. Sums of their products, one by one: for matrices this
    # small that is quicker than multiplying them.
    x /= distance
    y /= distance
    wx, wy = weight * x, weight * y
    total = weight.sum(axis=1)
    normal = np.empty((len(local), 3, 3))
    for (i, j), values in {(0, 0): wx * x, (0, 1): wx * y, (1, 1): wy * y, (0, 2): wx, (1, 2): wy}.items():
        normal[:, i, j] = normal[:, j, i] = values.sum(axis=1)
    normal[:, 2, 2] = total
    right = np.stack([(part * gap).sum(axis=1) for part in (wx, wy, weight)], axis=1)
    # A ridge keeps short arcs from running away.
    normal += (0.01 * total + 1e-9)[:, None, None] * np.eye(3)
    step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    step = np.clip(step, -0.3 * np.nan_to_num(radius)[:, None], 0.3 * np.nan_to_num(radius)[:, None])
    return xy + step[:, :2], radius + step[:, 2]
