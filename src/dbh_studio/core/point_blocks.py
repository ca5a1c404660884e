"""Which points of a large cloud are near a place or on a part of the screen, without a look at all of them.

The points stay where they are: what is kept is an order of them in which neighbours are together, 4 bytes per point,
and the box of each block of that order. A question looks at the boxes, then at the points of the few that matter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Bool, Float32, Float64, Int32, Int64, as_points
from dbh_studio.core.picking import View

# Sorted a piece at a time, so that the memory for it stays small whatever the cloud.
_PIECE = 1_000_000
# Blocks along the wider side of the plot, and at most in each direction: stray points are put with the outermost.
_N_WIDE, _N_MOST = 64, 255


class PointBlocks:
    """The blocks of a cloud.

    Args:
        xyz: (N, 3) points, which must not change; they are not copied. Points that are not finite are never found.
        is_stopped: Asked after each piece; where it says yes, the work is given up by an `InterruptedError`.

    Attributes:
        xyz: The points.
    """

    def __init__(self, xyz: Float32, *, is_stopped: Callable[[], bool] = lambda: False) -> None:
        self.xyz = as_points(xyz, name="xyz")
        low, cell = _grid(self.xyz)
        order: list[Int32] = []
        starts: list[Int64] = []
        boxes: list[Float32] = []
        for begin in range(0, len(self.xyz), _PIECE):
            if is_stopped():
                raise InterruptedError
            piece = self.xyz[begin : begin + _PIECE]
            own, first, box = _sorted_piece(piece, low, cell)
            order.append((own + begin).astype(np.int32))
            starts.append(first + begin)
            boxes.append(box)
        self._order: Int32 = np.concatenate([*order, np.empty(0, np.int32)])
        self._start: Int64 = np.concatenate([*starts, np.array([len(self.xyz)], np.int64)])
        self._boxes: Float32 = np.concatenate([*boxes, np.empty((0, 2, 3), np.float32)])

    def __len__(self) -> int:
        return len(self._boxes)

    @property
    def n_bytes(self) -> int:
        """What is kept beside the points."""
        return int(self._order.nbytes + self._start.nbytes + self._boxes.nbytes)

    def in_box(self, lower: Any, upper: Any) -> Int64:
        """(K,) sorted rows of the points between two corners, both (3,) in the points' frame; ±inf: to the end."""
        low, high = np.asarray(lower, np.float32).reshape(3), np.asarray(upper, np.float32).reshape(3)
        touched: Bool = np.all((self._boxes[:, 0] <= high) & (self._boxes[:, 1] >= low), axis=1)
        rows = self._rows(touched)
        for axis in range(3):
            values = self.xyz[rows, axis]
            rows = rows[(values >= low[axis]) & (values <= high[axis]) & np.isfinite(values)]
        return np.sort(rows)

    def perhaps_in_view(self, view: View, corners: Any, *, nearest: float = 0.0, farthest: float = np.inf) -> Int64:
        """(K,) sorted rows of points among which are all that appear between two screen corners.

        Args:
            view: The camera.
            corners: (2, 2) lower and upper corner, 0..1.
            nearest: From which depth on; in the points' unit.
            farthest: Up to which.
        """
        inward, offsets = _sides(view, np.asarray(corners, np.float64).reshape(2, 2), nearest, farthest)
        touched = np.ones(len(self._boxes), bool)
        for normal, offset in zip(inward, offsets, strict=True):
            # The corner of the box that lies farthest to the inside.
            best = np.where(normal > 0, self._boxes[:, 1], self._boxes[:, 0]).astype(np.float64)
            with np.errstate(invalid="ignore"):  # a block of points that are nowhere fails the comparison
                touched &= best @ normal >= offset
        return np.sort(self._rows(touched))

    def _rows(self, touched: Bool) -> Int64:
        """Rows of the points of the blocks chosen."""
        blocks = np.flatnonzero(touched)
        if not len(blocks):
            return np.empty(0, np.int64)
        start, count = self._start[blocks], self._start[blocks + 1] - self._start[blocks]
        ends = np.cumsum(count)
        at = np.arange(int(ends[-1])) + np.repeat(start - (ends - count), count)
        return self._order[at].astype(np.int64)


def _grid(xyz: Float32) -> tuple[Float64, float]:
    """Lower corner and cell size of a grid over the plot; stray points do not widen it."""
    sample = xyz[:: max(1, len(xyz) // 100_000)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not len(sample):
        return np.zeros(3), 1.0
    low, high = np.percentile(sample.astype(np.float64), [0.5, 99.5], axis=0)
    return low, max(float((high - low).max()) / _N_WIDE, 1e-9)


def _sorted_piece(piece: Float32, low: Float64, cell: float) -> tuple[Int64, Int64, Float32]:
    """Order of the points of a piece by cell, where each cell begins in it, and (B, 2, 3) the box of its points."""
    key = np.zeros(len(piece), np.int32)
    for axis in range(3):
        values = np.nan_to_num((piece[:, axis] - np.float32(low[axis])) / np.float32(cell), posinf=0.0, neginf=0.0)
        key <<= 8
        key |= np.clip(values, 0, _N_MOST).astype(np.int32)
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    points = piece[order]
    # fmin, not minimum: a point that is not finite is nowhere, and must not take its block there.
    points[~np.isfinite(points).all(axis=1)] = np.nan
    box = np.stack([np.fmin.reduceat(points, first), np.fmax.reduceat(points, first)], axis=1)
    return order, first.astype(np.int64), box


def _sides(view: View, corners: Float64, nearest: float, farthest: float) -> tuple[list[Float64], list[float]]:
    """Inward normals of the planes that bound what appears between two screen corners, and the offset of each."""
    (x0, y0), (x1, y1) = 2.0 * np.sort(corners, axis=0) - 1.0
    tangent = np.tan(view.fov_rad / 2)
    right, down, forward = view.rotation
    wide = tangent * view.aspect
    normals = [
        right - x0 * wide * forward,
        x1 * wide * forward - right,
        down - y0 * tangent * forward,
        y1 * tangent * forward - down,
        forward,
    ]
    beyond = [0.0, 0.0, 0.0, 0.0, max(nearest, 0.0)]
    if np.isfinite(farthest):
        normals.append(-forward)
        beyond.append(-farthest)
    return normals, [float(normal @ view.origin) + by - 1e-4 for normal, by in zip(normals, beyond, strict=True)]
