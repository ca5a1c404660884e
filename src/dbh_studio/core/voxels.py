"""Thinning a cloud to one point per small cube, with the way back to every point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float, Float32, Int32, Int64, as_points

Label = TypeVar("Label", bound=np.generic)

# Along each axis: three such numbers make one 64-bit key.
MAX_CUBES = 1 << 21


@dataclass(frozen=True, eq=False)
class Thinned:
    """One point per occupied cube.

    Attributes:
        points: (M, 3) float32 mean of the points of each cube.
        counts: (M,) how many points it stands for.
        order: (N,) the original rows, cube by cube.
        starts: (M,) where each cube's rows begin in `order`.
        edge_m: Edge length of the cubes.
    """

    points: Float32
    counts: Int32
    order: Int64
    starts: Int64
    edge_m: float

    def __len__(self) -> int:
        return len(self.points)

    def labels_of_points(self, labels: NDArray[Label]) -> NDArray[Label]:
        """(N,) label of every original point from (M,) labels of the cubes."""
        back = np.empty(len(self.order), labels.dtype)
        back[self.order] = np.repeat(labels, self.counts)
        return back


def thin(points: Float, edge_m: float) -> Thinned:
    """Thin (N, 3) points to the means of cubes of `edge_m`.

    Raises:
        ValueError: Wrong shape, an edge that is not positive, or an extent of more than 2²¹ cubes.
    """
    points = as_points(points, name="points")
    if not edge_m > 0:
        raise ValueError(f"the cubes' edge is {edge_m} but must be positive")
    if not len(points):
        empty = np.empty(0, np.int64)
        return Thinned(np.empty((0, 3), np.float32), np.empty(0, np.int32), empty, empty, edge_m)
    key = cube_keys(points, edge_m)
    order = np.argsort(key)
    key = key[order]
    starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    counts = np.diff(starts, append=len(key))
    means = np.empty((len(starts), 3), np.float32)
    for axis in range(3):
        # Sums in float64: with 10⁵ points in a cube float32 sums lose millimetres.
        means[:, axis] = np.add.reduceat(points[order, axis].astype(np.float64), starts) / counts
    return Thinned(means, counts.astype(np.int32), order, starts, edge_m)


def cube_keys(points: Float, edge_m: float) -> Int64:
    """(N,) one integer per cube of `edge_m`; equal for points in the same cube."""
    key = np.zeros(len(points), np.int64)
    for axis in range(3):
        # One column at a time: reductions over the short axis of an (N, 3) array are several times slower.
        column = points[:, axis]
        lower, upper = column.min(), column.max()
        if not np.isfinite(lower + upper) or (upper - lower) / edge_m >= MAX_CUBES:
            raise ValueError("points must be finite and within 2²¹ cubes of each other")
        key <<= 21
        key |= ((column - lower) * column.dtype.type(1.0 / edge_m)).astype(np.int32)
    return key
