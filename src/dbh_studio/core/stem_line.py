"""The lower part of a stem as a straight line with a radius: all that is needed to look at it from somewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Float, Float64, as_points, readonly

_N_BINS, _MOST_POINTS = 16, 40_000
# A stem that leans more lies on the ground, and heights along it mean nothing.
_LEAST_UPRIGHT = 0.5
_TALL_IN_RADII, _LOWEST_IN_RADII = 16.0, 0.5


@dataclass(frozen=True, eq=False)
class StemLine:
    """A stretch of a stem, +z up, any unit.

    Attributes:
        point: (3,) on the axis, where one looks at: breast height where that is known.
        direction: (3,) unit vector along the axis, upwards.
        radius: Of the stem, positive.
        low: z of the lower end of the stretch.
        high: z of its upper end, above `low`.
    """

    point: Float64
    direction: Float64
    radius: float
    low: float
    high: float

    def __post_init__(self) -> None:
        point, direction = np.asarray(self.point, np.float64), np.asarray(self.direction, np.float64)
        if point.shape != (3,) or direction.shape != (3,):
            raise ValueError(f"point {point.shape} and direction {direction.shape}; (3,) and (3,) are needed")
        if not np.isfinite([*point, *direction]).all() or not direction[2] > 0.0:
            raise ValueError(f"a stem at {point} along {direction} does not go upwards")
        if not (self.radius > 0.0 and np.isfinite(self.radius) and self.high > self.low):
            raise ValueError(f"a stem of radius {self.radius} from {self.low} to {self.high}")
        direction = direction / np.linalg.norm(direction)
        if direction[2] < _LEAST_UPRIGHT:
            direction = np.array([0.0, 0.0, 1.0])
        object.__setattr__(self, "point", readonly(point))
        object.__setattr__(self, "direction", readonly(direction))

    @property
    def middle(self) -> float:
        """z half way up."""
        return 0.5 * (self.low + self.high)

    def at(self, z: Float64) -> Float64:
        """(K, 3) where the axis is at (K,) heights."""
        steps = (np.asarray(z, np.float64) - self.point[2]) / self.direction[2]
        return np.asarray(self.point + steps[:, None] * self.direction)

    @classmethod
    def of_points(
        cls, points: Float, *, low: float | None = None, high: float | None = None, look_at: float | None = None
    ) -> StemLine | None:
        """The line of a trunk whose ring is not known, by the middles of its slices.

        Args:
            points: (N, 3) of the trunk, +z up.
            low: z of the lower end; None takes the trunk's own.
            high: z of the upper end; None takes so much as a stem of this girth is looked at.
            look_at: z of `point`; None for the middle.

        Returns:
            None where there are too few points, or none in the stretch.
        """
        every = as_points(points, name="points")
        xyz: Float64 = every[:: max(1, len(every) // _MOST_POINTS)].astype(np.float64)
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
        if len(xyz) < 10:
            return None
        base, top = (float(value) for value in np.quantile(xyz[:, 2], [0.01, 0.99]))
        start, end = (base if low is None else low), (top if high is None else high)
        middles, radius = _slices(xyz, start, end if end > start else start + 1e-9)
        if radius is None:
            # The trunk begins above the stretch, or ends below it: its own place says at least where it stands.
            middles, radius = _slices(xyz, base, max(top, base + 1e-9))
        if radius is None:
            return None
        if high is None:
            start = start if low is not None else base + _LOWEST_IN_RADII * radius
            end = min(end, start + _TALL_IN_RADII * radius)
            middles, again = _slices(xyz, base, end)
            radius = again or radius
        end = max(end, start + 2.0 * radius)
        height = 0.5 * (start + end) if look_at is None else look_at
        slope, offset = _line(middles)
        return cls(np.array([*(offset + slope * height), height]), np.array([*slope, 1.0]), radius, start, end)


def _slices(points: Float64, low: float, high: float) -> tuple[Float64, float | None]:
    """(K, 3) middles of slices, and the typical half width of one; None where no slice has enough points."""
    number = np.floor((points[:, 2] - low) / (high - low) * _N_BINS)
    middles, halves = [], []
    for which in range(_N_BINS):
        inside = points[number == which]
        if len(inside) < 5:
            continue
        small, large = np.quantile(inside[:, :2], [0.04, 0.96], axis=0)
        middles.append([*(0.5 * (small + large)), inside[:, 2].mean()])
        halves.append(0.52 * float((large - small).max()))
    if not middles or not np.median(halves) > 0.0:
        return np.empty((0, 3)), None
    return np.array(middles), float(np.median(halves))


def _line(middles: Float64) -> tuple[Float64, Float64]:
    """(2,) x and y per z, and (2,) x and y at z = 0; upright where the middles do not tell."""
    centre = np.median(middles, axis=0)
    height = middles[:, 2] - centre[2]
    spread = float(height @ height)
    slope = np.zeros(2)
    if len(middles) >= 4 and spread > 0.0:
        slope = height @ (middles[:, :2] - middles[:, :2].mean(axis=0)) / spread
        if np.hypot(*slope) > 0.6:
            slope = np.zeros(2)
    return slope, centre[:2] - slope * centre[2]
