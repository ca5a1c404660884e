"""The corners of a marker from the photos that agree on it: where it is from its middle, how large from its shape.

An error of a camera's direction moves all four corners alike. The middle is therefore placed first, by the rays to
where the diagonals cross; each photo's rays are then turned so that its middle is right, and only then do they say
where the corners are. What is left of a pose's error is that a camera a millimetre too near sees the marker too large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.triangulation import SMALLEST_PARALLAX_DEG, linear_point, parallax
from dbh_studio.stages.marker_sizes import SizeWeights, weigh_sizes

_ROUNDS = 3
_SMALLEST_SHARE = 1e-3
# Numbers of nearest photos to try; fewer than five hang on a single pose.
_FEWEST = 5
_GROWTH = 1.3
# Standard errors are not known better than this; among alike the nearer photos are safer.
_WORTH_MORE = 1.2
_FEW = 4


@dataclass(frozen=True, eq=False)
class PlacedCorners:
    """The corners and how well they are known.

    Attributes:
        corners: (4, 3).
        covariance: (12, 12) from the spread over the photos and the noise of the pixels.
        chosen: (K,) indices of the photos used.
        weights: What each of them weighs, and what they share.
        size_sigma: Standard error of the size from scatter, as a share.
    """

    corners: Float64
    covariance: Float64
    chosen: NDArray[np.int64]
    weights: SizeWeights
    size_sigma: float


@dataclass(frozen=True, eq=False)
class _Views:
    """Some photos of one marker: (V, 3) starts, (V, 4, 3) rays, (V,) sigmas and angles of a pixel, nearest first."""

    starts: Float64
    rays: Float64
    middles: Float64
    sigma_rad: Float64
    pixel_rad: Float64

    def nearest(self, count: int) -> _Views:
        return _Views(*(values[:count] for values in self.arrays()))

    def without(self, member: int) -> _Views:
        return _Views(*(np.delete(values, member, axis=0) for values in self.arrays()))

    def arrays(self) -> tuple[Float64, ...]:
        return self.starts, self.rays, self.middles, self.sigma_rad, self.pixel_rad


def middle_rays(rays: Float64) -> Float64:
    """(V, 3) unit directions to where the diagonals of (V, 4, 3) corners cross."""
    middles = np.cross(np.cross(rays[:, 0], rays[:, 2]), np.cross(rays[:, 1], rays[:, 3]))
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    return np.asarray(middles * np.sign((middles * rays.sum(axis=1)).sum(axis=1))[:, None])


def side_of(corners: Float64) -> float:
    """The side of the square that four sides and two diagonals say."""
    ends = corners[[1, 2, 3, 0, 2, 3]] - corners[[0, 1, 2, 3, 0, 1]]
    return float((np.linalg.norm(ends, axis=1) / np.array([1, 1, 1, 1, 2**0.5, 2**0.5])).mean())


def place_corners(
    starts: Float64, rays: Float64, sigma_rad: Float64, pixel_rad: Float64, about: Float64, systematic_px: float
) -> PlacedCorners | None:
    """The corners from as many of the nearest photos as make the expected error of the size smallest.

    Args:
        starts: (V, 3) camera centres of photos that agree.
        rays: (V, 4, 3) unit directions to the corners.
        sigma_rad: (V,) standard error of a corner from the pixels.
        pixel_rad: (V,) angle of a pixel.
        about: (3,) roughly where the marker is.
        systematic_px: What every edge may be off by in all photos alike.

    Returns:
        None where the photos look from nearly one direction.
    """
    order = np.argsort(np.linalg.norm(about - starts, axis=1) * pixel_rad, kind="stable")
    views = _Views(starts[order], rays[order], middle_rays(rays)[order], sigma_rad[order], pixel_rad[order])
    tried: list[tuple[float, PlacedCorners]] = []
    for count in _counts(len(order)):
        near = views.nearest(count)
        if parallax(near.middles) < SMALLEST_PARALLAX_DEG:
            continue
        try:
            placed = _placed(near, order[:count], systematic_px)
        except np.linalg.LinAlgError:
            continue
        tried.append((float(np.hypot(placed.size_sigma, placed.weights.drift)), placed))
    if not tried:
        return None
    least = min(expected for expected, _ in tried)
    return next(placed for expected, placed in tried if expected <= _WORTH_MORE * least)


def _counts(total: int) -> list[int]:
    counts = [min(_FEWEST, total)]
    while counts[-1] < total:
        counts.append(min(total, max(counts[-1] + 1, int(counts[-1] * _GROWTH))))
    return counts


def _placed(views: _Views, chosen: NDArray[np.int64], systematic_px: float) -> PlacedCorners:
    count = len(views.starts)
    share = np.full(count, 1 / count)
    per_place = 1 / _reach(views, linear_point(views.starts, views.middles, np.ones(count))) ** 2
    for _ in range(_ROUNDS):
        corners, turned = _corners(views, per_place, share)
        middle = corners.mean(axis=0)
        reach = _reach(views, middle)
        place_src, turn_rad = _pose_errors(views, middle, reach)
        sizes, per_size = _sizes(views, turned, corners)
        side, footprint = side_of(corners), reach * views.pixel_rad
        noise = np.hypot(views.sigma_rad / per_size, place_src / reach)
        weights = weigh_sizes(sizes, noise, footprint, 2 * systematic_px / side)
        share = np.maximum(weights.share, _SMALLEST_SHARE * weights.share.max())
        drift_src = systematic_px * weights.steepness * footprint
        per_place = 1 / ((turn_rad * reach) ** 2 + place_src**2 + drift_src**2 + (views.sigma_rad * reach) ** 2)
    corners, _ = _corners(views, per_place, share)
    covariance, size_sigma = _spread(views, per_place, share, corners, turn_rad, place_src)
    return PlacedCorners(readonly(corners), readonly(covariance), chosen, weights, size_sigma)


def _reach(views: _Views, middle: Float64) -> Float64:
    return np.asarray(np.linalg.norm(middle - views.starts, axis=1))


def _corners(views: _Views, per_place: Float64, share: Float64) -> tuple[Float64, Float64]:
    """(4, 3) corners, and (V, 4, 3) the rays turned onto the middle."""
    middle = linear_point(views.starts, views.middles, per_place)
    towards = middle - views.starts
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    turned = _turned(views.rays, views.middles, towards)
    return np.array([linear_point(views.starts, turned[:, k], share) for k in range(4)]), turned


def _turned(rays: Float64, source: Float64, target: Float64) -> Float64:
    """Each photo's rays by the smallest turn that takes its (V, 3) source to its target."""
    axis = np.cross(source, target)[:, None, :]
    cosine = (source * target).sum(axis=1)[:, None, None]
    once = np.cross(axis, rays)
    return np.asarray(rays + once + np.cross(axis, once) / np.maximum(1 + cosine, 1e-6))


def _pose_errors(views: _Views, middle: Float64, reach: Float64) -> tuple[float, float]:
    """Standard errors of a camera's place (source units) and direction (radians), half of what is seen put to each."""
    off = np.linalg.norm(np.cross(views.middles, (middle - views.starts) / reach[:, None]), axis=1)
    count = len(off)
    # The point lies between the rays: two miss it by less than their error.
    lost = np.sqrt(2 * count / max(2 * count - 3, 1))
    return 0.5 * lost * float(np.median(off * reach)), 0.5 * lost * float(np.median(off))


def _sizes(views: _Views, turned: Float64, corners: Float64) -> tuple[Float64, Float64]:
    """(V,) logarithm of the size each photo shows against the corners, and the square root of its information."""
    towards = corners[None] - views.starts[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    expected = towards - towards.mean(axis=1, keepdims=True)
    seen = turned - turned.mean(axis=1, keepdims=True)
    information = (expected**2).sum(axis=(1, 2))
    ratio = (expected * seen).sum(axis=(1, 2)) / information
    return np.log(np.maximum(ratio, 0.1)), np.sqrt(information)


def _spread(
    views: _Views, per_place: Float64, share: Float64, corners: Float64, turn_rad: float, place_src: float
) -> tuple[Float64, float]:
    """(12, 12) covariance and the standard error of the size: leaving out each photo once, and the pixels' noise."""
    count = len(share)
    reach = _reach(views, corners.mean(axis=0))
    sigma_src = views.sigma_rad * reach
    if count < _FEW:
        # So few do not show their errors by their spread.
        sigma_src = np.sqrt(sigma_src**2 + (turn_rad * reach) ** 2 + place_src**2)
    across = np.eye(3) - views.middles[:, :, None] * views.middles[:, None, :]
    inverse = np.linalg.inv((share[:, None, None] * across).sum(axis=0))
    noise = inverse @ ((share * sigma_src) ** 2 @ across.reshape(count, 9)).reshape(3, 3) @ inverse
    covariance = np.kron(np.eye(4), noise)
    side = side_of(corners)
    # A side is a difference of two corners; the six lengths share four corners.
    variance = float(np.trace(noise)) / 3 / side**2
    if count >= 3:
        moved = [
            _corners(views.without(k), np.delete(per_place, k), np.delete(share, k))[0] - corners for k in range(count)
        ]
        sizes = np.array([side_of(corners + step) / side - 1 for step in moved])
        steps = np.array(moved).reshape(count, 12)
        covariance += (count - 1) / count * steps.T @ steps
        variance += (count - 1) / count * float(sizes @ sizes)
    return np.asarray(covariance), float(np.sqrt(variance))
