"""Where rays from several photos meet: for corners clicked by hand and for the corners of markers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import Bool, Float64, as_points, readonly
from dbh_studio.core.dbh import Refusal

_MAX_PAIRS = 400
_REJECT_SIGMA = 4.0
_HUBER_SIGMA = 1.5
_ITERATIONS = 30
_ROUNDS = 5
SMALLEST_PARALLAX_DEG = 1.0


@dataclass(frozen=True, eq=False)
class Triangulated:
    """A point seen by several rays.

    Attributes:
        point: (3,) in the frame of the origins.
        covariance: (3, 3); scaled up where the rays miss each other by more than `sigma_rad` says.
        residuals_rad: (N,) angle between each ray and the direction to the point.
        inliers: (N,) the rays used.
        parallax_deg: Largest angle between two of the rays used; below 5° the distance is weak.
    """

    point: Float64
    covariance: Float64
    residuals_rad: Float64
    inliers: Bool
    parallax_deg: float


def triangulate(origins: ArrayLike, directions: ArrayLike, sigma_rad: ArrayLike) -> Triangulated | Refusal:
    """The point nearest to the rays, by angle.

    Pairs of rays propose points; the one most rays agree with starts a least-squares solution with Huber weights, from
    which rays farther off than four sigmas are left out; fewer than two that are not make a refusal.

    Args:
        origins: (N, 3) centres of the cameras, or (3,) for all.
        directions: (N, 3), need not be of unit length.
        sigma_rad: Standard error of the directions: a number or (N,).

    Returns:
        The point, or a refusal: ``one_view``, ``bad_ray``, ``parallel``, ``behind`` or ``disagree``.
    """
    rays = as_points(directions, name="directions").astype(np.float64)
    starts = np.broadcast_to(np.asarray(origins, np.float64), rays.shape)
    sigma = np.broadcast_to(np.asarray(sigma_rad, np.float64), len(rays))
    if not (sigma > 0).all():
        raise ValueError("sigma_rad must be positive")
    refusal = _unusable(starts, rays)
    if refusal is not None:
        return refusal
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    # About the cameras' middle, so that coordinates of a survey keep their digits.
    middle = starts.mean(axis=0)
    starts = starts - middle
    inliers = _consensus(starts, rays, sigma)
    if inliers.sum() < 2:
        return _disagree(len(rays))
    for _ in range(_ROUNDS):
        parallax_deg = parallax(rays[inliers])
        if parallax_deg < SMALLEST_PARALLAX_DEG:
            return _parallel(parallax_deg)
        point, weights = refine_point(starts, rays, inliers / sigma**2)
        residuals = angles_to(point, starts, rays)
        kept = residuals < _REJECT_SIGMA * sigma
        if kept.sum() < 2:
            # Two rays always have a nearest point. That they meet there is what makes it one.
            return _behind() if (residuals[inliers] > np.pi / 2).any() else _disagree(len(rays))
        if (kept == inliers).all():
            break
        inliers = kept
    if (np.einsum("ij,ij->i", point - starts[inliers], rays[inliers]) <= 0).any():
        return _behind()
    covariance = _covariance(point, starts, rays, weights, residuals, sigma, inliers)
    return Triangulated(
        readonly(point + middle), readonly(covariance), readonly(residuals), readonly(inliers), parallax_deg
    )


def _unusable(starts: Float64, rays: Float64) -> Refusal | None:
    if len(rays) < 2:
        return Refusal("one_view", f"The point is seen in {len(rays)} photo only.", "Mark it in two or more photos.")
    if not (np.isfinite(rays).all() and np.isfinite(starts).all() and (np.linalg.norm(rays, axis=1) > 0).all()):
        return Refusal("bad_ray", "A photo has no direction for its pixel.", "Mark the point inside the photo.")
    if np.ptp(starts, axis=0).max() <= 1e-12 * max(1.0, float(np.abs(starts).max())):
        return Refusal("parallel", "All views are from the same place.", "Use photos taken farther apart.")
    return None


def _parallel(parallax_deg: float) -> Refusal:
    return Refusal(
        "parallel",
        f"The views look at the point from nearly one direction ({parallax_deg:.2f}° apart).",
        "Use photos taken farther apart.",
    )


def _disagree(n: int) -> Refusal:
    return Refusal(
        "disagree",
        f"No two of the {n} views look at the same point." if n > 2 else "The two views look at different points.",
        "Check that the same corner was marked in each photo, and that the poses belong to these photos.",
    )


def _behind() -> Refusal:
    return Refusal(
        "behind",
        "The rays meet behind a camera.",
        "Check that the same corner was marked in each photo, and that the poses are not mirrored.",
    )


def parallax(rays: Float64) -> float:
    """Largest angle, degrees, between two of (N, 3) unit rays."""
    if len(rays) < 2:
        return 0.0
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))


def angles_to(point: Float64, starts: Float64, rays: Float64) -> Float64:
    """(N,) angle, radians, between each unit ray and the direction to the point."""
    towards = point - starts
    across = np.linalg.norm(np.cross(rays, towards), axis=1)
    return np.asarray(np.arctan2(across, np.einsum("ij,ij->i", towards, rays)))


def _projectors(rays: Float64) -> Float64:
    return np.asarray(np.eye(3) - rays[:, :, None] * rays[:, None, :])


def linear_point(starts: Float64, rays: Float64, weights: Float64) -> Float64:
    """(3,) the point with the least weighted sum of squared distances to the lines.

    Raises:
        numpy.linalg.LinAlgError: The lines are parallel.
    """
    across = weights[:, None, None] * _projectors(rays)
    return np.asarray(np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, starts)))


def refine_point(
    starts: Float64, rays: Float64, weights: Float64, *, huber_sigma: float = _HUBER_SIGMA
) -> tuple[Float64, Float64]:
    """The point with the least weighted angles, and the final weights of squared *distances*.

    Args:
        starts: (N, 3).
        rays: (N, 3) unit.
        weights: (N,) one over the variance of each ray's angle; 0 leaves a ray out.
        huber_sigma: Rays farther off weigh less; infinity: none does.
    """
    point = linear_point(starts, rays, weights)
    per_distance = weights
    for _ in range(_ITERATIONS):
        reach = np.maximum(np.linalg.norm(point - starts, axis=1), 1e-12)
        scaled = angles_to(point, starts, rays) * np.sqrt(weights)
        huber = np.minimum(1.0, huber_sigma / np.maximum(scaled, 1e-12))
        # An angle is a distance across the ray over the reach.
        per_distance = huber * weights / reach**2
        moved = linear_point(starts, rays, per_distance)
        done = np.linalg.norm(moved - point) < 1e-10 * reach.max()
        point = moved
        if done:
            break
    return point, per_distance


def _pairs(n: int) -> list[tuple[int, int]]:
    pairs = list(combinations(range(n), 2))
    if len(pairs) <= _MAX_PAIRS:
        return pairs
    return [pairs[i] for i in np.random.default_rng(0).choice(len(pairs), _MAX_PAIRS, replace=False)]


def _consensus(starts: Float64, rays: Float64, sigma: Float64) -> Bool:
    """(N,) the rays that agree with the pair most others agree with."""
    if len(rays) == 2:
        return np.ones(2, bool)
    best, best_score = np.zeros(len(rays), bool), -np.inf
    for pair in _pairs(len(rays)):
        chosen = list(pair)
        if parallax(rays[chosen]) < SMALLEST_PARALLAX_DEG / 2:
            continue
        try:
            point = linear_point(starts[chosen], rays[chosen], np.ones(2))
        except np.linalg.LinAlgError:
            continue
        scaled = angles_to(point, starts, rays) / (_REJECT_SIGMA * sigma)
        # How many, and among equals how well.
        score = float(np.maximum(1 - scaled**2, 0).sum())
        if score > best_score:
            best, best_score = scaled < 1, score
    if not best.any():
        # No pair has parallax: let the caller say so.
        best[:] = parallax(rays) < SMALLEST_PARALLAX_DEG
    return best


def _covariance(
    point: Float64,
    starts: Float64,
    rays: Float64,
    weights: Float64,
    residuals: Float64,
    sigma: Float64,
    inliers: Bool,
) -> Float64:
    normal = (weights[:, None, None] * _projectors(rays)).sum(axis=0)
    # Each ray measures two angles; three numbers are solved for.
    freedom = 2 * int(inliers.sum()) - 3
    excess = float(((residuals[inliers] / sigma[inliers]) ** 2).sum()) / freedom
    return np.asarray(np.linalg.inv(normal) * max(1.0, excess))
