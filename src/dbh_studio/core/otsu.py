"""Otsu's threshold (1979) for a handful of values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def otsu_threshold(values: NDArray[Any]) -> float:
    """The value that best splits `values` in two: those below it and those at or above it.

    Between-class variance is evaluated at every gap between sorted values, without a histogram, because there are few
    clusters. With fewer than two different values nothing can be split and the threshold is the smallest value.

    Args:
        values: (N,) finite values, at least one.

    Returns:
        The smallest value of the upper class.

    Raises:
        ValueError: No value, or one that is not finite.
    """
    ordered = np.sort(np.asarray(values, np.float64).ravel())
    if not len(ordered) or not np.isfinite(ordered).all():
        raise ValueError(f"Otsu's threshold needs finite values, got {len(ordered)}")
    gaps = np.flatnonzero(np.diff(ordered) > 0)
    if not len(gaps):
        return float(ordered[0])
    sums = np.cumsum(ordered)
    n_low = gaps + 1.0
    n_high = len(ordered) - n_low
    mean_low = sums[gaps] / n_low
    mean_high = (sums[-1] - sums[gaps]) / n_high
    return float(ordered[gaps[int(np.argmax(n_low * n_high * (mean_high - mean_low) ** 2))] + 1])
