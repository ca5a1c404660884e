"""The shape that is fitted: a leaning, tapering tube whose section is a circle with waves on it.

A point at height h above breast height has, about the axis c + s h, the distance r, the angle t and the position w
along the axis. The bark is at

    r(t, w) = R - T w + Σ aₖ cos k t + bₖ sin k t,   k = 2, 3, …

There is no k = 1: it would be a shift of the section, which c already is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int64

N_PLACE = 4  # parameters of the axis: shift (2) and slope (2)
_CELL_M, _LAYER_M = 0.05, 0.10
_POINTS_PER_CELL = 6.0


@dataclass(frozen=True, eq=False)
class Tube:
    """One tube; lengths in metres, heights from breast height.

    Attributes:
        centre: (2,) where the axis passes breast height.
        slope: (2,) horizontal metres per metre of height.
        radius: Mean radius at breast height.
        taper: Metres of radius lost per metre of stem.
        waves: (2 (K - 1),) a₂, b₂, a₃, b₃, …
        sigma: Robust standard deviation of the points' distances to it.
    """

    centre: Float64
    slope: Float64
    radius: float
    taper: float
    waves: Float64
    sigma: float

    def frame(self) -> tuple[Float64, Float64, Float64]:
        """Unit vectors u, v across the axis and w along it; u as near to x as can be."""
        # Numbers, not arrays of three: this is called some forty times a stem.
        a, b = float(self.slope[0]), float(self.slope[1])
        wz = 1.0 / math.sqrt(a * a + b * b + 1.0)
        wx, wy = a * wz, b * wz
        ux = math.sqrt(1.0 - wx * wx)
        uy, uz = -wx * wy / ux, -wx * wz / ux
        v = np.array([wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux])
        return np.array([ux, uy, uz]), v, np.array([wx, wy, wz])

    def larger(self, factor: float) -> Tube:
        """The same with a section so many times as large."""
        return replace(self, radius=self.radius * factor, waves=self.waves * factor)

    def polar(self, points: Float64) -> Polar:
        """Where (N, 3) points are about the axis."""
        u, v, w = self.frame()
        height = points[:, 2]
        across = points[:, 0] - self.centre[0] - self.slope[0] * height
        up = points[:, 1] - self.centre[1] - self.slope[1] * height
        x, y = across * u[0] + up * u[1], across * v[0] + up * v[1]
        distance = np.sqrt(x * x + y * y) + 1e-9
        return Polar(x / distance, y / distance, distance, height / w[2] + across * w[0] + up * w[1])

    def surface(self, at: Polar) -> Float64:
        """(N,) distance of the bark from the axis in the points' directions."""
        surface = self.radius - self.taper * at.along
        if len(self.waves):
            surface = surface + self.waves @ wave_basis(at.cos, at.sin, 1 + len(self.waves) // 2)
        return surface


@dataclass(frozen=True, eq=False)
class Polar:
    """Points about an axis: (N,) cosine and sine of the angle, distance from the axis, position along it."""

    cos: Float64
    sin: Float64
    distance: Float64
    along: Float64

    def angle(self) -> Float64:
        """(N,) radians in -π..π."""
        return np.arctan2(self.sin, self.cos)

    def part(self, mask: Bool) -> Polar:
        """Some of the points."""
        rows = np.flatnonzero(mask)  # once for all four: taking by a mask looks for them each time
        return Polar(self.cos[rows], self.sin[rows], self.distance[rows], self.along[rows])

    def design(self, highest: int) -> Float64:
        """(4 + 2 highest, N) derivatives of r by shift (2), tilt (2), radius, taper and waves."""
        design = np.empty((N_PLACE + 2 * highest, len(self.cos)))
        design[0], design[1] = self.cos, self.sin
        np.multiply(self.along, design[:2], out=design[2:4])
        design[4] = 1.0
        np.negative(self.along, out=design[5])
        wave_basis(self.cos, self.sin, highest, out=design[6:])
        return design


def wave_basis(cos: Float64, sin: Float64, highest: int, *, out: Float64 | None = None) -> Float64:
    """(2 (highest - 1), ...) cos 2t, sin 2t, cos 3t, … from the cosine and sine of t, without further trigonometry.

    Args:
        cos: Of t.
        sin: Of t.
        highest: The last wave.
        out: Where to put them.
    """
    waves = np.empty((max(2 * (highest - 1), 0), *cos.shape)) if out is None else out
    turn = np.empty(cos.shape, np.complex128)
    turn.real, turn.imag = cos, sin
    power = turn.copy()
    for row in range(0, len(waves), 2):
        power *= turn
        waves[row], waves[row + 1] = power.real, power.imag
    return waves


def cells_of(angle: Float64, along: Float64, radius: float, n_points: float) -> tuple[Int64, int]:
    """(N,) which patch of bark each point is on, numbered from 0, and how many patches there are.

    Points of one patch share most of their error (matching windows overlap, a pass is shifted as a whole), so a patch
    and not a point is what counts. Patches are 5 × 10 cm, larger where points are few.
    """
    most = 2 * np.pi * radius / _CELL_M * 10.0
    coarse = min(max(math.sqrt(_POINTS_PER_CELL * most / max(n_points, 1.0)), 1.0), 3.0)
    n_around = min(max(round(2 * np.pi * radius / (_CELL_M * coarse)), 16), 72)
    around = ((angle + np.pi) * (n_around / (2 * np.pi))).astype(np.int64)
    around[around == n_around] = 0
    layer = np.floor(along / (_LAYER_M * coarse)).astype(np.int64)
    layer -= layer.min(initial=0)
    key = layer * n_around + around
    used = np.bincount(key) > 0
    return (np.cumsum(used) - 1)[key], int(used.sum())


def tukey(error: Float64, cut: float | Float64) -> Float64:
    """Tukey's biweight of (..., N) errors: 1 at zero, 0 from `cut` on."""
    ratio = error / cut
    weight: Float64 = np.maximum(0.0, 1.0 - ratio * ratio) ** 2
    return weight
