"""How thick a stem is over its height, relative to one section of it: quick, and without any scale.

The outline of the section is held against the points of slabs above and below: how many times larger is it there? That
takes about a millisecond where a diameter at every height takes a hundred, and what all diameters of a stem have in
common (the scale, the bark, an unseen side) cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float64, Int64, finite_points, readonly
from dbh_studio.core.medians import group_medians
from dbh_studio.core.robust import tukey_weight
from dbh_studio.core.section import radius_at
from dbh_studio.core.transforms import Similarity

STEP_M = 0.10
LOWEST_M = 0.25
"""Below is litter, and the segmentation cuts there."""

_MOST_POINTS = 2500  # as many as the estimator looks at
_LEAST_POINTS = 20
_N_SECTORS, _LEAST_SECTORS = 12, 3  # with less than 90° a size and a shift cannot be told apart
_GATE = (0.4, 2.2)  # times the outline: nearer to the axis and farther from it nothing is taken for bark
_ROUNDS = 4
_ODD = (2654435761, 2246822519, 3266489917, 668265263)
_N_EFFECTIVE = 30.0  # neighbouring points share their error
_FIRST, _SECOND = np.triu_indices(3)
_AXIS_SD_M, _AXIS_SD_SLOPE = 0.01, 0.03  # of where the axis passes the section, and more with each metre from it


@dataclass(frozen=True, eq=False)
class StemCourse:
    """The stem in slabs of 10 cm.

    Attributes:
        height_m: (H,) middle of each slab above ground, ascending.
        log_size: (H,) logarithm of how many times larger the section is there; NaN where too little is seen.
    """

    height_m: Float64
    log_size: Float64

    @property
    def seen(self) -> Bool:
        """(H,) where there is a size."""
        return np.isfinite(self.log_size)


def stem_course(
    points_m: NDArray[np.floating[Any]], frame: Similarity, outline_uv_m: Float64, *, reach_m: float = 1.05
) -> StemCourse:
    """The course of a stem about one of its sections.

    Args:
        points_m: (N, 3) points of the stem, z above the ground at the stem; what is not finite is left out.
        frame: From section coordinates (u, v, w) to the stem's.
        outline_uv_m: (M, 2) closed outline of the section, around its origin.
        reach_m: How far from the section, upwards and downwards.
    """
    upright, z0 = float(frame.rotation[2, 2]), float(frame.translation[2])
    outline_radius = _by_angle(outline_uv_m)
    z = points_m[:, 2]
    inside = np.flatnonzero((z > max(LOWEST_M, z0 - reach_m)) & (z < z0 + reach_m))  # NaN is nowhere
    some = finite_points(_thinned(points_m.take(inside, axis=0))).astype(np.float64)
    local = frame.inverse().apply(some)
    radius = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
    near = np.flatnonzero(radius < _GATE[1] * float(outline_radius.max()))
    (x, y, along), radius = local[near].T, radius[near]
    angle = np.arctan2(y, x)
    reference = radius_at(outline_radius, angle)
    # Slabs lie across the stem, by the height at which its axis passes them.
    slab = np.floor((z0 + along * upright - LOWEST_M) / STEP_M).astype(np.int64)
    on = np.flatnonzero((radius > _GATE[0] * reference) & (slab >= 0))
    on = on[np.argsort(slab[on], kind="stable")]
    slab, angle, radius, reference = slab[on], angle[on], radius[on], reference[on]
    n_slabs = int(slab.max()) + 1 if len(slab) else 0
    height = LOWEST_M + STEP_M * (np.arange(n_slabs) + 0.5)
    size = _sizes(slab, angle, radius, reference, np.abs(height - z0) / upright)
    return StemCourse(readonly(height), readonly(np.log(size)))


def _thinned(points: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """About 2500 of (N, 3) points, or all of fewer; the same ones in whatever order they come."""
    if len(points) <= _MOST_POINTS:
        return points
    bits: NDArray[Any] = np.ascontiguousarray(points).view(np.uint32 if points.dtype == np.float32 else np.uint64)
    key = (bits[:, 0] * bits.dtype.type(_ODD[0])) ^ (bits[:, 1] * bits.dtype.type(_ODD[1]))
    key ^= bits[:, 2] * bits.dtype.type(_ODD[2])
    key ^= key >> bits.dtype.type(15)
    key = (key * bits.dtype.type(_ODD[3])).astype(np.uint32)
    key ^= key >> np.uint32(13)
    return points[key < np.uint32(2**32 * (_MOST_POINTS / len(points)))]


def _by_angle(outline_uv_m: Float64) -> Float64:
    """(72,) radius of an outline in equal steps of angle about the origin."""
    angle = np.arctan2(outline_uv_m[:, 1], outline_uv_m[:, 0])
    order = np.argsort(angle, kind="stable")
    radius = np.hypot(outline_uv_m[:, 0], outline_uv_m[:, 1])
    return np.asarray(np.interp(np.arange(72) * (2 * np.pi / 72), angle[order], radius[order], period=2 * np.pi))


def _sizes(slab: Int64, angle: Float64, radius: Float64, reference: Float64, away_m: Float64) -> Float64:
    """(H,) size and, together with it, place of the outline in each slab, by robust least squares; NaN where unseen.

    Where the axis passes is known the worse the farther a slab is from the section, which matters where one side of
    the stem is seen: there a shift and a size look alike.

    Args:
        slab: (N,) of the points, ascending.
        angle: (N,) of the points about the axis.
        radius: (N,) of the points.
        reference: (N,) of the outline in their directions.
        away_m: (H,) how far each slab is from the section.
    """
    sizes = np.full(len(away_m), np.nan)
    if not len(slab):
        return sizes
    is_first = np.append(True, slab[1:] != slab[:-1])
    first, row = np.flatnonzero(is_first), np.cumsum(is_first) - 1
    held, count = slab[first], np.diff(first, append=len(slab))
    basis = np.stack([reference, np.cos(angle), np.sin(angle)])
    # What is summed in each slab: 1 and the products of two of the basis, then those with the error.
    summed = np.concatenate([np.ones((1, len(slab))), basis[_FIRST] * basis[_SECOND], np.empty_like(basis)])
    state = np.zeros((len(held), 3))
    state[:, 0] = group_medians(row, radius / reference, count)
    prior = (_AXIS_SD_M + _AXIS_SD_SLOPE * away_m[held]) ** -2.0
    normal = np.empty((len(held), 3, 3))
    weight, sigma = np.empty(0), np.empty(0)
    for step in range(_ROUNDS):
        error = radius - (basis * state.T[:, row]).sum(axis=0)
        if step < 2:
            sigma = np.maximum(1.4826 * group_medians(row, np.abs(error), count), 1e-3)
        weight = tukey_weight(error / sigma[row], 1.0)
        np.multiply(basis, error, out=summed[7:])
        sums = np.add.reduceat(weight * summed, first, axis=1)
        sums *= _N_EFFECTIVE / (np.maximum(sums[0], 1e-9) * sigma**2)
        normal[:, _FIRST, _SECOND] = normal[:, _SECOND, _FIRST] = sums[1:7].T
        gradient = sums[7:].T.copy()
        for i in (1, 2):
            normal[:, i, i] += prior
            gradient[:, i] -= state[:, i] * prior
        normal += 1e-9 * np.eye(3)
        moved = np.linalg.solve(normal, gradient[..., None])[..., 0]
        state = state + np.where(np.isfinite(moved), moved, 0.0)
    on = np.flatnonzero(weight > 0.1)
    sector = np.floor((angle[on] + np.pi) * (_N_SECTORS / (2 * np.pi))).astype(np.int64) % _N_SECTORS
    seen = np.bincount(row[on] * _N_SECTORS + sector, minlength=len(held) * _N_SECTORS).reshape(-1, _N_SECTORS)
    is_seen = (seen.sum(axis=1) >= _LEAST_POINTS) & ((seen > 0).sum(axis=1) >= _LEAST_SECTORS)
    sizes[held] = np.where(is_seen & (state[:, 0] > 0.1), state[:, 0], np.nan)
    return sizes
