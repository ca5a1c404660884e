"""A small plot of known diameters: three upright round stems on level ground."""

from __future__ import annotations

import functools

import numpy as np

from dbh_studio.core.cloud import PointCloud

# Centre x and y, diameter, metres; from west to east.
STEMS = ((1.5, 2.0, 0.30), (4.0, 5.5, 0.24), (6.5, 1.5, 0.40))


def stem_points(diameter_m: float, n_points: int = 12_000, *, seed: int = 0) -> np.ndarray:
    """(N, 3) points of a round stem of 5 m around the origin, z above the ground, 2 mm of noise."""
    rng = np.random.default_rng(seed)
    angle, z = rng.uniform(0, 2 * np.pi, n_points), rng.uniform(0, 5, n_points)
    radius = diameter_m / 2 + rng.normal(0, 0.002, n_points)
    return np.c_[radius * np.cos(angle), radius * np.sin(angle), z]


@functools.cache
def plot_points() -> np.ndarray:
    """(N, 3) points of the plot, metres."""
    rng = np.random.default_rng(0)
    ground = np.c_[rng.uniform(0, 8, (30_000, 2)), rng.normal(0, 0.005, 30_000)]
    stems = [stem_points(d, seed=i + 1) + [x, y, 0] for i, (x, y, d) in enumerate(STEMS)]
    return np.concatenate([ground, *stems])


def plot_cloud(*, unit_m: float = 1.0) -> PointCloud:
    """The plot, in the given unit."""
    return PointCloud.from_points(plot_points() / unit_m)
