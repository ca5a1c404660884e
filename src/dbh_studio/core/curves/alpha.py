"""Outer boundary of the alpha shape (Edelsbrunner, Kirkpatrick and Seidel 1983) of many small point sets at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from dbh_studio.core.arrays import Bool, Float64, Int64


def alpha_boundaries(point_sets: Sequence[Float64], *, radius: float) -> tuple[Float64, Bool]:
    """The largest outer loop of every set's alpha shape, counter-clockwise.

    Delaunay triangles whose circumradius is below `radius` are the shape. Only the triangulations are one call per set;
    edges, loops and areas of all sets are found together.

    Args:
        point_sets: H arrays (Kᵢ, 2).
        radius: Of the disc that may not enter the shape, in the points' unit.

    Returns:
        (H, L, 2) loops, padded with zeros, and (H, L) which entries are vertices: none where a set has no shape.
    """
    triangles, points, set_of = _triangulate(point_sets)
    n_sets = len(point_sets)
    start, end = _boundary_edges(points, triangles, radius)
    if not len(start):
        return np.zeros((n_sets, 0, 2)), np.zeros((n_sets, 0), bool)
    following = _next_edges(points, start, end)
    first, length = _largest_loops(points, start, end, following, set_of, n_sets)
    loops = np.zeros((n_sets, int(length.max()), 2))
    valid = np.arange(loops.shape[1]) < length[:, None]
    edge = np.maximum(first, 0)
    for step in range(loops.shape[1]):  # along the loops, all sets abreast
        loops[:, step] = points[start[edge]]
        edge = following[edge]
    loops[~valid] = 0.0
    return loops, valid


def _triangulate(point_sets: Sequence[Float64]) -> tuple[Int64, Float64, Int64]:
    """Counter-clockwise triangles (T, 3) into the stacked points, the points, and the set of each point."""
    offsets = np.cumsum([0, *(len(points) for points in point_sets)])
    found = [np.empty((0, 3), np.int64)]
    for points, offset in zip(point_sets, offsets, strict=False):
        if len(points) >= 3:
            triangles = _delaunay(points)
            if triangles is not None:  # else all are on one line: no triangle, so no shape
                found.append(triangles + offset)
    triangles = np.concatenate(found)
    stacked = np.concatenate([np.empty((0, 2)), *point_sets])
    turned = _doubled_area(stacked, triangles) < 0
    triangles[turned] = triangles[turned][:, ::-1]
    set_of = np.repeat(np.arange(len(point_sets)), np.diff(offsets))
    return triangles, stacked, set_of


def _delaunay(points: Float64) -> Int64 | None:
    """(T, 3) Delaunay triangles of (K, 2) points; None where these are on one line."""
    # The first without the point at infinity: a quarter quicker, but points on one circle fail.
    for options in ("Qbb Qc Q12", "Qbb Qc Qz Q12"):
        try:
            return Delaunay(points, qhull_options=options).simplices.astype(np.int64)
        except QhullError:
            continue
    return None


def _doubled_area(points: Float64, triangles: Int64) -> Float64:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    area: Float64 = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return area


def _boundary_edges(points: Float64, triangles: Int64, radius: float) -> tuple[Int64, Int64]:
    """Directed edges with the shape on their left and nothing on their right."""
    corners = points[triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    lengths = np.hypot(sides[..., 0], sides[..., 1])
    kept = triangles[lengths.prod(axis=1) < 2.0 * radius * _doubled_area(points, triangles)]
    start, end = kept.ravel(), np.roll(kept, -1, axis=1).ravel()
    if not len(start):
        return start, end
    # An edge inside the shape is there twice, once in each direction.
    key = np.minimum(start, end) * np.int64(len(points)) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    differs = np.concatenate([[True], np.diff(key[order]) != 0, [True]])
    alone = order[differs[1:] & differs[:-1]]
    return start[alone], end[alone]


def _next_edges(points: Float64, start: Int64, end: Int64) -> Int64:
    """(E,) the edge that follows each on its loop.

    Where loops touch in a vertex, the follower is the first outgoing edge counter-clockwise from the way back: that
    walk keeps the empty side on its right.
    """
    away = points[end] - points[start]
    turn = (np.arctan2(away[:, 1], away[:, 0]) + np.pi) / 7.0
    order = np.argsort(start + turn, kind="stable")
    key, sorted_start = (start + turn)[order], start[order]
    back = (np.arctan2(-away[:, 1], -away[:, 0]) + np.pi) / 7.0
    position = np.searchsorted(key, end + back, side="right")
    low, high = np.searchsorted(sorted_start, end, side="left"), np.searchsorted(sorted_start, end, side="right")
    following: Int64 = order[np.where(position < high, position, low)]
    return following


def _largest_loops(
    points: Float64, start: Int64, end: Int64, following: Int64, set_of: Int64, n_sets: int
) -> tuple[Int64, Int64]:
    """One edge of each set's loop of largest area (-1: none), and how many edges that loop has."""
    n_edges = len(start)
    links = coo_array((np.ones(n_edges), (np.arange(n_edges), following)), shape=(n_edges, n_edges))
    n_loops, loop_of = connected_components(links, directed=False)
    a, b = points[start], points[end]
    area = np.bincount(loop_of, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], minlength=n_loops)
    size = np.bincount(loop_of, minlength=n_loops)
    an_edge = np.empty(n_loops, np.int64)
    an_edge[loop_of] = np.arange(n_edges)
    first, length = np.full(n_sets, -1, np.int64), np.zeros(n_sets, np.int64)
    ascending = np.argsort(area, kind="stable")
    owner = set_of[start[an_edge[ascending]]]
    first[owner] = an_edge[ascending]  # the last assignment, of the largest area, stays
    length[owner] = size[ascending]
    return first, length
