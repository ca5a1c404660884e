"""A random sample of points that does not depend on the order they came in."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.robust import canonical_order

_ODD = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93)
_WORD = 2**64 - 1
_SAME_M = 1e-5  # nearer than this two coordinates are the same one


def sample_points(points_m: Float64, n_most: int, *, seed: int) -> Int64:
    """Indices of at most `n_most` of (N, 3) points, in canonical order.

    Every point gets a pseudo-random number from its own coordinates and the seed, and the smallest are taken: linear
    in N, where sorting all points first would cost more than the fit.
    """
    # Rounded: the last bits of a cloud that was turned or levelled depend on the processor's kind.
    place = np.rint(points_m * (1.0 / _SAME_M))
    if len(points_m) <= n_most:
        return _order(points_m, place)
    bits = place.astype(np.int64).view(np.uint64)
    key = np.full(len(bits), (seed * _ODD[3] + 1) & _WORD, np.uint64)
    for column, odd in enumerate(_ODD[:3]):
        key ^= bits[:, column]
        key *= np.uint64(odd)
        key ^= key >> np.uint64(29)
    key *= np.uint64(_ODD[3])
    key ^= key >> np.uint64(32)
    chosen = np.argpartition(key, n_most)[:n_most]
    return chosen[_order(points_m[chosen], place[chosen])]


def _order(points_m: Float64, place: Float64) -> Int64:
    """By rounded coordinates; of points that share these by the coordinates as they are."""
    return canonical_order(np.hstack([points_m, place]))
