"""The ground under the stems: one plane as in the paper, or a terrain surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Float, Float32, Float64, as_points, readonly
from dbh_studio.core.ground_plane import fit_plane_ransac
from dbh_studio.core.neighbours import N_WORKERS
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.terrain import fit_terrain
from dbh_studio.settings import GroundSettings

GroundKind = Literal["terrain", "plane", "stem_base"]

# Bounds the temporary float64 arrays of `height_above` to some tens of megabytes.
_CHUNK = 1 << 19

NO_GROUND_NOTE = (
    "The cloud has no ground (it was probably removed). Heights are measured from each stem's own lowest points, "
    "so breast height may be too high by what is missing at the foot."
)

NO_PLANE_NOTE = "No plane is supported by three points of the cloud, so heights above the ground mean nothing."


class GroundModel(Protocol):
    """A surface z = f(x, y) in the world frame, metres.

    Attributes:
        kind: ``stem_base`` where the cloud has no ground and each stem's own lowest point stands in for it.
        notes: What the person should know about it, in plain words.
    """

    @property
    def kind(self) -> GroundKind:
        """Which of the three it is."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What the person should know."""

    def z_at(self, xy_world: Float) -> Float64:
        """(M,) ground height under (M, 2) positions; extrapolated outside the cloud, never NaN."""

    def height_above(self, points_world: Float) -> Float:
        """(N,) height of (N, 3) points above the ground below them; the precision of the input is kept."""

    def highest_z(self, lower_xy: Float64, upper_xy: Float64) -> float:
        """A height that the ground within a box in plan does not exceed."""


class _Surface:
    """What all ground models share: heights in chunks, so that no float64 copy of the cloud is made."""

    def z_at(self, xy_world: Float) -> Float64:
        raise ValueError(f"{type(self).__name__} has no surface")

    def height_above(self, points_world: Float) -> Float:
        """(N,) height of (N, 3) points above the ground below them; the precision of the input is kept."""
        points = as_points(points_world, name="points_world")
        height = np.empty(len(points), points.dtype)
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK]
            height[start : start + _CHUNK] = part[:, 2] - self.z_at(part[:, :2])
        return height


@dataclass(frozen=True, eq=False)
class PlaneGround(_Surface):
    """z = a·x + b·y + c.

    Attributes:
        coefficients: (3,) a, b (metres per metre) and c (metres).
        n_inliers: How many points support it.
    """

    coefficients: Float64
    n_inliers: int = 0
    notes: tuple[str, ...] = ()
    kind: GroundKind = "plane"

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", readonly(np.asarray(self.coefficients, np.float64).reshape(3)))

    @property
    def slope_deg(self) -> float:
        """Angle between the plane and the horizontal."""
        return float(np.degrees(np.arctan(np.hypot(*self.coefficients[:2]))))

    def z_at(self, xy_world: Float) -> Float64:
        """(M,) ground height under (M, 2) positions."""
        xy = as_points(xy_world, name="xy_world", n_columns=2)
        a, b, c = self.coefficients
        return a * xy[:, 0].astype(np.float64) + b * xy[:, 1] + c

    def highest_z(self, lower_xy: Float64, upper_xy: Float64) -> float:
        """The height of the plane at the highest corner of the box."""
        slopes = self.coefficients[:2]
        return float(np.maximum(slopes * lower_xy, slopes * upper_xy).sum() + self.coefficients[2])


@dataclass(frozen=True, eq=False)
class TerrainGround(_Surface):
    """A height at every node of a square grid, bilinear between them.

    Outside the grid the edge is carried on along `slope_xy`, so that a position beside the plot has a sensible height.

    Attributes:
        z_m: (nx, ny) heights of the nodes, finite.
        corner_xy_m: (2,) position of node (0, 0).
        cell_m: Distance between nodes.
        slope_xy: (2,) overall slope of the plot along x and y.
        seen: (nx, ny) whether ground points were seen about the node (False: filled in).
    """

    z_m: Float32
    corner_xy_m: Float64
    cell_m: float
    slope_xy: Float64
    seen: Any
    notes: tuple[str, ...] = ()
    kind: GroundKind = "terrain"

    def __post_init__(self) -> None:
        if self.z_m.ndim != 2 or min(self.z_m.shape) < 2 or not np.isfinite(self.z_m).all():
            raise ValueError(f"terrain of shape {self.z_m.shape} must be finite and have two nodes each way")
        for name in ("z_m", "corner_xy_m", "slope_xy", "seen"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    def z_at(self, xy_world: Float) -> Float64:
        """(M,) ground height under (M, 2) positions; extrapolated outside the grid, never NaN for finite positions."""
        xy = as_points(xy_world, name="xy_world", n_columns=2)
        flat = self.z_m.ravel()
        node = np.zeros(len(xy), np.int32)
        fractions = []
        beyond = np.zeros(len(xy))
        for axis, n in enumerate(self.z_m.shape):
            grid = (xy[:, axis] - self.corner_xy_m[axis]) * (1.0 / self.cell_m)
            inside = np.clip(grid, 0.0, n - 1.0)
            low = np.minimum(inside.astype(np.int32), n - 2)
            node = node * np.int32(n) + low
            fractions.append(inside - low)
            beyond += (self.cell_m * self.slope_xy[axis]) * (grid - inside)
        fx, fy = fractions
        z = np.zeros(len(xy))
        for step, weight in ((0, 1.0 - fx), (self.z_m.shape[1], fx)):
            z += weight * (flat[node + step] * (1.0 - fy) + flat[node + (step + 1)] * fy)
        return z + beyond

    def highest_z(self, lower_xy: Float64, upper_xy: Float64) -> float:
        """The highest node, and what the slope adds to it where the box reaches beyond the grid."""
        last_xy = self.corner_xy_m + self.cell_m * (np.array(self.z_m.shape) - 1)
        beyond = np.maximum(np.maximum(self.corner_xy_m - lower_xy, upper_xy - last_xy), 0.0)
        return float(self.z_m.max()) + float(np.abs(self.slope_xy) @ beyond)


@dataclass(frozen=True, eq=False)
class StemBaseGround(_Surface):
    """No ground in the cloud: the nearest stem's lowest point stands in for it.

    Attributes:
        bases_m: (K, 3) lowest points of the stems.
    """

    bases_m: Float64
    notes: tuple[str, ...] = (NO_GROUND_NOTE,)
    kind: GroundKind = "stem_base"

    def __post_init__(self) -> None:
        bases = np.asarray(self.bases_m, np.float64)
        if bases.ndim != 2 or bases.shape[1:] != (3,) or not len(bases) or not np.isfinite(bases).all():
            raise ValueError(f"bases have shape {bases.shape} but (K, 3), finite, is needed")
        object.__setattr__(self, "bases_m", readonly(bases))

    def z_at(self, xy_world: Float) -> Float64:
        """(M,) height of the base nearest to each of the (M, 2) positions."""
        xy = as_points(xy_world, name="xy_world", n_columns=2)
        if len(self.bases_m) == 1:
            return np.full(len(xy), self.bases_m[0, 2])
        nearest = cKDTree(self.bases_m[:, :2]).query(np.asarray(xy, np.float64), workers=N_WORKERS)[1]
        return np.asarray(self.bases_m[nearest, 2], np.float64)

    def highest_z(self, lower_xy: Float64, upper_xy: Float64) -> float:
        """The highest base."""
        return float(self.bases_m[:, 2].max())


def fit_ground(
    points_world: Float,
    *,
    settings: GroundSettings = GroundSettings(),  # noqa: B008 - frozen
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> GroundModel:
    """Find the ground under a plot.

    Args:
        points_world: (N, 3) points, metres, +z up.
        settings: Which model, and its bounds.
        progress: Called between chunks.
        seed: Of the plane's random samples; the terrain uses none.

    Returns:
        A `TerrainGround` (default) or a `PlaneGround` (the paper's "dominant ground plane via RANSAC"); a
        `StemBaseGround` where the terrain method sees that the cloud holds no ground.

    Raises:
        ValueError: Wrong shape, or no finite point.
        CancelledError: From `progress`.
    """
    points = as_points(points_world, name="points_world")
    if not len(points):
        raise ValueError("no ground can be fitted to an empty cloud")
    if settings.method == "plane":
        coefficients, n_inliers = fit_plane_ransac(
            points,
            tolerance_m=settings.plane_tolerance_m,
            n_iterations=settings.plane_iterations,
            max_slope_deg=settings.max_slope_deg,
            progress=progress,
            seed=seed,
        )
        return PlaneGround(coefficients, n_inliers, () if n_inliers >= 3 else (NO_PLANE_NOTE,))
    found = fit_terrain(
        points, cell_m=settings.cell_m, max_slope_deg=settings.max_slope_deg, progress=subprogress(progress, 0.0, 1.0)
    )
    if found.bases_m is not None:
        return StemBaseGround(found.bases_m)
    return TerrainGround(found.z_m, found.corner_xy_m, found.cell_m, found.slope_xy, found.seen, found.notes)
