"""Which points an edit of trunks concerns: cut by a plane or a drawn line, grown, shrunk, and who owns them.

Everything here is pure: it takes points and gives rows of them. Commands make edits of it (`app.edits`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float, Float64, Int32, Int64, as_points
from dbh_studio.core.picking import View
from dbh_studio.core.trunks import Trunk


def beyond_plane(points: Float, through: Any, normal: Any) -> Bool:
    """(N,) which of (N, 3) points lie on the side of a plane that its normal points to.

    Args:
        points: In any frame; what follows is in the same.
        through: (3,) a point of the plane.
        normal: (3,) of any length but zero.
    """
    points = as_points(points, name="points")
    direction = np.asarray(normal, np.float64).reshape(3)
    length = float(np.linalg.norm(direction))
    if not (np.isfinite(length) and length > 0):
        raise ValueError("the plane has no normal")
    place = np.asarray(through, np.float64).reshape(3)
    # About the place first: far from the origin the difference of two large numbers would lose the millimetres.
    beyond: Bool = (points - place) @ (direction / length) > 0
    return beyond


def plane_of_line(view: View, first_xy: Any, last_xy: Any) -> tuple[Float64, Float64]:
    """The plane that a line drawn on the screen cuts out of space: through the camera and both ends of the line.

    Args:
        view: The camera.
        first_xy: (2,) screen position 0..1 where the line begins.
        last_xy: (2,) where it ends.

    Returns:
        (3,) a point of the plane, the camera's place; (3,) its unit normal, to the right of somebody who walks up the
        line on the screen.

    Raises:
        ValueError: The line is too short to have a direction.
    """
    first, last = view.ray(first_xy), view.ray(last_xy)
    normal = np.cross(first, last)
    length = float(np.linalg.norm(normal))
    if length < 1e-6:
        raise ValueError("the line is too short")
    return np.asarray(view.origin, np.float64), np.asarray(normal / length, np.float64)


def n_beside_line(view: View, points: Float, first_xy: Any, last_xy: Any) -> tuple[int, int]:
    """How many points are seen on either side of a line on the screen, between its ends and square to it.

    Args:
        view: The camera; what is behind it is on neither side.
        points: (N, 3) in the camera's frame.
        first_xy: (2,) screen position 0..1 where the line begins.
        last_xy: (2,) where it ends, elsewhere.
    """
    square = np.array([view.aspect, 1.0])  # in which right angles are those of the picture
    first, last = (np.asarray(end, np.float64) * square for end in (first_xy, last_xy))
    along = last - first
    off = view.project(points) * square - first
    part = off @ along / float(along @ along)
    across = off @ np.array([-along[1], along[0]])
    is_beside = (part >= 0.0) & (part <= 1.0)
    return int((is_beside & (across > 0)).sum()), int((is_beside & (across <= 0)).sum())


def grown(points: Float, members: NDArray[Any], free: NDArray[Any], distance: float) -> Int64:
    """(K,) those rows of `free` that are within `distance` of a member.

    Args:
        points: (N, 3) all points.
        members: (M,) rows of the trunk.
        free: (F,) rows that may join, in any number: only those in the members' box are looked at closely.
        distance: In the points' unit.
    """
    points = as_points(points, name="points")
    members, free = np.asarray(members, np.int64), np.asarray(free, np.int64)
    if not len(members) or not len(free) or not distance > 0:
        return np.empty(0, np.int64)
    own = points[members]
    rows = free[_in_box(points[free], own.min(axis=0) - distance, own.max(axis=0) + distance)]
    if not len(rows):
        return np.empty(0, np.int64)
    from scipy.spatial import cKDTree  # slow to import, and who owns which points is asked without it

    from dbh_studio.core.neighbours import N_WORKERS

    tree = cKDTree(own, balanced_tree=False, compact_nodes=False)
    gap = tree.query(points[rows], distance_upper_bound=distance, workers=N_WORKERS)[0]
    return np.asarray(rows[np.isfinite(gap)])


def shrunk(points: Float, members: NDArray[Any], others: NDArray[Any], distance: float, *, least: int = 8) -> Int64:
    """(K,) those members that stay when the rim goes: near to points of others, or nearly alone.

    Args:
        points: (N, 3) all points.
        members: (M,) rows of the trunk.
        others: (F,) rows that are not of it.
        distance: So near to another point is the rim, in the points' unit.
        least: Members within `distance` of a member, itself among them, that keep it from being alone.
    """
    points = as_points(points, name="points")
    members, others = np.asarray(members, np.int64), np.asarray(others, np.int64)
    if not len(members) or not distance > 0:
        return members
    from scipy.spatial import cKDTree

    from dbh_studio.core.neighbours import N_WORKERS

    own = points[members]
    near = others[_in_box(points[others], own.min(axis=0) - distance, own.max(axis=0) + distance)]
    stays = np.ones(len(members), bool)
    if len(near):
        tree = cKDTree(points[near], balanced_tree=False, compact_nodes=False)
        gap = tree.query(own, distance_upper_bound=distance, workers=N_WORKERS)[0]
        stays = ~np.isfinite(gap)
    tree = cKDTree(own, balanced_tree=False, compact_nodes=False)
    # The k-th neighbour says whether there are k: far cheaper than counting them all.
    if len(own) >= least:
        kth = tree.query(own, k=[least], distance_upper_bound=distance, workers=N_WORKERS)[0][:, 0]
        stays &= np.isfinite(kth)
    return np.asarray(members[stays])


def in_order(*parts: NDArray[Any]) -> Int32:
    """(K,) int32, the indices of all parts, ascending, each once.

    As `np.unique`, which takes many times as long where each part is in order already.

    Args:
        parts: (N,) indices into the cloud each, in any order.
    """
    together = np.concatenate([np.asarray(part, np.int32) for part in parts]) if parts else np.empty(0, np.int32)
    if (together[1:] > together[:-1]).all():
        return together
    together = np.sort(together, kind="stable")
    is_first = np.ones(len(together), bool)
    is_first[1:] = together[1:] != together[:-1]
    return np.asarray(together[is_first], np.int32)


def owners(trunks: Iterable[Trunk], points: NDArray[Any], n_points: int) -> dict[int, Int32]:
    """Trunk id → which of the given points are its own, sorted; trunks that have none are left out.

    Args:
        trunks: Disjoint.
        points: (K,) indices into the cloud.
        n_points: How many points the cloud has.
    """
    asked = np.zeros(n_points, bool)
    asked[points] = True
    found = {}
    for trunk in trunks:
        shared = trunk.points[asked[trunk.points]]
        if len(shared):
            found[trunk.id] = shared
    return found


def _in_box(points: Float, lower: Any, upper: Any) -> Bool:
    inside = np.ones(len(points), bool)
    for axis in range(3):
        # A comparison with NaN is False: a point without a place is in no box.
        inside &= (points[:, axis] >= lower[axis]) & (points[:, axis] <= upper[axis])
    return inside
