"""Which point of a cloud is under the cursor, inside a rectangle or inside a lasso.

Coordinates are kept as three contiguous float32 arrays and walked in pieces that stay in the processor's cache: on an
(N, 3) array the same test takes six times as long. There is no index to build, so a freshly loaded cloud can be picked
at once. Every tolerance comes from the spacing of the points: before the cloud is scaled its unit is arbitrary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int64, as_points, readonly

_CHUNK = 131_072  # three times 0.5 MB of float32
_MASK_CELLS = 1024  # lasso resolution across its bounding box
_N_SEEDS = 24
_N_NEIGHBOURS = 48


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera as plain numbers.

    Attributes:
        origin: (3,) position in the frame of the points.
        rotation: (3, 3) with rows right, down, forward: ``cam_from_world`` in OpenCV axes.
        fov_rad: Vertical field of view.
        aspect: Width over height.
        height_px: Height of the image.
    """

    origin: Float64
    rotation: Float64
    fov_rad: float
    aspect: float
    height_px: int

    def __post_init__(self) -> None:
        if not 0 < self.fov_rad < np.pi or not self.aspect > 0 or self.height_px <= 0:
            raise ValueError(f"no view: fov {self.fov_rad} rad, aspect {self.aspect}, height {self.height_px} px")
        object.__setattr__(self, "origin", readonly(np.asarray(self.origin, np.float64).reshape(3)))
        object.__setattr__(self, "rotation", readonly(np.asarray(self.rotation, np.float64).reshape(3, 3)))

    @classmethod
    def looking_at(
        cls,
        origin: Any,
        target: Any,
        *,
        up: Any = (0.0, 0.0, 1.0),
        fov_rad: float = 1.0,
        aspect: float = 1.6,
        height_px: int = 800,
    ) -> View:
        """The view from `origin` to `target` with `up` upright. Raises ValueError where `up` is the line of sight."""
        forward = np.asarray(target, np.float64) - np.asarray(origin, np.float64)
        right = np.cross(forward, np.asarray(up, np.float64))
        if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
            raise ValueError("up is the line of sight")
        forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
        return cls(origin, np.stack([right, np.cross(forward, right), forward]), fov_rad, aspect, height_px)

    @property
    def pixel_angle_rad(self) -> float:
        """Angle of one pixel at the centre of the image."""
        return float(2.0 * np.tan(self.fov_rad / 2) / self.height_px)

    def project(self, points: NDArray[np.floating[Any]]) -> Float64:
        """(N, 2) screen positions 0..1 from the upper left corner of (N, 3) points; NaN for what is not in front."""
        cam = (as_points(points, name="points").astype(np.float64) - self.origin) @ self.rotation.T
        depth = np.where(cam[:, 2] > 0, cam[:, 2], np.nan)[:, None]
        scale = 1.0 / np.tan(self.fov_rad / 2)
        return np.asarray((cam[:, :2] / depth * [scale / self.aspect, scale] + 1.0) / 2.0, np.float64)

    def ray(self, screen_xy: Any) -> Float64:
        """(3,) unit direction through a screen position 0..1."""
        x, y = 2.0 * np.asarray(screen_xy, np.float64) - 1.0
        tangent = np.tan(self.fov_rad / 2)
        direction = np.array([x * tangent * self.aspect, y * tangent, 1.0]) @ self.rotation
        return np.asarray(direction / np.linalg.norm(direction), np.float64)


@dataclass(frozen=True, eq=False)
class PickHit:
    """What lies under the cursor.

    Attributes:
        index: The point of the surface that is nearest to the ray.
        surface: (K,) all points of the front-most surface near the ray, `index` among them: vote over their labels.
        depth: Distance of `index` along the ray, in the unit of the points.
        offset: Distance of `index` from the ray.
    """

    index: int
    surface: Int64
    depth: float
    offset: float


class PickCloud:
    """A cloud prepared for picking: 12 bytes per point, nothing else.

    Args:
        xyz: (N, 3) points in any unit. Points that are not finite are never picked.

    Attributes:
        spacing: Typical distance between neighbouring points, in the unit of the points; 0 for fewer than two.
    """

    def __init__(self, xyz: NDArray[np.floating[Any]]) -> None:
        points = as_points(xyz, name="xyz")
        self._axes: tuple[Float32, Float32, Float32] = tuple(  # type: ignore[assignment]
            np.ascontiguousarray(points[:, axis], np.float32) for axis in range(3)
        )
        self.spacing = _spacing(self._axes)

    @classmethod
    def over(cls, xyz: Float32) -> PickCloud:
        """The same over an (N, 3) array that is not copied: for one selection among all points of a large plot.

        Pieces are brought together as they are looked at, which takes twice as long; the spacing is not known (0).
        """
        points = as_points(xyz, name="xyz")
        cloud = cls.__new__(cls)
        cloud._axes = tuple(_Column(points, axis) for axis in range(3))  # type: ignore[assignment]
        cloud.spacing = 0.0
        return cloud

    def __len__(self) -> int:
        return len(self._axes[0])

    def pick(
        self,
        ray_origin: NDArray[np.floating[Any]],
        ray_direction: NDArray[np.floating[Any]],
        pixel_angle_rad: float,
        *,
        radius_px: float = 6.0,
        radius: float | None = None,
        depth_tolerance: float | None = None,
        min_support: int = 3,
    ) -> PickHit | None:
        """The front-most surface under the cursor, or None where there is only background.

        Points count when they are within `radius_px` of the cursor or within `radius` of the ray: close up the ray
        passes between the samples of a trunk, and without `radius` it would hit the ground far behind. A surface needs
        `min_support` points within `depth_tolerance` of each other, so a floating point does not steal the click; where
        nothing has that support, the point nearest to the ray is taken.

        Args:
            ray_origin: (3,) camera position.
            ray_direction: (3,) of any length but zero.
            pixel_angle_rad: `View.pixel_angle_rad`.
            radius_px: How far from the cursor a point may appear.
            radius: In the unit of the points; by default 3 times the spacing.
            depth_tolerance: In the unit of the points; by default 12 times the spacing.
            min_support: Points that make a surface.
        """
        radius = 3.0 * self.spacing if radius is None else radius
        tolerance = 12.0 * self.spacing if depth_tolerance is None else depth_tolerance
        with np.errstate(invalid="ignore", over="ignore"):  # points that are not finite fail every comparison
            index, depth, offset = self._near_ray(ray_origin, ray_direction, pixel_angle_rad * radius_px, radius)
        if not len(index):
            return None
        order = np.argsort(depth, kind="stable")
        index, depth, offset = index[order], depth[order], offset[order]
        first, last = _first_group(depth, offset, tolerance, min_support)
        best = first + int(np.argmin(offset[first:last]))
        return PickHit(int(index[best]), readonly(index[first:last]), float(depth[best]), float(offset[best]))

    def _near_ray(self, origin: Any, direction: Any, slope: float, radius: float) -> tuple[Int64, Float32, Float32]:
        """Indices, depths and offsets of the points closer to the ray than ``max(slope * depth, radius)``."""
        start = np.asarray(origin, np.float32).reshape(3)
        unit = np.asarray(direction, np.float64).reshape(3)
        length = np.linalg.norm(unit)
        if not length > 0:
            raise ValueError("the ray has no direction")
        dx, dy, dz = (unit / length).astype(np.float32)
        slope2, radius2 = np.float32(slope**2), np.float32(radius**2)
        found: list[tuple[Int64, Float32, Float32]] = []
        for low in range(0, len(self), _CHUNK):
            x, y, z = (axis[low : low + _CHUNK] - o for axis, o in zip(self._axes, start, strict=True))
            depth = x * dx
            depth += y * dy
            depth += z * dz
            # The cross product, not |p|² - depth²: the difference of two large squares would lose the offset.
            offset2 = (y * dz - z * dy) ** 2
            offset2 += (z * dx - x * dz) ** 2
            offset2 += (x * dy - y * dx) ** 2
            limit = depth * depth
            limit *= slope2
            np.maximum(limit, radius2, out=limit)
            near = np.flatnonzero((offset2 <= limit) & (depth > 0))
            if len(near):
                found.append((near + low, depth[near], np.sqrt(offset2[near])))
        if not found:
            return np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32)
        index, depth, offset = (np.concatenate(part) for part in zip(*found, strict=True))
        return index.astype(np.int64), depth, offset

    def rectangle(self, view: View, lower_xy: Any, upper_xy: Any) -> Int64:
        """(K,) sorted indices of all points, hidden ones too, that appear between two screen corners 0..1."""
        corners = np.sort(np.asarray([lower_xy, upper_xy], np.float64).reshape(2, 2), axis=0)
        return self._inside(view, corners, lambda x, y: np.ones(len(x), bool))

    def lasso(self, view: View, polygon_xy: Any) -> Int64:
        """(K,) sorted indices of all points, hidden ones too, that appear inside a screen polygon.

        Args:
            view: The camera.
            polygon_xy: (M, 2) corners 0..1, closed by itself; where it crosses itself the even-odd rule holds. The
                edge is exact to a thousandth of the polygon's size.
        """
        polygon = as_points(polygon_xy, name="polygon_xy", n_columns=2).astype(np.float64)
        if not np.isfinite(polygon).all():
            raise ValueError("polygon_xy has values that are not finite")
        if len(polygon) < 3:
            return np.empty(0, np.int64)
        corners = np.stack([polygon.min(axis=0), polygon.max(axis=0)])
        size = corners[1] - corners[0]
        if not (size > 0).all():
            return np.empty(0, np.int64)
        mask = _polygon_mask((polygon - corners[0]) / size * _MASK_CELLS, _MASK_CELLS)
        to_cell = (_MASK_CELLS / size).astype(np.float32)

        def inside(x: Float, y: Float) -> Bool:
            column = ((x - np.float32(corners[0, 0])) * to_cell[0]).astype(np.int32)
            row = ((y - np.float32(corners[0, 1])) * to_cell[1]).astype(np.int32)
            np.clip(column, 0, _MASK_CELLS - 1, out=column)
            np.clip(row, 0, _MASK_CELLS - 1, out=row)
            return mask[row, column]

        return self._inside(view, corners, inside)

    def _inside(self, view: View, corners: Float64, test: Callable[[Float, Float], Bool]) -> Int64:
        """Indices of the points in front of the camera and between two screen corners whose position passes `test`."""
        scale = 1.0 / np.tan(view.fov_rad / 2)
        rows = (view.rotation * np.array([[scale / view.aspect], [scale], [1.0]])).astype(np.float32)
        origin = view.origin.astype(np.float32)
        (x0, y0), (x1, y1) = (2.0 * corners - 1.0).astype(np.float32)
        found: list[Int64] = []
        for low in range(0, len(self), _CHUNK):
            with np.errstate(invalid="ignore", over="ignore"):  # points that are not finite fail every comparison
                offsets = [axis[low : low + _CHUNK] - o for axis, o in zip(self._axes, origin, strict=True)]
                x, y, depth = (_dot(row, offsets) for row in rows)
                # Comparing before dividing: no division for the points outside, none by zero.
                near = (depth > 0) & (x >= x0 * depth) & (x <= x1 * depth) & (y >= y0 * depth) & (y <= y1 * depth)
            chosen = np.flatnonzero(near)
            if len(chosen):
                screen_x = (x[chosen] / depth[chosen] + 1) / 2
                screen_y = (y[chosen] / depth[chosen] + 1) / 2
                found.append(chosen[test(screen_x, screen_y)] + low)
        return np.concatenate(found).astype(np.int64) if found else np.empty(0, np.int64)

    def ball(self, centre: Any, radius: float) -> Int64:
        """(K,) sorted indices of the points within `radius` of a place, both in the unit of the points."""
        middle = np.asarray(centre, np.float32).reshape(3)
        found: list[Int64] = []
        for low in range(0, len(self), _CHUNK):
            with np.errstate(invalid="ignore", over="ignore"):  # points that are not finite fail every comparison
                x, y, z = (axis[low : low + _CHUNK] - c for axis, c in zip(self._axes, middle, strict=True))
                near = np.flatnonzero((np.abs(x) <= radius) & (np.abs(y) <= radius) & (np.abs(z) <= radius))
                near = near[x[near] ** 2 + y[near] ** 2 + z[near] ** 2 <= radius * radius]
            if len(near):
                found.append(near + low)
        return np.concatenate(found).astype(np.int64) if found else np.empty(0, np.int64)


class _Column:
    """One coordinate of an (N, 3) array; a piece is copied when it is asked for."""

    def __init__(self, points: Float, axis: int) -> None:
        self._points, self._axis = points, axis

    def __len__(self) -> int:
        return len(self._points)

    def __getitem__(self, piece: slice) -> Float32:
        return np.ascontiguousarray(self._points[piece, self._axis], np.float32)


def plane_through(points: NDArray[np.floating[Any]]) -> tuple[Float64, Float64]:
    """Centre (3,) and unit normal (3,) of the least-squares plane of (N, 3) points.

    Raises:
        ValueError: They are fewer than three or on a line.
    """
    xyz = as_points(points, name="points").astype(np.float64)
    centre = xyz.mean(axis=0) if len(xyz) else np.zeros(3)
    singular, axes = np.linalg.svd(xyz - centre, full_matrices=False)[1:]
    if len(xyz) < 3 or singular[1] <= 1e-9 * singular[0]:
        raise ValueError("a plane needs three points that are not on a line")
    return centre, np.asarray(axes[2], np.float64)


def ray_plane(ray_origin: Any, ray_direction: Any, centre: Float64, normal: Float64) -> Float64 | None:
    """(3,) where a ray meets a plane; None where it runs along it or away from it.

    A click beside the samples of a marker lands on its plane to a fraction of the point spacing this way.
    """
    origin, direction = np.asarray(ray_origin, np.float64), np.asarray(ray_direction, np.float64)
    approach = float(direction @ normal)
    if abs(approach) < 1e-9 * np.linalg.norm(direction):
        return None
    length = float((centre - origin) @ normal) / approach
    return origin + length * direction if length > 0 else None


def _dot(row: Float32, parts: list[Float32]) -> Float32:
    total = parts[0] * row[0]
    total += parts[1] * row[1]
    total += parts[2] * row[2]
    return total


def _first_group(depth: Float32, offset: Float32, tolerance: float, min_support: int) -> tuple[int, int]:
    """Start and stop, in ascending `depth`, of the first `min_support` points within `tolerance`, and all with them."""
    if len(depth) >= min_support:
        starts = np.flatnonzero(depth[min_support - 1 :] - depth[: len(depth) - min_support + 1] <= tolerance)
        if len(starts):
            first = int(starts[0])
            return first, int(np.searchsorted(depth, depth[first] + np.float32(tolerance), "right"))
    nearest = int(np.argmin(offset))
    return nearest, nearest + 1


def _polygon_mask(polygon: Float64, n: int) -> Bool:
    """(n, n) mask [row y, column x] of the cell centres inside a polygon given in cells; even-odd rule.

    Every edge toggles, in each row whose centre line it crosses, the first cell whose centre lies right of the
    crossing; a running parity along the row then fills the inside.
    """
    a, b = polygon, np.roll(polygon, -1, axis=0)
    y_low, y_high = np.minimum(a[:, 1], b[:, 1]), np.maximum(a[:, 1], b[:, 1])
    first = np.clip(np.ceil(y_low - 0.5), 0, n).astype(np.int64)
    count = np.clip(np.ceil(y_high - 0.5), 0, n).astype(np.int64) - first
    edge = np.repeat(np.arange(len(a)), count)
    row = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + first[edge]
    fraction = (row + 0.5 - a[edge, 1]) / (b[edge, 1] - a[edge, 1])
    crossing = a[edge, 0] + fraction * (b[edge, 0] - a[edge, 0])
    column = np.clip(np.ceil(crossing - 0.5), 0, n).astype(np.int64)
    toggles = np.bincount(row * (n + 1) + column, minlength=n * (n + 1)).reshape(n, n + 1)
    return np.asarray(np.cumsum(toggles[:, :n], axis=1) % 2 == 1)


def _spacing(axes: tuple[Float32, Float32, Float32]) -> float:
    """Median distance to the nearest other point, over a few places of the cloud; duplicates do not count."""
    n = len(axes[0])
    if n < 2:
        return 0.0
    finite = [axis[np.isfinite(axis)] for axis in axes]
    extent = max((float(np.ptp(values)) for values in finite if len(values)), default=0.0)
    if not extent > 0:
        return 0.0
    # As if the points lay on one square sheet; a place that turns out emptier is searched wider.
    radius = extent * (_N_NEIGHBOURS / n) ** 0.5
    seeds = np.random.default_rng(0).integers(0, n, _N_SEEDS if n < 2_000_000 else _N_SEEDS // 3)
    with np.errstate(invalid="ignore", over="ignore"):
        distances = [d for d in (_nearest_distance(axes, int(seed), radius) for seed in seeds) if d is not None]
    return float(np.median(distances)) if distances else extent / n**0.5


def _nearest_distance(axes: tuple[Float32, Float32, Float32], seed: int, radius: float) -> float | None:
    """Distance from point `seed` to the nearest point that is not at the same place."""
    for _ in range(4):
        near = np.ones(len(axes[0]), bool)
        for axis in axes:
            near &= np.abs(axis - axis[seed]) <= np.float32(radius)
        if near.sum() > 1:
            offsets = np.stack([axis[near] - axis[seed] for axis in axes]).astype(np.float64)
            distance = np.linalg.norm(offsets, axis=0)
            distance = distance[(distance > 0) & (distance <= radius)]
            if len(distance):
                return float(distance.min())
        radius *= 3.0
    return None
