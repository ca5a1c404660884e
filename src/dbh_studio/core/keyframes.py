"""Which photos are worth a mask: those that show a side of a stem, or a place, that the ones before do not.

    sees = sides_seen(targets, posed)
    chosen = choose_keyframes(sees)
    [posed.images[row].name for row in chosen.rows]

A mask costs half a minute of a laptop, and of two panoramas half a metre apart the second says nothing new. What is to
be covered are the sides of stems (or, before any is known, of places where points are): each side of each wants to be
seen by two photos, because two votes make a point trunk. The greedy choice is the same in every run and never covers
less than 63 % of what the best one of as many photos would (Nemhauser et al. 1978: the gain is submodular).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float64, Int64, as_points, readonly
from dbh_studio.core.posed_images import PosedImages

# A photo sees a side of a stem up to this far from straight on: beyond, the bark is a sliver.
_HALF_SIDE_DEG = 50.0
_MAX_TARGETS = 4_000


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Photos in the order in which they add most.

    Attributes:
        rows: (K,) which photos; those given as `already` are not among them.
        covered: (K,) share (0..1) covered after each, of what all photos together can cover.
        covered_before: Share that the photos of `already` cover.
    """

    rows: Int64
    covered: Float64
    covered_before: float = 0.0

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def share(self) -> float:
        """Covered after all of them; 1 where there was nothing to cover."""
        return float(self.covered[-1]) if len(self.covered) else self.covered_before


def places_at_eye_height(
    points: Float,
    centres: Float,
    *,
    max_distance: float = 10.0,
    below: float = 1.2,
    above: float = 0.8,
    cell: float = 1.0,
) -> Float64:
    """(T, 3) places where points are at about the height of the nearest camera: stems, as long as none is known.

    Where no point is, the cameras' own places stand in.

    Args:
        points: (N, 3) a sample of the cloud, metres, +z up.
        centres: (V, 3) of the cameras.
        max_distance: Places farther from every camera are left out.
        below: So far below the camera is about breast height, where it was carried at eye height.
        above: So far above it.
        cell: One place for each upright cell of this edge.

    Raises:
        ValueError: Wrong shape.
    """
    cloud = as_points(points, name="points").astype(np.float64)
    cameras = as_points(centres, name="centres").astype(np.float64)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if not len(cloud) or not len(cameras):
        return cameras
    away, nearest = cKDTree(cameras[:, :2]).query(cloud[:, :2], distance_upper_bound=max_distance)
    is_near = np.isfinite(away)
    cloud, height = cloud[is_near], cloud[is_near, 2] - cameras[nearest[is_near], 2]
    cloud = cloud[(height >= -below) & (height <= above)]
    if not len(cloud):
        return cameras
    _, cells = np.unique(np.floor(cloud[:, :2] / cell), axis=0, return_inverse=True)
    cells = cells.reshape(-1)
    counts = np.bincount(cells)
    return np.column_stack([np.bincount(cells, cloud[:, axis]) / counts for axis in range(3)])


def sides_seen(targets: Float, posed: PosedImages, *, max_distance: float = 10.0, n_sides: int = 8) -> Bool:
    """Which photo sees which side of which target.

    What stands in between is not asked: it would need the masks that are still to be made.

    Args:
        targets: (T, 3) points on stems, or places; more than 4 000 are thinned evenly.
        posed: The photos, in the frame of the targets, +z up.
        max_distance: Beyond it a stem is too few pixels wide; in the unit of the targets.
        n_sides: Sides all round.

    Returns:
        (V, T * n_sides) of V photos.

    Raises:
        ValueError: Wrong shape.
    """
    points = as_points(targets, name="targets").astype(np.float64)
    if len(points) > _MAX_TARGETS:
        points = points[np.linspace(0, len(points) - 1, _MAX_TARGETS).astype(np.int64)]
    middles = (np.arange(n_sides) + 0.5) * (2.0 * np.pi / n_sides)
    facing = np.column_stack([np.cos(middles), np.sin(middles)])
    seen = np.zeros((len(posed), len(points), n_sides), bool)
    for index, photo in enumerate(posed):
        offset = photo.centre_src - points
        near = np.flatnonzero(np.linalg.norm(offset, axis=1) <= max_distance)
        near = near[photo.project(points[near])[1]]
        level = offset[near, :2]
        length = np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
        seen[index, near] = (level / length) @ facing.T >= np.cos(np.radians(_HALF_SIDE_DEG))
    return seen.reshape(len(posed), len(points) * n_sides)


def choose_keyframes(
    sees: Bool,
    *,
    already: Sequence[int] = (),
    budget: int | None = None,
    min_gain: float = 0.1,
    wanted_views: int = 2,
    may_choose: Bool | None = None,
) -> Keyframes:
    """Choose photos, each time the one that adds most; of equals the first.

    Args:
        sees: (V, C) which photo sees which side, from `sides_seen`.
        already: Photos that have a mask: what they cover adds nothing.
        budget: So many together with `already`; where all is covered before, sides are wanted once more, and again, so
            that the rest are spread, too. None chooses by `min_gain`.
        min_gain: Without a budget: stop where the next photo adds less than this share of what one shows on average.
        wanted_views: How often each side wants to be seen.
        may_choose: (V,) photos that can be chosen, such as those on the disk; None: all.

    Raises:
        ValueError: Wrong shape, or a negative budget.
    """
    matrix = np.asarray(sees, bool)
    if matrix.ndim != 2 or wanted_views < 1 or (budget is not None and budget < 0):
        raise ValueError(f"sees has shape {matrix.shape}, {wanted_views} views are wanted, budget {budget}")
    before = np.unique(np.asarray(already, np.int64))
    allowed = np.ones(len(matrix), bool) if may_choose is None else np.asarray(may_choose, bool).copy()
    usable = allowed.copy()
    usable[before] = True
    allowed[before] = False
    cover = _Cover(matrix, matrix[usable].sum(axis=0, dtype=np.int64), matrix[before].sum(axis=0, dtype=np.int64))
    cover.want(wanted_views)
    total, covered_before = cover.n_demanded, cover.share
    n_allowed = int(np.count_nonzero(allowed))
    most = n_allowed if budget is None else min(max(budget - len(before), 0), n_allowed)
    least = max(min_gain * float(matrix[usable].sum(axis=1).mean()), 1.0) if usable.any() else 1.0
    rows: list[int] = []
    covered: list[float] = []
    n_views = wanted_views
    while len(rows) < most:
        best = int(np.argmax(np.where(allowed, cover.gain, -1)))
        if budget is None and cover.gain[best] < least:
            break
        if cover.gain[best] == 0 and n_views < int(cover.possible.max(initial=0)):
            n_views += 1
            cover.want(n_views)
            continue
        allowed[best] = False
        cover.add(best)
        rows.append(best)
        covered.append(cover.share if n_views == wanted_views or not total else 1.0)
    return Keyframes(readonly(np.array(rows, np.int64)), readonly(np.array(covered, np.float64)), covered_before)


class _Cover:
    """How often each side was seen, how often it still wants to be, and what each photo would add.

    Args:
        matrix: (V, C) which photo sees which side.
        possible: (C,) by how many photos at most.
        seen: (C,) by how many already.
    """

    def __init__(self, matrix: Bool, possible: Int64, seen: Int64) -> None:
        self._matrix, self.possible, self._seen = matrix, possible, seen

    def want(self, n_views: int) -> None:
        """Ask so many photos for each side, or as many as can see it."""
        demand = np.minimum(self.possible, n_views)
        self.n_demanded = int(demand.sum())
        self._open = np.maximum(demand - self._seen, 0)
        self.gain = self._matrix[:, self._open > 0].sum(axis=1, dtype=np.int64)

    def add(self, row: int) -> None:
        """Count a photo."""
        adds = self._matrix[row] & (self._open > 0)
        self._seen = self._seen + self._matrix[row]
        self._open = self._open - adds
        # Each side is filled once, so that all updates together cost one pass over the matrix.
        self.gain = self.gain - self._matrix[:, adds & (self._open == 0)].sum(axis=1, dtype=np.int64)

    @property
    def share(self) -> float:
        """Of what is wanted, how much is there."""
        return 1.0 - int(self._open.sum()) / self.n_demanded if self.n_demanded else 1.0
