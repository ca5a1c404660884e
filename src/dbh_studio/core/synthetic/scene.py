"""Where everything stands: the ground, the stems on it, the camera's walk and its noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Float, Float32, Float64, Int32
from dbh_studio.core.synthetic.capture import Noise, Visibility, visibility, walk
from dbh_studio.core.synthetic.fields import Terrain, WaveField
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.stems import Stem, make_stems


@dataclass(eq=False)
class Scene:
    """What the makers of the parts share."""

    recipe: PlotRecipe
    rng: np.random.Generator
    stems: list[Stem]
    terrain: Terrain
    cameras: Float64
    circles: Float64
    noise: Noise

    def see(self, points: Float, normals: Float | None) -> Visibility:
        """Visibility from the walk, or of everything from everywhere."""
        if len(self.cameras):
            return visibility(points, normals, self.cameras, self.circles)
        return Visibility(np.ones(len(points)), np.full((len(points), 2), -1, np.int32))

    def eyes(self, points: Float, normals: Float | None, cameras: Int32) -> Float32:
        """(N, 3) where each point was seen from; without a walk, 4 m straight in front of it."""
        if len(self.cameras):
            return self.cameras.astype(np.float32)[cameras]
        outward = np.array([0.3, 0.3, 0.9]) if normals is None else normals
        return (points + 4.0 * outward).astype(np.float32)


def make_scene(recipe: PlotRecipe, rng: np.random.Generator) -> Scene:
    """Lay out the ground, the stems and the walk of a recipe."""
    stems = make_stems(rng, recipe)
    direction = rng.uniform(0, 2 * np.pi)
    slope = np.tan(np.radians(recipe.slope_deg)) * np.array([np.cos(direction), np.sin(direction)])
    relief = WaveField.random(rng, n_dims=2, wavelengths_m=(4, 16), amplitude=recipe.relief_m / 3)
    clods = WaveField.random(rng, n_dims=2, wavelengths_m=(0.12, 1.2), amplitude=0.012, n_waves=24)
    radii = np.array([stem.radius_m for stem in stems])
    places = np.array([stem.base[:2] for stem in stems]).reshape(-1, 2)
    terrain = Terrain(slope, relief, clods, places, radii)
    stems = [replace(stem, base=np.append(stem.base[:2], _mean_ground(stem, terrain))) for stem in stems]
    cameras = walk(recipe, stems, terrain, rng) if recipe.capture == "walk" else np.zeros((0, 3))
    circles = np.column_stack([places, radii])
    return Scene(recipe, rng, stems, terrain, cameras, circles, Noise.random(rng, recipe.noise))


def _mean_ground(stem: Stem, terrain: Terrain) -> float:
    """Mean height of the ground on a ring about the stem, 10 cm from the bark."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = stem.base[:2] + (stem.radius_m + 0.10) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return float(terrain.z(ring).mean(dtype=np.float64))
