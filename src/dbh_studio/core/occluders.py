"""What of a stem a camera sees, by the cloud itself: whether something stands in front.

Every point between a camera and a stem is projected onto the stem, as large there as its neighbours are apart; where
several fall, the stem is not seen. Only the points in the narrow corridor between the two are looked at, so that
hundreds of trees and photos take seconds, and no depth map of every photo is kept.

All is in one frame with +z up, in any unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int64, as_points, readonly
from dbh_studio.core.neighbours import point_spacing
from dbh_studio.core.stem_line import StemLine

# The stem's face as seen from a camera is cut into so many parts: up, and across.
N_UP, N_ACROSS = 24, 7
# A point covers this many spacings to each side, so that a closed surface covers every spot about six times;
# two are asked for, because one may be noise in the air.
_COVER, _ENOUGH = 1.25, 2
# What is nearer to the camera than this share of the distance is the one who carries it, or noise.
_AT_CAMERA = 0.08
_MOST_POINTS, _STRETCH, _CELLS = 2_000_000, 200_000, 96


class Occluders:
    """The points of a cloud that may hide a tree, laid out so that those along a line are found quickly.

    Args:
        points: (N, 3), +z up. Those without a place are left out.
        most: More points are thinned out to this number.

    Attributes:
        spacing: Typical distance between neighbours among those kept; 0 where there are too few to tell.
    """

    def __init__(self, points: Float, *, most: int = _MOST_POINTS) -> None:
        points = as_points(points, name="points")
        rows = _thinned(len(points), most)
        xyz = points[rows].astype(np.float32)
        is_finite = np.isfinite(xyz).all(axis=1)
        xyz, rows = xyz[is_finite], rows[is_finite]
        if len(xyz):
            low, high = np.percentile(xyz[:: max(1, len(xyz) // 100_000), :2], [0.5, 99.5], axis=0)
        else:
            low, high = np.zeros(2), np.ones(2)
        self._low = low.astype(np.float64)
        self._cell = max(float((high - low).max()) / _CELLS, 1e-9)
        cell = self._cells(xyz[:, :2])
        flat = cell[:, 0] * _CELLS + cell[:, 1]
        order = np.argsort(flat, kind="stable")
        self._xyz: Float32 = readonly(xyz[order])
        self._rows: Int64 = readonly(rows[order])
        self._starts = np.searchsorted(flat[order], np.arange(_CELLS * _CELLS + 1))
        middle = max(0, (len(xyz) - _STRETCH) // 2)
        spacing = point_spacing(self._xyz[middle : middle + _STRETCH])
        self.spacing = spacing if np.isfinite(spacing) else 0.0

    def __len__(self) -> int:
        return len(self._xyz)

    def hidden(self, centre: Float64, stem: StemLine, *, own: Int64 | None = None) -> Bool:
        """(N_UP, N_ACROSS) which parts of a stem's face something stands in front of, from below and from the left.

        Args:
            centre: (3,) of the camera.
            stem: Of the tree.
            own: Ascending rows of the cloud that belong to the tree and never hide it.
        """
        face = _Face.of(centre, stem)
        # How far the axis leaves the upright through its middle.
        lean = max(abs(side) for side in face.across_at(np.array([stem.low, stem.high])))
        rows = self._between(centre[:2], face, stem.radius + lean + 2.0 * self.spacing)
        offset = self._xyz[rows] - centre.astype(np.float32)
        ahead = offset[:, :2] @ face.forward.astype(np.float32)
        near = np.flatnonzero((ahead > _AT_CAMERA * face.distance) & (ahead < face.distance + 2.0 * stem.radius))
        rows, offset, ahead = rows[near], offset[near], ahead[near]
        enlarged = np.float32(face.distance) / ahead
        side = (offset[:, :2] @ face.right.astype(np.float32)) * enlarged
        size = np.float32(_COVER * self.spacing) * enlarged
        # Nearly all lie beside the stem, and are asked no further.
        near = np.flatnonzero(np.abs(side) < stem.radius + lean + size)
        rows, ahead, side, size = rows[near], ahead[near], side[near], size[near]
        height = centre[2] + offset[near, 2].astype(np.float64) * enlarged[near]
        across = side - face.across_at(height)
        margin = 1.5 * stem.radius + 2.0 * self.spacing
        counts = (
            (ahead < face.ahead_at(height) - margin)
            & (np.abs(across) < stem.radius + size)
            & (height > stem.low - size)
            & (height < stem.high + size)
        )
        if own is not None and len(own):
            at = np.minimum(np.searchsorted(own, self._rows[rows]), len(own) - 1)
            counts &= own[at] != self._rows[rows]
        up = N_UP / (stem.high - stem.low)
        wide = N_ACROSS / (2.0 * stem.radius)
        covered = _painted(
            (height[counts] - stem.low) * up,
            (across[counts] + stem.radius) * wide,
            size[counts] * up,
            size[counts] * wide,
        )
        return covered >= _ENOUGH

    def _cells(self, xy: Float) -> Int64:
        with np.errstate(invalid="ignore"):
            cells = np.floor((xy - self._low) / self._cell)
        return np.clip(cells, 0, _CELLS - 1).astype(np.int64)

    def _between(self, start_xy: Float64, face: _Face, reach: float) -> Int64:
        """(K,) rows of this layout in the cells along a line, and within `reach` beside it."""
        end_xy = start_xy + face.forward * face.distance
        corner, other = self._cells(np.stack([start_xy, end_xy]))
        extra = int(np.ceil(reach / self._cell))
        low = np.maximum(np.minimum(corner, other) - extra, 0)
        high = np.minimum(np.maximum(corner, other) + extra, _CELLS - 1)
        columns, rows = np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)
        middle = (
            np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1) * self._cell + self._low + 0.5 * self._cell
        )
        is_near = np.abs((middle - start_xy) @ face.right) <= reach + 0.75 * self._cell
        # Stray points lie in the cells at the border, which reach as far as they do.
        is_near[(columns == 0) | (columns == _CELLS - 1)] = True
        is_near[:, (rows == 0) | (rows == _CELLS - 1)] = True
        column, row = np.nonzero(is_near)
        flat = columns[column] * _CELLS + rows[row]
        return _ranges(self._starts[flat], self._starts[flat + 1])


@dataclass(frozen=True, eq=False)
class _Face:
    """A stem as a camera sees it: the upright plane across the line of sight."""

    centre: Float64
    stem: StemLine
    forward: Float64
    right: Float64
    distance: float

    @classmethod
    def of(cls, centre: Float64, stem: StemLine) -> _Face:
        to_stem = (stem.at(np.array([stem.middle]))[0] - centre)[:2]
        distance = max(float(np.hypot(*to_stem)), 1e-9)
        forward = to_stem / distance if np.any(to_stem) else np.array([0.0, 1.0])
        return cls(centre, stem, forward, np.array([forward[1], -forward[0]]), distance)

    def across_at(self, z: Float64) -> Float64:
        """(K,) how far to the right of the plane's middle the axis is, where it is bent or leans."""
        return (self.stem.at(z)[:, :2] - self.centre[:2]) @ self.right

    def ahead_at(self, z: Float64) -> Float64:
        """(K,) how far ahead of the camera the axis is."""
        return (self.stem.at(z)[:, :2] - self.centre[:2]) @ self.forward


def part_of_face(points: Float64, centre: Float64, stem: StemLine) -> tuple[Int64, Int64]:
    """(K,) and (K,) in which part of a stem's face, up and across as for `Occluders.hidden`, (K, 3) points lie."""
    face = _Face.of(centre, stem)
    across = (points[:, :2] - centre[:2]) @ face.right - face.across_at(points[:, 2])
    up = np.floor((points[:, 2] - stem.low) * (N_UP / (stem.high - stem.low)))
    wide = np.floor((across + stem.radius) * (N_ACROSS / (2.0 * stem.radius)))
    return np.clip(up, 0, N_UP - 1).astype(np.int64), np.clip(wide, 0, N_ACROSS - 1).astype(np.int64)


def without_specks(hidden: Bool) -> Bool:
    """(N_UP, N_ACROSS) the same without single parts that differ from those around them."""
    return np.asarray(median_filter(hidden.astype(np.uint8), size=(5, 3), mode="nearest") > 0)


def _painted(up: Float64, across: Float64, half_up: Float64, half_across: Float64) -> Int64:
    """(N_UP, N_ACROSS) how many rectangles cover the middle of each part; positions and halves in parts."""
    corners = np.zeros((N_UP + 1, N_ACROSS + 1), np.int64)
    if len(up):
        u0 = np.clip(np.ceil(up - half_up - 0.5), 0, N_UP).astype(np.int64)
        u1 = np.clip(np.floor(up + half_up - 0.5) + 1, 0, N_UP).astype(np.int64)
        a0 = np.clip(np.ceil(across - half_across - 0.5), 0, N_ACROSS).astype(np.int64)
        a1 = np.clip(np.floor(across + half_across - 0.5) + 1, 0, N_ACROSS).astype(np.int64)
        for row, column, sign in ((u0, a0, 1), (u0, a1, -1), (u1, a0, -1), (u1, a1, 1)):
            np.add.at(corners, (row, column), sign)
    return corners.cumsum(axis=0).cumsum(axis=1)[:N_UP, :N_ACROSS]


def _thinned(n: int, most: int) -> Int64:
    """Ascending rows, at most so many: one out of every few, and not always the same, which may be a column."""
    step = max(1, -(-n // max(most, 1)))
    rows = np.arange(0, n, step)
    if step > 1:
        rows = np.minimum(rows + np.random.default_rng(0).integers(0, step, len(rows)), n - 1)
    return rows


def _ranges(starts: Int64, ends: Int64) -> Int64:
    """All whole numbers of the ranges, one after another."""
    length = ends - starts
    total = int(length.sum())
    if not total:
        return np.empty(0, np.int64)
    jump = np.repeat(starts - np.concatenate([[0], length.cumsum()[:-1]]), length)
    return np.arange(total) + jump
