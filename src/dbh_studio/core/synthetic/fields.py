"""Smooth random fields, and the terrain made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.core.arrays import Float32, Float64

_CHUNK = 500_000


@dataclass(frozen=True, eq=False)
class WaveField:
    """A smooth random function with mean 0 and standard deviation `amplitude`: a sum of plane waves.

    Attributes:
        vectors: (K, D) wave vectors, radians per metre.
        phases: (K,) radians.
        amplitude: Standard deviation of the sum.
    """

    vectors: Float32
    phases: Float32
    amplitude: float

    @classmethod
    def random(
        cls,
        rng: np.random.Generator,
        *,
        n_dims: int,
        wavelengths_m: tuple[float, float],
        amplitude: float,
        n_waves: int = 10,
    ) -> WaveField:
        """Waves in random directions, their lengths log-uniform between the two given."""
        directions = rng.normal(size=(n_waves, n_dims))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths = np.exp(rng.uniform(np.log(wavelengths_m[0]), np.log(wavelengths_m[1]), n_waves))
        vectors = directions * (2 * np.pi / lengths[:, None])
        return cls(vectors.astype(np.float32), rng.uniform(0, 2 * np.pi, n_waves).astype(np.float32), amplitude)

    def __call__(self, points: NDArray[np.floating[Any]]) -> Float32:
        """(N,) values at (N, D) points."""
        values = np.zeros(len(points), np.float32)
        for start in range(0, len(points), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            part = np.asarray(points[chunk, : self.vectors.shape[1]], np.float32)
            for vector, phase in zip(self.vectors, self.phases, strict=True):
                values[chunk] += np.cos(part @ vector + phase)
        values *= np.float32(self.amplitude * np.sqrt(2.0 / len(self.phases)))
        return values


@dataclass(frozen=True, eq=False)
class Terrain:
    """The forest floor: a slope, hollows and humps, and a mound around every stem.

    Attributes:
        slope: (2,) rise per metre along x and y.
        relief: Hollows and humps.
        roughness: Clods and litter.
        mounds_xy: (T, 2) where stems stand.
        mounds_m: (T,) radius of the stems.
    """

    slope: Float64
    relief: WaveField
    roughness: WaveField
    mounds_xy: Float64
    mounds_m: Float64

    def smooth_z(self, xy: NDArray[np.floating[Any]]) -> Float32:
        """(N,) height at (N, >=2) positions, without clods and mounds."""
        xy = np.asarray(xy, np.float32)[:, :2]
        height: Float32 = xy @ self.slope.astype(np.float32) + self.relief(xy)
        return height

    def z(self, xy: NDArray[np.floating[Any]]) -> Float32:
        """(N,) height at (N, >=2) positions, everything included."""
        xy = np.asarray(xy, np.float32)[:, :2]
        height = self.smooth_z(xy) + self.roughness(xy)
        for (x, y), radius in zip(self.mounds_xy, self.mounds_m, strict=True):
            reach = 2.5 * radius + 0.5
            near = np.flatnonzero((np.abs(xy[:, 0] - x) < reach) & (np.abs(xy[:, 1] - y) < reach))
            squared = (xy[near, 0] - x) ** 2 + (xy[near, 1] - y) ** 2
            # Soil and litter pile up by about a fifth of the stem's radius; the wider the stem the wider the pile.
            height[near] += (0.2 * radius * np.exp(-squared / (0.7 * radius + 0.15) ** 2 / 2)).astype(np.float32)
        return height
