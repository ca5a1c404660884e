"""The paper's ground: the dominant plane, by RANSAC."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float, Float64
from dbh_studio.core.progress import Progress, ignore_progress

# Planes are compared on so many points, and refined on all of them in parts of this size.
_SAMPLE = 60_000
_CHUNK = 1 << 19
_BATCH = 25


def fit_plane_ransac(
    points: Float,
    *,
    tolerance_m: float,
    n_iterations: int,
    max_slope_deg: float = 90.0,
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> tuple[Float64, int]:
    """The plane z = a·x + b·y + c that most points are near.

    Three points make a plane; the one with most points within `tolerance_m` (across the plane) wins and is refined by
    least squares on its inliers (paper, "Ground Plane Removal and Normal Filtering"). Steeper planes than
    `max_slope_deg` are walls of stems or of crowns, not ground, and are not considered.

    Args:
        points: (N, 3) points, metres, +z up.
        tolerance_m: Points this near the plane support it.
        n_iterations: Planes tried.
        max_slope_deg: Of the planes considered.
        progress: Called between batches.
        seed: Of the samples.

    Returns:
        (3,) a, b, c and the number of points that support the plane. One or two points make none: the plane is flat,
        through the lower one, and the number says so.

    Raises:
        ValueError: No finite point.
    """
    finite = points[np.isfinite(points).all(axis=1)] if not np.isfinite(points.sum(dtype=np.float64)) else points
    if not len(finite):
        raise ValueError("the cloud has no finite point to fit a plane to")
    if len(finite) < 3:
        return np.array([0.0, 0.0, float(finite[:, 2].min())]), len(finite)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(finite), min(len(finite), _SAMPLE), replace=False)
    sample = finite[np.sort(chosen)].astype(np.float64)
    centre = sample.mean(axis=0)
    sample -= centre
    best, best_count = np.zeros(3), -1
    for start in range(0, n_iterations, _BATCH):
        progress(0.8 * start / n_iterations, "Fitting the ground plane")
        planes = _random_planes(sample, min(_BATCH, n_iterations - start), max_slope_deg, rng)
        counts = [_n_near(sample, plane, tolerance_m) for plane in planes]
        if counts and max(counts) > best_count:
            best, best_count = planes[int(np.argmax(counts))], max(counts)
    plane, n_inliers = best, 0
    for round_ in range(3):
        progress(0.8 + 0.06 * round_, "Refining the ground plane")
        plane, n_inliers = _refined(finite, centre, plane, tolerance_m)
    return np.array([plane[0], plane[1], plane[2] + centre[2] - plane[:2] @ centre[:2]]), n_inliers


def _random_planes(sample: Float64, n_planes: int, max_slope_deg: float, rng: np.random.Generator) -> Float64:
    """(M, 3) planes through three random points each, M <= n_planes: vertical and too steep ones are left out."""
    corners = sample[rng.integers(0, len(sample), (n_planes, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    steep = np.hypot(normal[:, 0], normal[:, 1]) > np.tan(np.radians(min(max_slope_deg, 89.0))) * np.abs(normal[:, 2])
    usable = ~steep & (np.abs(normal[:, 2]) > 1e-12)
    normal, first = normal[usable], corners[usable, 0]
    slopes = -normal[:, :2] / normal[:, 2:]
    return np.column_stack([slopes, first[:, 2] - np.einsum("ij,ij->i", slopes, first[:, :2])])


def _n_near(sample: Float64, plane: Float64, tolerance_m: float) -> int:
    residual = sample[:, 2] - (sample[:, :2] @ plane[:2] + plane[2])
    return int(np.count_nonzero(np.abs(residual) <= tolerance_m * np.sqrt(1.0 + plane[:2] @ plane[:2])))


def _refined(points: Float, centre: Float64, plane: Float64, tolerance_m: float) -> tuple[Float64, int]:
    """Least squares on the points near `plane` (in coordinates about `centre`), by sums over chunks."""
    normal_matrix, right_side, n_inliers = np.zeros((3, 3)), np.zeros(3), 0
    limit = tolerance_m * np.sqrt(1.0 + plane[:2] @ plane[:2])
    for start in range(0, len(points), _CHUNK):
        local = points[start : start + _CHUNK] - centre
        near = np.abs(local[:, 2] - (local[:, :2] @ plane[:2] + plane[2])) <= limit
        design = np.column_stack([local[near, :2], np.ones(np.count_nonzero(near))])
        normal_matrix += design.T @ design
        right_side += design.T @ local[near, 2]
        n_inliers += len(design)
    if n_inliers < 3:
        return plane, n_inliers
    return np.asarray(np.linalg.lstsq(normal_matrix, right_side, rcond=None)[0], np.float64), n_inliers
