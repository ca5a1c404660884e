"""Points that a person marks in photos: where they are in space, and in which other photos to mark them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.scale_evidence import MarkedPoint, Sight

if TYPE_CHECKING:
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.core.posed_images import PosedImages

# How well a person hits a corner in a photo, pixels of it.
CLICK_SIGMA_PX = 1.0
# Rays that meet at less say little about the distance.
_GOOD_PARALLAX_DEG = 8.0


def point_from_sights(
    sights: Sequence[Sight], posed: PosedImages, *, sigma_px: float = CLICK_SIGMA_PX
) -> TriangulatedPoint | Refusal:
    """The point that several photos show, or why they show none.

    Args:
        sights: One per photo.
        posed: The photos, in the cloud's frame.
        sigma_px: How well the point was hit.
    """
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.core.triangulation import triangulate

    rays, origins, sigmas = [], [], []
    for sight in sights:
        try:
            photo = posed.by_name(sight.image)
        except KeyError:
            return Refusal("no_photo", f"The photo {sight.image} is gone.", "Take the point out of it.")
        uv = np.array([[sight.u_px, sight.v_px], [sight.u_px + 0.5, sight.v_px], [sight.u_px, sight.v_px + 0.5]])
        origin, directions = photo.ray(uv)
        if not np.isfinite(directions[0]).all():
            return Refusal("bad_ray", f"{sight.image} shows nothing there.", "Mark the point inside the picture.")
        # At the border of the lens the pixel beside may have no direction.
        beside = [_angle(directions[0], other) for other in directions[1:] if np.isfinite(other).all()]
        step = max(beside, default=0.0)
        origins.append(origin)
        rays.append(directions[0])
        sigmas.append(sigma_px * 2 * max(step, 1e-9))
    if not rays:
        return Refusal("one_view", "The point is marked in no photo.", "Mark it in two or more photos.")
    result = triangulate(np.array(origins), np.array(rays), np.array(sigmas))
    if isinstance(result, Refusal):
        return result
    distance = np.linalg.norm(np.array(origins) - result.point, axis=1)
    residual_px = result.residuals_rad / (np.array(sigmas) / sigma_px)
    sigma_src = float(np.sqrt(np.trace(result.covariance) / 3))
    point = MarkedPoint(tuple(result.point), sigma_src, tuple(sights))
    return TriangulatedPoint(
        point, tuple(residual_px), tuple(result.inliers.tolist()), result.parallax_deg, tuple(distance)
    )


def _angle(a: Float64, b: Float64) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


@dataclass(frozen=True)
class TriangulatedPoint:
    """A point from photos.

    Attributes:
        point: Where it is, with its error and sights.
        residuals_px: Per sight, how far the point is from where it was marked, pixels.
        is_used: Per sight, whether it agrees with the others.
        parallax_deg: Largest angle between two rays; below 5° the distance is weak.
        distances_src: Per sight, from camera to point.
    """

    point: MarkedPoint
    residuals_px: tuple[float, ...]
    is_used: tuple[bool, ...]
    parallax_deg: float
    distances_src: tuple[float, ...]


@dataclass(frozen=True)
class Suggestion:
    """A photo in which a point should be visible too: `u_px`, `v_px` where, `distance_src` how far from the camera."""

    image: str
    u_px: float
    v_px: float
    distance_src: float


def photos_of_point(
    point_src: Float64, posed: PosedImages, *, without: Sequence[str] = (), at_most: int = 12
) -> tuple[Suggestion, ...]:
    """Photos that have a point in view, nearest first; what stands in between is not known.

    Those that look at it from nearly the same side as one of `without` come last: they say little about its distance.

    Args:
        point_src: (3,) absolute source coordinates; roughly is enough.
        posed: The photos, in the cloud's frame.
        without: Photos not to name: the point is marked in them.
        at_most: How many.
    """
    point = np.asarray(point_src, np.float64)
    left_out = set(without)
    marked_from = [point - photo.centre_src for photo in posed if photo.name in left_out]
    found: list[tuple[bool, Suggestion]] = []
    for photo in posed:
        if photo.name in left_out or photo.path is None:
            continue
        uv, in_view = photo.project(point[None])
        if in_view[0]:
            towards = point - photo.centre_src
            is_alike = any(np.degrees(_angle(towards, other)) < _GOOD_PARALLAX_DEG for other in marked_from)
            suggestion = Suggestion(photo.name, float(uv[0, 0]), float(uv[0, 1]), float(np.linalg.norm(towards)))
            found.append((is_alike, suggestion))
    found.sort(key=lambda each: (each[0], each[1].distance_src))
    return tuple(suggestion for _, suggestion in found[:at_most])
