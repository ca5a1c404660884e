"""A small piece of a cloud, enlarged: where on its surface does a person point, and how well is that known?

The piece is looked at along one direction without perspective. A point is then two numbers across and one along, and
all points of the cloud take part, not only those that are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float64, Int64, UInt8, as_points, readonly

_CHUNK = 1_000_000
# In spacings: what belongs to one surface along the line of sight, and how far its plane is taken from.
_SAME_SURFACE = 5.0
_FRONT_REACH = 3.0
_PLANE_REACH = 6.0
_MIN_PLANE = 8
_ROUNDS = 3
# Thickness over width of what is a plane, and the least cosine between its normal and the line of sight.
_FLATNESS = 0.35
_LEAST_COSINE = 0.08
# Of the distance between neighbours: how far the edge that a person sees may be from where they see it.
_SIGMA_SPACINGS = 0.3
_MOST_SPLATS = 4_000_000
_BACKGROUND = (246, 247, 248)
_PLAIN = (105, 117, 128)


def points_near(points: NDArray[np.floating[Any]], centre: Any, half_width: float) -> Int64:
    """(K,) indices of the (N, 3) points in a cube of `half_width` about `centre`."""
    xyz, middle = as_points(points, name="points"), np.asarray(centre, np.float64)
    found = []
    for low in range(0, len(xyz), _CHUNK):
        part = xyz[low : low + _CHUNK]
        # One axis after the other: after the first there is little left to look at.
        rows = np.flatnonzero(np.abs(part[:, 0] - middle[0]) <= half_width)
        for axis in (1, 2):
            rows = rows[np.abs(part[rows, axis] - middle[axis]) <= half_width]
        found.append(rows + low)
    return np.concatenate(found).astype(np.int64) if found else np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class SurfacePoint:
    """A point on the surface of a cloud.

    Attributes:
        xyz: (3,) in the cloud's frame.
        sigma: Standard error of each coordinate, in the cloud's unit.
        normal: (3,) unit normal of the surface, towards the eye; None where it is no plane.
    """

    xyz: Float64
    sigma: float
    normal: Float64 | None = None


@dataclass(frozen=True, eq=False)
class CloseUp:
    """A cube of a cloud seen along one direction.

    Attributes:
        flat: (K, 3) its points: right, down and away about `centre`.
        rgb: (K, 3) uint8 colours, or None.
        centre: (3,) in the cloud's frame.
        rotation: (3, 3) with rows right, down and away.
        half_width: Of the picture, in the cloud's unit.
        spacing: Typical distance between neighbouring points here; 0 for fewer than two.
    """

    flat: Float64
    rgb: UInt8 | None
    centre: Float64
    rotation: Float64
    half_width: float
    spacing: float

    @classmethod
    def of(
        cls,
        points: NDArray[np.floating[Any]],
        rgb: UInt8 | None,
        centre: Any,
        rotation: Any,
        half_width: float,
    ) -> CloseUp:
        """Cut out of (N, 3) points and, where there are any, (N, 3) colours.

        Raises:
            ValueError: `half_width` is not positive.
        """
        if not 0.0 < half_width < float("inf"):
            raise ValueError(f"half_width is {half_width} but must be positive")
        middle, axes = np.asarray(centre, np.float64).reshape(3), np.asarray(rotation, np.float64).reshape(3, 3)
        # The corners of a turned square reach farther than its middle.
        rows = points_near(points, middle, 1.5 * half_width)
        near = points[rows].astype(np.float64)
        return cls(
            readonly((near - middle) @ axes.T),
            None if rgb is None else rgb[rows],
            readonly(middle),
            readonly(axes),
            half_width,
            _spacing(near),
        )

    def to_cloud(self, flat: Any) -> Float64:
        """(3,) in the cloud's frame of (3,) right, down, away."""
        return np.asarray(self.centre + np.asarray(flat, np.float64) @ self.rotation)

    def place_of(self, xyz: Any) -> tuple[float, float]:
        """Where a point of the cloud's frame is in the picture: 0..1 from its upper left corner."""
        right, down, _ = self.rotation @ (np.asarray(xyz, np.float64) - self.centre)
        return float(right / self.half_width + 1) / 2, float(down / self.half_width + 1) / 2

    def surface_at(self, x: float, y: float, *, pointing_sigma: float = 0.0) -> SurfacePoint | None:
        """The surface under a place of the picture.

        It is the plane of the front-most points around the place, so that the point lies between samples where the
        person points; where they form no plane, such as at a twig, it is the nearest of them.

        Args:
            x: 0..1 from the left.
            y: 0..1 from the top.
            pointing_sigma: Standard error of the pointing, in the cloud's unit.

        Returns:
            None where there are no points.
        """
        if not len(self.flat):
            return None
        place = (2 * np.array([x, y], np.float64) - 1) * self.half_width
        away = np.linalg.norm(self.flat[:, :2] - place, axis=1)
        near = self._front(away)
        anchor = self.flat[near[int(np.argmin(away[near]))]]
        plane, depth = self._plane_about(anchor), None
        for _ in range(_ROUNDS):
            if plane is None:
                break
            # Seen from the side, the first point is far from where the line of sight meets the surface.
            depth = plane[0][2] - float((place - plane[0][:2]) @ plane[1][:2]) / plane[1][2]
            plane = self._plane_about(np.array([*place, depth])) or plane
        if plane is None or depth is None or abs(depth - anchor[2]) > 2 * self.half_width:
            sigma = float(np.hypot(self.spacing, pointing_sigma))
            return SurfacePoint(self.to_cloud(anchor), sigma, None)
        # What is seen from the side is hit less well along the line of sight.
        sigma = float(np.hypot(_SIGMA_SPACINGS * self.spacing, pointing_sigma / abs(float(plane[1][2]))))
        return SurfacePoint(self.to_cloud([*place, depth]), sigma, np.asarray(plane[1] @ self.rotation))

    def _front(self, away: Float64) -> Int64:
        """(K,) the front-most surface among the points nearest to a place; (N,) `away` from it across."""
        reach = max(_FRONT_REACH * self.spacing, float(away.min()) * 1.001)
        rows = np.flatnonzero(away <= reach)
        rows = rows[np.argsort(self.flat[rows, 2], kind="stable")]
        depths = self.flat[rows, 2]
        tolerance = max(_SAME_SURFACE * self.spacing, 1e-12)
        for support in (3, 1):  # a floating point in front is no surface
            if len(rows) >= support:
                first = np.flatnonzero(depths[support - 1 :] - depths[: len(depths) - support + 1] <= tolerance)
                if len(first):
                    at = int(first[0])
                    return np.asarray(rows[at : int(np.searchsorted(depths, depths[at] + tolerance, "right"))])
        return np.asarray(rows[:1])

    def _plane_about(self, anchor: Float64) -> tuple[Float64, Float64] | None:
        """Middle (3,) and unit normal (3,), towards the eye, of the plane of the points about one; None: no plane."""
        near = self.flat[np.linalg.norm(self.flat - anchor, axis=1) <= _PLANE_REACH * self.spacing]
        kept = np.ones(len(near), bool)
        for _ in range(3):
            if kept.sum() < _MIN_PLANE:
                return None
            middle = near[kept].mean(axis=0)
            singular, axes = np.linalg.svd(near[kept] - middle, full_matrices=False)[1:]
            normal = axes[2] * (-1.0 if axes[2, 2] > 0 else 1.0)
            off = np.abs((near - middle) @ normal)
            kept = off <= max(3 * 1.4826 * float(np.median(off[kept])), 1e-12)
        if singular[2] > _FLATNESS * singular[1] or abs(normal[2]) < _LEAST_COSINE:
            return None
        return middle, normal

    def picture(self, size_px: int) -> UInt8:
        """(size_px, size_px, 3) the points as squares that close the surface, the front-most on top."""
        image = np.full((size_px * size_px, 3), _BACKGROUND, np.uint8)
        column, row = ((self.flat[:, :2].T / self.half_width + 1) / 2 * size_px).astype(np.int64)
        radius = int(np.clip(1.1 * self.spacing / self.half_width * size_px / 2 + 0.5, 0, size_px / 16))
        inside = np.flatnonzero(
            (column >= -radius) & (column < size_px + radius) & (row >= -radius) & (row < size_px + radius)
        )
        while radius and len(inside) * (2 * radius + 1) ** 2 > _MOST_SPLATS:
            radius -= 1
        # The last one written to a pixel stays: from the back to the front.
        inside = inside[np.argsort(-self.flat[inside, 2], kind="stable")]
        colours = self._colours()[inside]
        steps = np.arange(-radius, radius + 1)
        columns = column[inside][:, None, None] + steps[:, None]
        rows = row[inside][:, None, None] + steps[None, :]
        shown = (columns >= 0) & (columns < size_px) & (rows >= 0) & (rows < size_px)
        pixels = (rows * size_px + columns)[shown]
        image[pixels] = np.repeat(colours, shown.sum(axis=(1, 2)), axis=0)
        return image.reshape(size_px, size_px, 3)

    def _colours(self) -> UInt8:
        """(K, 3) their own; of a cloud without, grey that is darker the farther away."""
        if self.rgb is not None:
            return self.rgb
        depth = np.clip(self.flat[:, 2:] / self.half_width, -1, 1)
        return np.asarray(np.clip(np.array(_PLAIN) * (1.0 - 0.5 * depth), 0, 255), np.uint8)


def _spacing(points: Float64) -> float:
    """Median distance to the nearest neighbour; points at one place do not count."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.0
    sample = points[:: max(1, len(points) // 2_000)]
    distance = cKDTree(points).query(sample, k=min(4, len(points)))[0][:, 1:]
    distance = np.where(distance > 0, distance, np.inf).min(axis=1)
    distance = distance[np.isfinite(distance)]
    return float(np.median(distance)) if len(distance) else 0.0
