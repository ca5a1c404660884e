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

from dbh_studio.core.arrays import Bool, Float64, readonly
from dbh_studio.core.robust import tukey_weight
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
    inside = (points_m[:, 2] > max(LOWEST_M, z0 - reach_m)) & (points_m[:, 2] < z0 + reach_m)  # NaN is nowhere
    local = frame.inverse().apply(_thinned(points_m[inside]).astype(np.float64))
    far = (_GATE[1] * float(outline_radius.max())) ** 2
    local = local[local[:, 0] ** 2 + local[:, 1] ** 2 < far]
    angle = np.arctan2(local[:, 1], local[:, 0])
    reference = np.interp(angle, np.arange(len(outline_radius)) * (2 * np.pi / len(outline_radius)), outline_radius,
                          period=2 * np.pi)  # fmt: skip
    radius = np.hypot(local[:, 0], local[:, 1])
    near = radius > _GATE[0] * reference
    # Slabs lie across the stem, by the height at which its axis passes them.
    slab = np.floor((z0 + local[:, 2] * upright - LOWEST_M) / STEP_M).astype(np.int64)
    near &= slab >= 0
    slab, angle, radius, reference = slab[near], angle[near], radius[near], reference[near]
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


def _sizes(slab: NDArray[np.int64], angle: Float64, radius: Float64, reference: Float64, away_m: Float64) -> Float64:
    """(H,) size and, together with it, place of the outline in each slab, by robust least squares; NaN where unseen.

    Where the axis passes is known the worse the farther a slab is from the section, which matters where one side of
    the stem is seen: there a shift and a size look alike.
    """
    n_slabs = len(away_m)
    if not n_slabs:
        return np.empty(0)
    size = _slab_medians(slab, radius / reference, n_slabs)
    basis = np.stack([reference, np.cos(angle), np.sin(angle)], axis=1)
    state = np.stack([size, np.zeros(n_slabs), np.zeros(n_slabs)], axis=1)
    prior_sd = _AXIS_SD_M + _AXIS_SD_SLOPE * away_m
    weight = np.ones(len(slab))
    sigma = np.empty(0)
    for step in range(_ROUNDS):
        error = radius - (basis * state[slab]).sum(axis=1)
        if step < 2:
            sigma = np.maximum(1.4826 * _slab_medians(slab, np.abs(error), n_slabs), 1e-3)
        weight = tukey_weight(error / sigma[slab], 1.0)
        total = np.maximum(np.bincount(slab, weight, n_slabs), 1e-9)
        scale = _N_EFFECTIVE / (total * sigma**2)
        normal = np.empty((n_slabs, 3, 3))
        gradient = np.empty((n_slabs, 3))
        for i in range(3):
            gradient[:, i] = scale * np.bincount(slab, weight * basis[:, i] * error, n_slabs)
            for j in range(i, 3):
                normal[:, i, j] = normal[:, j, i] = scale * np.bincount(
                    slab, weight * basis[:, i] * basis[:, j], n_slabs
                )
        for i in (1, 2):
            normal[:, i, i] += prior_sd**-2
            gradient[:, i] -= state[:, i] * prior_sd**-2
        normal += 1e-9 * np.eye(3)
        state = state + np.nan_to_num(np.linalg.solve(normal, gradient[..., None])[..., 0])
    sector = np.floor((angle + np.pi) * (_N_SECTORS / (2 * np.pi))).astype(np.int64) % _N_SECTORS
    on = weight > 0.1
    seen_sectors = (np.bincount(slab[on] * _N_SECTORS + sector[on], minlength=n_slabs * _N_SECTORS) > 0).reshape(
        n_slabs, _N_SECTORS
    )
    is_seen = (np.bincount(slab[on], minlength=n_slabs) >= _LEAST_POINTS) & (seen_sectors.sum(axis=1) >= _LEAST_SECTORS)
    return np.where(is_seen & (state[:, 0] > 0.1), state[:, 0], np.nan)


def _slab_medians(slab: NDArray[np.int64], value: Float64, n_slabs: int) -> Float64:
    """(H,) median of the values in each slab; 1 where there are none."""
    order = np.argsort(slab + value / (1.000001 * value.max() + 1e-12))
    count = np.bincount(slab, minlength=n_slabs)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    ordered = value[order]
    middle = np.minimum(first + np.maximum(count - 1, 0) // 2, len(ordered) - 1)
    return np.where(count > 0, ordered[middle], 1.0)
