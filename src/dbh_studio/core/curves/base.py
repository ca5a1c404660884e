"""What a curve must offer to be fitted by `core.robust.ransac`, and the geometry of closed outlines.

Curves live in *ring units*: the polar origin is (0, 0) and the robust ring has radius 1. So a curve needs no scale of
its own, its normal equations are well conditioned, and the same parameters serve a sapling and an oak.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from dbh_studio.core.arrays import Bool, Float64

if TYPE_CHECKING:
    from dbh_studio.settings import MeasureSettings

N_OUTLINE = 720
"""Vertices of an outline. A circle's polygon is then 3e-6 shorter than the circle and 1.3e-5 smaller."""


class Curve(Protocol):
    """One family of closed curves. All hypotheses of a RANSAC are fitted and scored in one call."""

    @property
    def name(self) -> str:
        """As in `settings.CurveName`."""

    @property
    def n_min(self) -> int:
        """Fewest points that determine a curve."""

    @property
    def n_score(self) -> int:
        """On how many points of the section hypotheses are fitted and scored.

        A larger section is thinned at random, and the winner is refitted to all of its points.
        """

    @property
    def n_refit(self) -> int:
        """How many of the best supported, different hypotheses are refitted to their inliers; 0 for all."""

    def configured(self, settings: MeasureSettings) -> Curve:
        """This family with the settings that concern it."""

    def fit(self, uv: Float64, members: Bool) -> Float64:
        """(H, P) parameters of H curves; row h is fitted to ``uv[members[h]]`` and NaN where those determine none.

        Args:
            uv: (N, 2) points, ring units.
            members: (H, N) which points each fit uses.
        """

    def distance(self, params: Float64, uv: Float64) -> Float64:
        """(H, N) distance of (N, 2) points to each of the (H, P) curves; not below any tolerance where a row is NaN."""

    def outline(self, params: Float64) -> Float64:
        """(M, 2) closed outline of the curve with (P,) parameters; (0, 2) where it is not a closed curve."""


def outline_metrics(outline: Float64) -> tuple[float, float, float]:
    """Perimeter, area and convex girth of an (M, 2) closed outline (last vertex joins the first)."""
    step = np.roll(outline, -1, axis=0) - outline
    perimeter = float(np.hypot(step[:, 0], step[:, 1]).sum())
    return perimeter, abs(_signed_area(outline)), perimeter if _is_convex(step) else _hull_girth(outline, perimeter)


def _is_convex(step: Float64) -> bool:
    """Whether a closed walk of (M, 2) steps turns one way only, and once."""
    following = np.roll(step, -1, axis=0)
    turn = np.arctan2(step[:, 0] * following[:, 1] - step[:, 1] * following[:, 0], (step * following).sum(axis=1))
    one_way = bool((turn >= 0.0).all() or (turn <= 0.0).all())
    return one_way and abs(abs(float(turn.sum())) - 2 * np.pi) < 0.1


def _hull_girth(outline: Float64, perimeter: float) -> float:
    try:
        return float(ConvexHull(outline).area)
    except QhullError:
        return perimeter


def hull_outline(outline: Float64) -> Float64:
    """(K, 2) convex hull of an (M, 2) outline, where a tape would lie; the outline itself where it has none."""
    try:
        return np.asarray(outline[ConvexHull(outline).vertices], np.float64)
    except QhullError:
        return outline


def _signed_area(outline: Float64) -> float:
    following = np.roll(outline, -1, axis=0)
    return 0.5 * float((outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]).sum())


def outline_centroid(outline: Float64) -> Float64:
    """(2,) centroid of the area inside an (M, 2) outline; the vertices' mean where it encloses none."""
    middle: Float64 = outline.mean(axis=0)
    x, y = (outline - middle).T
    x_next, y_next = np.roll(x, -1), np.roll(y, -1)
    cross = x * y_next - x_next * y
    doubled = float(cross.sum())
    if abs(doubled) < 1e-12:
        return middle
    moments = np.array([((x + x_next) * cross).sum(), ((y + y_next) * cross).sum()])
    return middle + moments / (3.0 * doubled)


def contains(outline: Float64, point: Float64) -> bool:
    """Whether the outline winds around `point` (2,)."""
    offset = outline - point
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    turns = np.diff(np.append(angle, angle[0]))
    return bool(abs(((turns + np.pi) % (2 * np.pi) - np.pi).sum()) > np.pi)


def distance_to_outline(uv: Float64, outline: Float64) -> Float64:
    """(N,) distance of (N, 2) points to the closed polyline, exact to the two segments at the nearest vertex."""
    _, nearest = cKDTree(outline, balanced_tree=False, compact_nodes=False).query(uv)
    following = np.roll(outline, -1, axis=0)
    starts = np.stack([nearest, (nearest - 1) % len(outline)])
    segment = following[starts] - outline[starts]
    offset = uv[None] - outline[starts]
    length2 = np.maximum((segment**2).sum(axis=-1), 1e-300)
    along = np.clip((offset * segment).sum(axis=-1) / length2, 0.0, 1.0)
    rest = offset - along[..., None] * segment
    distance: Float64 = np.hypot(rest[..., 0], rest[..., 1]).min(axis=0)
    return distance
