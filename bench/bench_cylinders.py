"""A plot of plain round stems on flat ground, evenly and densely covered with points, made with numpy alone.

It follows the description of the plots on which 3DFin was first tried for this project: 9 stems of 12-60 cm that lose
2 % of their diameter per metre, 5 mm of radial noise, 18 x 18 m, 8 mm between points, ground and low vegetation, about
1.7 million points. That description does not say how high the stems are and how dense the ground is. The ground at 8 mm
would take five million points alone, and stems of 20 m two and a half; so here the stems are seen up to 10 m, and the
ground has a point every 43 mm. That gives the area, the spacing on the stems and the number of points at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_match import Table

from dbh_studio.core.cloud import PointCloud
from dbh_studio.io.las import write_las


@dataclass(frozen=True)
class CylinderRecipe:
    """What the plot is made of; metres."""

    seed: int
    n_per_side: int = 3
    side_m: float = 18.0
    thinnest_m: float = 0.12
    thickest_m: float = 0.60
    taper_per_m: float = 0.02
    seen_up_to_m: float = 10.0
    spacing_m: float = 0.008
    ground_spacing_m: float = 0.043
    noise_m: float = 0.005
    n_vegetation: int = 50_000
    vegetation_m: float = 0.4


def make(recipe: CylinderRecipe, path: Path) -> Table:
    """Write the plot to `path` unless it is there; what is true of its stems."""
    rng = np.random.default_rng(recipe.seed)
    n = recipe.n_per_side
    middle = recipe.side_m / n * (np.arange(n) + 0.5)
    places = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2) + rng.uniform(-1.0, 1.0, (n * n, 2))
    diameters = rng.permutation(np.linspace(recipe.thinnest_m, recipe.thickest_m, n * n))
    if not path.is_file():
        stems = [_stem(recipe, place, diameter, rng) for place, diameter in zip(places, diameters, strict=True)]
        xyz = np.concatenate([*stems, _ground(recipe, rng), _vegetation(recipe, rng)])
        path.parent.mkdir(parents=True, exist_ok=True)
        write_las(path, PointCloud(xyz.astype(np.float32), np.zeros(3), name=path.name))
    names = tuple(str(number) for number in range(1, n * n + 1))
    return Table(names, places, 100.0 * diameters)


def _stem(recipe: CylinderRecipe, place: np.ndarray, diameter_m: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points in rings that are as far apart as their points are; the diameter is that at 1.3 m."""
    height = np.arange(0.0, recipe.seen_up_to_m, recipe.spacing_m)
    radius = 0.5 * diameter_m * (1.0 - recipe.taper_per_m * (height - 1.3))
    count = np.rint(2 * np.pi * radius / recipe.spacing_m).astype(int)
    ring = np.repeat(np.arange(len(height)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    angle = 2 * np.pi * (within / count[ring] + rng.random(len(height))[ring])
    distance = radius[ring] + rng.normal(0.0, recipe.noise_m, len(ring))
    return np.column_stack([place[0] + distance * np.cos(angle), place[1] + distance * np.sin(angle), height[ring]])


def _ground(recipe: CylinderRecipe, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points on a square grid, with the noise in height."""
    line = np.arange(0.0, recipe.side_m, recipe.ground_spacing_m)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    return np.column_stack([x, y, rng.normal(0.0, recipe.noise_m, len(x))])


def _vegetation(recipe: CylinderRecipe, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points anywhere up to its height, fewer further up."""
    xy = rng.uniform(0.0, recipe.side_m, (recipe.n_vegetation, 2))
    return np.column_stack([xy, recipe.vegetation_m * rng.random(recipe.n_vegetation) ** 2])
