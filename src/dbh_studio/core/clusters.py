"""DBSCAN on weighted points (Ester et al. 1996), through sparse connected components."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Int32, as_points
from dbh_studio.core.neighbours import N_WORKERS

NOISE = -1


def dbscan(points: Float, *, distance: float, min_points: int, weights: NDArray[Any] | None = None) -> Int32:
    """Density-based clusters.

    A point is a core point if the weights within `distance` of it, itself included, add up to `min_points`. Core points
    within `distance` of each other share a cluster; other points within reach of a core point join the nearest one.
    With unit weights this is DBSCAN as in Open3D and scikit-learn, except that a border point between two clusters goes
    to the nearer one and not to the first found, so that the result does not depend on the points' order.

    Memory grows with the number of neighbour pairs: thin dense clouds first and pass the counts as weights.

    Args:
        points: (N, 3) or (N, 2) points.
        distance: Reach, in the points' unit.
        min_points: Weight that makes a core point.
        weights: (N,) how many points each stands for; 1 by default.

    Returns:
        (N,) cluster number in order of first appearance, `NOISE` where none.
    """
    points = as_points(points, name="points", n_columns=np.shape(points)[1] if np.ndim(points) == 2 else 3)
    n = len(points)
    if not n:
        return np.empty(0, np.int32)
    weight = np.ones(n) if weights is None else np.asarray(weights, np.float64)
    # Neither balanced nor compact: built in half the time, and as quick to search.
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    # Halved indices at once: there may be many times more pairs than points.
    first, second = tree.query_pairs(distance, output_type="ndarray").astype(np.int32).T
    density = weight + np.bincount(first, weight[second], n) + np.bincount(second, weight[first], n)
    is_core = density >= min_points
    component = _components(first, second, is_core)
    labels = np.where(is_core, component, NOISE)
    border = np.flatnonzero(~is_core)
    if is_core.any() and len(border):
        core = np.flatnonzero(is_core)
        reach, nearest = cKDTree(points[core]).query(points[border], workers=N_WORKERS)
        reached = reach <= distance
        labels[border[reached]] = component[core[nearest[reached]]]
    return _in_order_of_appearance(labels)


def _components(first: NDArray[Any], second: NDArray[Any], is_core: Bool) -> Int32:
    """(N,) number of the connected component of every point, where pairs of core points are connected."""
    if not is_core.all():
        joined = is_core[first] & is_core[second]
        first, second = first[joined], second[joined]
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(is_core), len(is_core)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _in_order_of_appearance(labels: NDArray[Any]) -> Int32:
    """Renumber 0, 1, … by each label's first row; `NOISE` stays."""
    kept = np.flatnonzero(labels != NOISE)
    first = np.full(int(labels.max(initial=NOISE)) + 1, len(labels), np.int64)
    first[labels[kept[::-1]]] = kept[::-1]  # the last assignment, of the first row, stays
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first), dtype=np.int32)
    ordered = np.full(len(labels), NOISE, np.int32)
    ordered[kept] = rank[labels[kept]]
    return ordered
