"""Neighbourhoods in a cloud: how dense it is, and which way its surface faces."""

from __future__ import annotations

import os

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Float, Float64, as_points
from dbh_studio.core.progress import Progress, ignore_progress

_CHUNK = 1 << 16
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
    distance = cKDTree(points).query(sample, k=[7], workers=N_WORKERS)[0]
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
    tree = cKDTree(points)
    padded = np.vstack([points, np.zeros((1, 3), points.dtype)])
    k = min(max_neighbours, len(points))
    for start in range(0, len(points), _CHUNK):
        progress(start / len(points), "Looking which way surfaces face")
        part = points[start : start + _CHUNK]
        index = tree.query(part, k=k, distance_upper_bound=radius, workers=N_WORKERS)[1]
        found = index < len(points)
        n = found.sum(axis=1)
        around = (padded[index] - part[:, None, :]).astype(np.float64)
        around *= found[:, :, None]
        covariance = _covariances(around, np.maximum(n, 1))
        values, vectors = np.linalg.eigh(covariance)
        normal = vectors[:, :, 0]
        share = np.maximum(values[:, 0], 0.0) / np.maximum(values.sum(axis=1), np.finfo(np.float64).tiny)
        # On a line the two smaller eigenvalues are both nothing, and no direction across it is the normal.
        undefined = (n < 3) | (values[:, 1] <= 1e-10 * values[:, 2])
        normal[undefined] = np.nan
        share[undefined] = np.nan
        normals[start : start + _CHUNK] = normal
        variation[start : start + _CHUNK] = share
    return normals, variation


def _covariances(around: Float64, n: np.ndarray) -> Float64:
    """(M, 3, 3) covariances of (M, k, 3) offsets of which n are real and the rest zero."""
    mean = around.sum(axis=1) / n[:, None]
    moments = np.matmul(around.transpose(0, 2, 1), around) / n[:, None, None]
    return np.asarray(moments - mean[:, :, None] * mean[:, None, :])
