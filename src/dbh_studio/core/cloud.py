"""The point cloud: float32 coordinates about a float64 origin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float32, Float64, UInt8, readonly


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the `source` frame, as a file gave them.

    A point is ``origin + xyz``. Survey coordinates such as 500 000 / 4 500 000 do not fit float32 (3 cm steps), offsets
    of a few hundred metres about an origin do (0.03 mm at 500 m).

    Attributes:
        xyz: (N, 3) float32, source units, relative to `origin`.
        origin: (3,) float64, source units.
        rgb: (N, 3) uint8 colours, or None.
        attributes: Other per-point values by name (``intensity``, ``treeID``, …), each of length N.
        crs: Coordinate reference system, as WKT or ``EPSG:nnnn``; None where unknown.
        name: What to call it in messages (the file's name).
    """

    xyz: Float32
    origin: Float64
    rgb: UInt8 | None = None
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    crs: str | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.xyz.dtype != np.float32:
            raise ValueError(f"xyz has shape {self.xyz.shape} and type {self.xyz.dtype} but (N, 3) float32 is needed")
        if self.rgb is not None and self.rgb.shape != self.xyz.shape:
            raise ValueError(f"rgb has shape {self.rgb.shape} but {self.xyz.shape} is needed")
        for name, values in self.attributes.items():
            if len(values) != len(self.xyz):
                raise ValueError(f"attribute {name!r} has {len(values)} values for {len(self.xyz)} points")
        object.__setattr__(self, "xyz", readonly(self.xyz))
        object.__setattr__(self, "origin", readonly(np.asarray(self.origin, np.float64).reshape(3)))
        if self.rgb is not None:
            object.__setattr__(self, "rgb", readonly(self.rgb))
        frozen = {name: readonly(np.asarray(values)) for name, values in self.attributes.items()}
        object.__setattr__(self, "attributes", MappingProxyType(frozen))

    def __len__(self) -> int:
        return len(self.xyz)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.xyz, self.origin, self.rgb, dict(self.attributes), self.crs, self.name)

    @classmethod
    def from_points(cls, points_src: NDArray[np.floating[Any]], **others: Any) -> PointCloud:
        """A cloud from absolute coordinates: the origin is the rounded-down lower corner, so nothing is lost.

        Args:
            points_src: (N, 3) absolute coordinates, source units; float64 where they are large.
            **others: `rgb`, `attributes`, `crs`, `name`.
        """
        points = np.asarray(points_src)
        origin = np.floor(points.min(axis=0).astype(np.float64)) if len(points) else np.zeros(3)
        xyz = np.empty(points.shape, np.float32)
        np.subtract(points, origin, out=xyz, casting="unsafe")
        return cls(xyz, origin, **others)

    def subset(self, indices: NDArray[Any]) -> PointCloud:
        """The points at `indices` (integers or a mask), with all their values."""
        return PointCloud(
            self.xyz[indices],
            self.origin,
            None if self.rgb is None else self.rgb[indices],
            {name: values[indices] for name, values in self.attributes.items()},
            self.crs,
            self.name,
        )

    def bounds_src(self) -> Float64:
        """(2, 3) lower and upper corner, absolute source coordinates. Raises ValueError on an empty cloud."""
        if not len(self):
            raise ValueError("an empty cloud has no bounds")
        return np.stack([self.xyz.min(axis=0), self.xyz.max(axis=0)]).astype(np.float64) + self.origin
