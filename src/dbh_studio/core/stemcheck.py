"""Quick evidence of stems: a low surface, and what stands in a slab at breast height. For the data check only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, find_objects, grey_opening, label, median_filter

from dbh_studio.core.arrays import Float64, Int64

BAND_M = (1.22, 1.52)
_CELLS_MOST = 800
_SLAB_CELLS_MOST = 4000


@dataclass(frozen=True, eq=False)
class LowSurface:
    """A coarse surface under the cloud.

    Attributes:
        z: (n, m) heights of the cells.
        corner: (2,) lower corner.
        cell: Size of a cell.
    """

    z: Float64
    corner: Float64
    cell: float

    def height_above(self, level: Float64) -> Float64:
        """(N,) height of (N, 3) levelled points above the surface."""
        n_x, n_y = self.z.shape
        x = np.clip(_cells(level[:, 0], self.corner[0], self.cell), 0, n_x - 1)
        y = np.clip(_cells(level[:, 1], self.corner[1], self.cell), 0, n_y - 1)
        above: Float64 = level[:, 2] - self.z.ravel()[x * n_y + y]
        return above


@dataclass(frozen=True)
class StemEvidence:
    """Groups of points at breast height.

    Attributes:
        n_stems: Groups as wide as a stem may be.
        n_round: Those of them that lie on a circle.
        points_per_stem: Median number of points of a group, in the whole cloud.
        points_per_m2: Median density on the bark.
        median_diameter_m: Of the circles; None where there is none.
    """

    n_stems: int
    n_round: int
    points_per_stem: float
    points_per_m2: float
    median_diameter_m: float | None


def low_surface(level: Float64, *, cell: float | None = None) -> LowSurface:
    """The lowest points on a grid, opened so that cells with only crown come down to their neighbours.

    Args:
        level: (N, 3) points, +z up, any unit; quickest with contiguous columns.
        cell: Size of a cell; by default a fortieth of the longer side.
    """
    corner, upper = (np.array([function(level[:, i]) for i in (0, 1)]) for function in (np.min, np.max))
    size = float((upper - corner).max())
    cell = max(cell or size / 40.0, size / _CELLS_MOST) or 1.0
    x, y = (_cells(level[:, i], corner[i], cell) for i in (0, 1))
    n_x, n_y = int(x.max()) + 1, int(y.max()) + 1
    lowest: Float64 = np.full(n_x * n_y, np.inf)
    # One index in place of two: only for that `at` is quick.
    np.minimum.at(lowest, x * n_y + y, level[:, 2])
    lowest = lowest.reshape(n_x, n_y)
    empty = ~np.isfinite(lowest)
    if empty.any():
        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        lowest = lowest[tuple(nearest)]
    # A stray point below the ground would pull its cell down; it stands out by whole cells, slopes do not.
    middle = median_filter(lowest, size=5)
    lowest = np.where(lowest < middle - 2.0 * cell, middle, lowest)
    return LowSurface(grey_opening(lowest, size=5), corner, cell)


def stem_evidence(level: Float64, *, metres_per_unit: float, share: float) -> StemEvidence:
    """Find groups of points 1.22-1.52 m above the low surface and put circles through them.

    Args:
        level: (N, 3) levelled points, source units.
        metres_per_unit: The scale.
        share: Which part of the whole cloud `level` is, for the number of points per stem.
    """
    surface = low_surface(level, cell=1.0 / metres_per_unit)
    height_m = surface.height_above(level) * metres_per_unit
    slab = level[np.flatnonzero((height_m >= BAND_M[0]) & (height_m <= BAND_M[1])), :2] * metres_per_unit
    if len(slab) < 3:
        return StemEvidence(0, 0, 0.0, 0.0, None)
    slab = slab - slab.min(axis=0)
    cell = max(0.08, float(slab.max()) / _SLAB_CELLS_MOST)
    cells = np.floor(slab / cell).astype(np.int64)
    grid = np.zeros(tuple(cells.max(axis=0) + 1), bool)
    grid[cells[:, 0], cells[:, 1]] = True
    groups, n_groups = label(grid, structure=np.ones((3, 3), int))
    widths = np.array([max(s.stop - s.start for s in box) * cell for box in find_objects(groups)])
    of_point = groups[cells[:, 0], cells[:, 1]] - 1
    counts = np.bincount(of_point, minlength=n_groups)
    floor = max(5.0, 0.05 * float(np.quantile(counts, 0.95)))
    wanted = (counts >= floor) & (widths <= 2.5)
    if not wanted.any():
        return StemEvidence(0, 0, 0.0, 0.0, None)
    radii, residuals = _circles(slab, of_point, n_groups)
    round_ = wanted & (residuals < 0.25 * radii) & (radii < 1.25)
    diameter = float(2.0 * np.median(radii[round_])) if round_.any() else None
    points = float(np.median(counts[wanted])) / share
    bark_m2 = np.pi * (diameter or float(np.median(widths[wanted]))) * (BAND_M[1] - BAND_M[0])
    return StemEvidence(int(wanted.sum()), int(round_.sum()), points, points / bark_m2, diameter)


def _cells(values: Float64, corner: float, cell: float) -> Int64:
    """(N,) which cell each of (N,) coordinates is in."""
    return np.floor((values - corner) / cell).astype(np.int64)


def _circles(xy: Float64, group: NDArray[Any], n_groups: int) -> tuple[Float64, Float64]:
    """(G,) radius and (G,) rms distance of each group's least-squares circle (Kåsa 1976), all groups at once."""
    count = np.maximum(np.bincount(group, minlength=n_groups), 1)
    centre = np.stack([np.bincount(group, xy[:, i], n_groups) / count for i in (0, 1)], axis=1)
    u, v = (xy - centre[group]).T
    square = u * u + v * v

    def mean(values: Float64) -> Float64:
        return np.asarray(np.bincount(group, values, n_groups) / count, np.float64)

    suu, suv, svv, ru, rv, r = mean(u * u), mean(u * v), mean(v * v), mean(square * u), mean(square * v), mean(square)
    determinant = np.maximum(suu * svv - suv * suv, 1e-18)
    a, b = 0.5 * (ru * svv - rv * suv) / determinant, 0.5 * (rv * suu - ru * suv) / determinant
    radius = np.sqrt(r + a * a + b * b)
    distance = np.hypot(u - a[group], v - b[group]) - radius[group]
    return radius, np.sqrt(mean(distance * distance))
