"""Names for array types, and the two checks every public function makes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]


def readonly(array: NDArray[Any]) -> NDArray[Any]:
    """The same memory, marked read-only: values in the studio are immutable."""
    view = array.view()
    view.flags.writeable = False
    return view


def as_points(points: Any, *, name: str, n_columns: int = 3) -> Float:
    """Check that `points` is an (N, n_columns) float array.

    Raises:
        ValueError: Names the argument and the shape it got.
    """
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != n_columns:
        raise ValueError(f"{name} has shape {array.shape} but (N, {n_columns}) is needed")
    if not np.issubdtype(array.dtype, np.floating):
        array = array.astype(np.float64)
    return array


def finite_rows(points: NDArray[np.floating[Any]]) -> Bool:
    """(N,) which of (N, 3) points have finite coordinates.

    Column by column: numpy takes forty times as long for ``np.isfinite(points).all(axis=1)``.
    """
    x, y, z = points.T
    return np.isfinite(x) & np.isfinite(y) & np.isfinite(z)


def finite_points(points: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Those of (N, 3) points that have finite coordinates: the array itself where all have."""
    rows = finite_rows(points)
    return points if rows.all() else points[rows]
