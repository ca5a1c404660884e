"""The plane a trunk is cut by: upright, turned and shifted about the trunk, or level at a height above the ground."""

from __future__ import annotations

from typing import Any

import numpy as np

from dbh_studio.core.arrays import Bool, Float32, Float64
from dbh_studio.core.trunk_edits import beyond_plane

# Its outline reaches so much farther than the trunk.
_MARGIN = 0.2


class CutPlane:
    """Where the plane is. All lengths are in the unit of the world.

    Attributes:
        is_level: Level at `height`, or upright.
        degrees: Of an upright one: which way it runs, clockwise from north, 0 to 180.
        shift: Of an upright one: how far it is off the middle of the trunk, across the way it runs.
        height: Of a level one, above the ground.
    """

    def __init__(self) -> None:
        self.is_level = False
        self.degrees, self.shift, self.height = 0.0, 0.0, 1.3
        self._middle = np.zeros(3)
        self._ground = 0.0
        self._reach, self._span = 0.5, (0.0, 5.0)

    def lay(self, points: Float32, ground_z: float, line_of_sight: Float64) -> None:
        """Put it through the middle of a trunk.

        Args:
            points: (N, 3) of the trunk.
            ground_z: Height of the ground below it.
            line_of_sight: (3,) in which direction one looks: an upright plane then is seen as a line.
        """
        low, high = np.quantile(points.astype(np.float64), [0.01, 0.99], axis=0)
        # Of the lower part: a crown or a leaning top would move it off the stem.
        lower = points[points[:, 2] <= low[2] + 0.4 * (high[2] - low[2])]
        self._middle = np.median(lower if len(lower) else points, axis=0).astype(np.float64)
        self._ground = ground_z
        self._reach = float(max((high - low)[:2].max(), 1e-3)) / 2
        self._span = float(low[2]), float(high[2])
        away = np.asarray(line_of_sight, np.float64)
        if np.hypot(*away[:2]) > 1e-6:
            self.degrees = float(np.rad2deg(np.arctan2(away[0], away[1])) % 180.0)
        self.shift = 0.0
        self.height = 0.5 * (self._span[0] + self._span[1]) - ground_z

    def set(self, what: str, value: float) -> None:
        """Turn or move it: ``level`` (0 or 1), ``degrees``, ``shift`` or ``height``."""
        if what == "level":
            self.is_level = bool(value)
        elif what == "degrees":
            self.degrees = value % 180.0
        elif what == "shift":
            self.shift = float(np.clip(value, -self.limits()["shift"], self.limits()["shift"]))
        else:
            self.height = value

    def limits(self) -> dict[str, float]:
        """How far it can be moved."""
        return {
            "shift": 1.1 * self._reach,
            "low": self._span[0] - self._ground,
            "high": self._span[1] - self._ground,
        }

    @property
    def normal(self) -> Float64:
        """(3,) the side that is cut off."""
        if self.is_level:
            return np.array([0.0, 0.0, 1.0])
        angle = np.deg2rad(self.degrees)
        return np.array([np.cos(angle), -np.sin(angle), 0.0])

    @property
    def through(self) -> Float64:
        """(3,) a point of it."""
        if self.is_level:
            return np.array([*self._middle[:2], self._ground + self.height])
        return np.asarray(self._middle + self.shift * self.normal, np.float64)

    def beyond(self, points: Float32) -> Bool:
        """(N,) which points lie on the side that is cut off."""
        return beyond_plane(points, self.through, self.normal)

    def corners(self) -> Float32:
        """(4, 3) its outline about the trunk."""
        reach, (low, high) = self._reach + _MARGIN * max(self._reach, 1e-3) + 0.1 * self._reach, self._span
        middle = self.through
        if self.is_level:
            across = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * reach
            return (middle + across).astype(np.float32)
        along = np.array([self.normal[1], -self.normal[0], 0.0]) * reach
        base = np.array([middle[0], middle[1], 0.0])
        ends: Any = [(-along, low), (along, low), (along, high), (-along, high)]
        return np.array([base + off + [0.0, 0.0, z] for off, z in ends], np.float32)
