"""Closed polygons in the plane; the last corner is joined to the first."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Bool, Float, Float64


def signed_area(corners: Float64) -> float:
    """Area inside (M, 2) corners, positive where they go round counter-clockwise."""
    # About the first corner: far from the origin the products would lose the area.
    x, y = (corners - corners[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def crosses_itself(corners: Float64) -> bool:
    """Whether two sides of (M, 2) corners that are not neighbours meet; the work grows with the square of M."""
    n = len(corners)
    a, b = corners, np.roll(corners, -1, axis=0)
    along = b - a

    def side(of: slice | int, to: Float64) -> Float64:
        """On which side of the sides `of` the places `to` are."""
        x, y = (to - a[of]).T
        step = along[of]
        return np.asarray(step[..., 0] * y - step[..., 1] * x)

    for i in range(n - 2):
        # Each with all that come after it but its neighbours; the last one neighbours the first.
        others = slice(i + 2, n if i else n - 1)
        meets = side(i, a[others]) * side(i, b[others]) < 0
        if meets.any() and (meets & (side(others, a[i]) * side(others, b[i]) < 0)).any():
            return True
    return False


def inside_polygon(places: Float, corners: Float64) -> Bool:
    """(N,) which of (N, 2) places are inside (M, 2) corners; where these cross, the even-odd rule. NaN is nowhere."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    near = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
    x, y = places[near].T
    odd = np.zeros(len(near), bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            odd ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    inside = np.zeros(len(places), bool)
    inside[near] = odd
    return inside
