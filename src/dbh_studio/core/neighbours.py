"""Neighbourhoods in a cloud: how dense it is, and which way its surface faces."""

from __future__ import annotations

import os

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Float, Float64, Int64, as_points
from dbh_studio.core.progress import Progress, ignore_progress

_CHUNK = 1 << 16
# So many neighbourhoods at a time stay in the processor's own memory, which is several times quicker.
_IN_CACHE = 1 << 12
# Two threads are there on any machine; more only help large clouds.
N_WORKERS = min(4, os.cpu_count() or 1)


def point_spacing(points: Float, *, n_sample: int = 2000, seed: int = 0) -> float:
    """Typical distance between neighbours on a surface, in the points' unit.

    The median over a sample of the distance to the sixth neighbour, over √2: on a square grid of spacing s the fifth
    to eighth neighbours are at s·√2. NaN for fewer than seven points.
    """
    points = as_points(points, name="points")
    if len(points) < 7:
        return float("nan")
    rng = np.random.default_rng(seed)
    sample = points[rng.choice(len(points), min(n_sample, len(points)), replace=False)]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)  # built in half the time, and rarely asked
    distance = tree.query(sample, k=[7], workers=N_WORKERS)[0]
    return float(np.median(distance) / np.sqrt(2.0))


def surface_normals(
    points: Float, *, radius: float, max_neighbours: int = 30, progress: Progress = ignore_progress
) -> tuple[Float64, Float64]:
    """Normal of the local surface at every point, and how flat the surface is.

    The covariance of the at most `max_neighbours` nearest points within `radius` (the point itself among them), of
    which the eigenvector of the smallest eigenvalue is the normal: Open3D's hybrid search. The sign is not defined.

    Args:
        points: (N, 3) points.
        radius: Of the neighbourhood, in the points' unit.
        max_neighbours: Bound on its size, so that dense clouds stay quick.
        progress: Called between chunks.

    Returns:
        (N, 3) unit normals, NaN with fewer than three neighbours or where they lie on a line; and (N,) surface
        variation λ₀/(λ₀+λ₁+λ₂), 0 on a plane and 1/3 in a ball (Pauly et al. 2002).
    """
    points = as_points(points, name="points")
    normals = np.full((len(points), 3), np.nan)
    variation = np.full(len(points), np.nan)
    if len(points) < 3:
        return normals, variation
    # Neither balanced nor compact: built in half the time, and as quick to search.
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    # One more at the end stands for "no neighbour".
    columns = [np.append(points[:, axis], points.dtype.type(0)) for axis in range(3)]
    k = min(max_neighbours, len(points))
    for start in range(0, len(points), _CHUNK):
        progress(start / len(points), "Looking which way surfaces face")
        index = tree.query(points[start : start + _CHUNK], k=k, distance_upper_bound=radius, workers=N_WORKERS)[1]
        for first in range(0, len(index), _IN_CACHE):
            rows = slice(start + first, start + min(first + _IN_CACHE, len(index)))
            covariance, n = _covariances(columns, index[first : first + _IN_CACHE], rows)
            values, vectors = np.linalg.eigh(covariance)
            normal = vectors[:, :, 0]
            share = np.maximum(values[:, 0], 0.0) / np.maximum(values.sum(axis=1), np.finfo(np.float64).tiny)
            # On a line the two smaller eigenvalues are both nothing, and no direction across it is the normal.
            undefined = (n < 3) | (values[:, 1] <= 1e-10 * values[:, 2])
            normal[undefined] = np.nan
            share[undefined] = np.nan
            normals[rows] = normal
            variation[rows] = share
    return normals, variation


def _covariances(columns: list[Float], index: Int64, rows: slice) -> tuple[Float64, Int64]:
    """(M, 3, 3) covariances of the (M, k) neighbours of the points in `rows`, and (M,) how many neighbours each has."""
    found = index < len(columns[0]) - 1
    n = found.sum(axis=1)
    every = bool(n.min() == index.shape[1])
    # About the point itself, coordinate by coordinate; what is no neighbour counts as the point, whose offset is zero.
    offsets = []
    for column in columns:
        offset = (column[index] - column[rows, None]).astype(np.float64)
        offsets.append(offset if every else offset * found)
    at_least_one = np.maximum(n, 1)
    means = [offset.sum(axis=1) / at_least_one for offset in offsets]
    covariance = np.empty((len(index), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            moment = np.einsum("mk,mk->m", offsets[i], offsets[j]) / at_least_one
            covariance[:, i, j] = covariance[:, j, i] = moment - means[i] * means[j]
    return covariance, n
