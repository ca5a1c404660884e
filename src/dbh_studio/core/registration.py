"""Fine registration of a cloud on another: point to plane, robust, with or without a change of scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float64, as_points
from dbh_studio.core.neighbours import N_WORKERS, surface_normals
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.transforms import Similarity

# Directions in which the surfaces hold a motion this much less than in others are left as they were.
_WEAK = 1e-4
_SETTLED_M = 2e-5


@dataclass(frozen=True, eq=False)
class Refined:
    """What fine registration made of a first guess.

    Attributes:
        target_from_source: The refined similarity.
        rms_m: Of the distances along the target's normals, of the pairs kept; NaN without pairs.
        share_near: Share of the source points that lie within the last reach of a target point.
        n_free: Of the 6 or 7 ways to move, in how many the surfaces hold the cloud.
        settled: Whether the last step was negligible.
    """

    target_from_source: Similarity
    rms_m: float
    share_near: float
    n_free: int
    settled: bool


def refine(
    source: Float64,
    target: Float64,
    start: Similarity,
    *,
    with_scale: bool,
    reach_m: tuple[float, float] = (0.5, 0.08),
    normal_radius_m: float = 0.15,
    steps: int = 40,
    progress: Progress = ignore_progress,
) -> Refined:
    """Iterate closest points, point to plane (Chen and Medioni 1992), with Tukey's weights.

    Args:
        source: (N, 3) points of what does not move between the two: stems and ground. Some ten thousand are enough.
        target: (M, 3) likewise, metres; its normals are computed here.
        start: A first guess, right to about the first reach.
        with_scale: Whether the scale may change.
        reach_m: Pairs farther apart do not count: at first, and in the end. It shrinks by a factor at each step.
        normal_radius_m: Neighbourhood of a normal.
        steps: At most so many.
        progress: Called at each step.

    Raises:
        ValueError: Wrong shape, or fewer than 10 points.
    """
    moving = as_points(source, name="source").astype(np.float64)
    fixed = as_points(target, name="target").astype(np.float64)
    if min(len(moving), len(fixed)) < 10:
        raise ValueError(f"{len(moving)} and {len(fixed)} points; at least ten each are needed")
    normals, _ = surface_normals(fixed, radius=normal_radius_m)
    usable = np.isfinite(normals).all(axis=1)
    fixed, normals = fixed[usable], normals[usable]
    tree = cKDTree(fixed)
    now, reach, factor = start, reach_m[0], (reach_m[1] / reach_m[0]) ** (2.0 / steps)
    rms, share, n_free, settled = float("nan"), 0.0, 0, False
    for step in range(steps):
        progress(step / steps, "Fitting the surfaces on each other")
        placed = np.asarray(now.apply(moving), np.float64)
        distance, index = tree.query(placed, distance_upper_bound=reach, workers=N_WORKERS)
        near = np.isfinite(distance)
        share = float(near.mean())
        if near.sum() < 10:
            break
        motion, rms, n_free = _step(placed[near], fixed[index[near]], normals[index[near]], with_scale)
        now = motion @ now
        moved = float(np.abs(motion.apply(placed) - placed).max())
        settled = moved < _SETTLED_M
        if settled and reach <= reach_m[1] * 1.001:
            break
        reach = max(reach * factor, reach_m[1])
    return Refined(now, rms, share, n_free, settled)


def _step(points: Float64, onto: Float64, normals: Float64, with_scale: bool) -> tuple[Similarity, float, int]:
    """The small motion of least weighted squares, the rms after weighting, and in how many ways it was determined."""
    centre = points.mean(axis=0)
    arm = points - centre
    # In units of the cloud's size turns, shifts and scale weigh alike, and weak directions can be told.
    size = max(float(np.sqrt((arm**2).sum(axis=1).mean())), 1e-9)
    columns = [np.cross(arm, normals) / size, normals]
    if with_scale:
        columns.append((arm * normals).sum(axis=1, keepdims=True) / size)
    a = np.hstack(columns)
    b = ((onto - points) * normals).sum(axis=1)
    weights = _tukey(b)
    matrix = (a * weights[:, None]).T @ a / weights.sum()
    values, vectors = np.linalg.eigh(matrix)
    strong: Bool = values > _WEAK * values[-1]
    right = vectors.T @ ((a * weights[:, None]).T @ b / weights.sum())
    x = vectors @ np.where(strong, right / np.maximum(values, 1e-300), 0.0)
    turn = _rotation(x[:3] / size)
    scale = float(np.exp(x[6] / size)) if with_scale else 1.0
    motion = Similarity(turn, centre + x[3:6] - scale * turn @ centre, scale)
    rms = float(np.sqrt((weights * b * b).sum() / weights.sum()))
    return motion, rms, int(strong.sum())


def _tukey(residuals: Float64) -> Float64:
    """(N,) weights: 1 for the fitting, 0 beyond 4.7 robust sigmas."""
    sigma = max(1.4826 * float(np.median(np.abs(residuals))), 1e-4)
    share = np.minimum(np.abs(residuals) / (4.685 * sigma), 1.0)
    return np.asarray((1.0 - share**2) ** 2)


def _rotation(vector: Float64) -> Float64:
    """(3, 3) turn about a vector by its length, radians."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)
