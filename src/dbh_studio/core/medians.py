"""Medians and quantiles of finite values, as numpy has them.

Of some thousand values numpy's own take three to five times as long: most of that goes into cases that do not occur
here (axes, NaN, other kinds of interpolation). A stem is measured with a hundred of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, Int64


def median(values: NDArray[Any]) -> float:
    """`numpy.median` of (N,) finite values, N > 0."""
    middle = len(values) // 2
    parted = np.partition(values, middle)
    # The greatest of the lower half, not one more place to part at: that takes many times as long where N is large.
    return float(parted[middle]) if len(values) % 2 else 0.5 * float(parted[:middle].max() + parted[middle])


def quantiles(values: Float64, shares: Sequence[float]) -> list[float]:
    """`numpy.quantile` of (N,) finite values, N > 0, by linear interpolation."""
    last = len(values) - 1
    at = [share * last for share in shares]
    below = [int(each) for each in at]
    ordered = np.partition(values, sorted({min(row + step, last) for row in below for step in (0, 1)}))
    found = []
    for each, row in zip(at, below, strict=True):
        low, high, part = float(ordered[row]), float(ordered[min(row + 1, last)]), each - row
        # From the nearer of the two, as numpy does, so that the last digit is the same.
        found.append(low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part))
    return found


def group_medians(group: Int64, values: Float64, count: Int64, *, upper: bool = False) -> Float64:
    """(G,) median of each group; of an even number of values the lower of the middle two. Of an empty group any number.

    Args:
        group: (N,) number from 0 of the group each value is in.
        values: (N,) finite values, N > 0.
        count: (G,) how many values each group has.
        upper: Take the upper of the middle two.
    """
    low = float(values.min())
    scale = 0.999999 / max(float(values.max()) - low, 1e-12)
    # One sort of one key, group and value in one number, is many times quicker than an order by two.
    ranked = np.sort(group + (values - low) * scale)
    middle = np.cumsum(count) - count + (count if upper else count - 1) // 2
    found: Float64 = (ranked[np.minimum(middle, len(ranked) - 1)] - np.arange(len(count))) / scale + low
    return found
