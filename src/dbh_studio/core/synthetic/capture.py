"""What a camera carried through the plot sees of it, and how wrong photogrammetry then is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32
from dbh_studio.core.synthetic.fields import Terrain, WaveField
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.stems import Stem

EYE_HEIGHT_M = 1.8
RANGE_M = 16.0
_STEP_M = 1.0
_N_SECTORS = 1440
# A surface must lie this much behind the nearest bark in its direction before it counts as hidden.
_SLACK_M = 0.12
_CHUNK = 500_000


@dataclass(frozen=True, eq=False)
class Visibility:
    """How well surface patches are seen.

    Attributes:
        weight: (M,) 0 unseen .. 1 as dense as it gets.
        cameras: (M, 2) indices of the two best cameras; -1 where there is none.
    """

    weight: Float64
    cameras: Int32


def walk(recipe: PlotRecipe, stems: list[Stem], terrain: Terrain, rng: np.random.Generator) -> Float64:
    """(C, 3) camera positions along parallel lanes, stepping around stems."""
    side = recipe.side_m
    n_lanes = max(1, round(side / recipe.lane_m))
    offsets = (np.arange(n_lanes) + 0.5) * side / n_lanes
    along = np.arange(1.0, side - 1.0 + 1e-9, _STEP_M)
    lanes = []
    for number, offset in enumerate(offsets):
        y = along if number % 2 == 0 else along[::-1]
        sway = 0.5 * np.sin(y / 2.7 + rng.uniform(0, 6))
        lanes.append(np.stack([offset + sway, y], axis=1))
        if number + 1 < n_lanes:
            x = np.arange(offset + _STEP_M, offsets[number + 1], _STEP_M)
            lanes.append(np.stack([x, np.full_like(x, y[-1])], axis=1))
    xy = np.concatenate(lanes)
    for stem in stems:
        away = xy - stem.base[:2]
        distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
        keep = stem.radius_m + (2.8 if stem.hidden_azimuth is not None else 1.1)
        xy = np.where(distance < keep, stem.base[:2] + away / distance * keep, xy)
    z = terrain.smooth_z(xy) + EYE_HEIGHT_M + rng.normal(0, 0.04, len(xy))
    return np.column_stack([xy, z])


def _first_hit(camera: Float64, circles: Float64) -> Float32:
    """(_N_SECTORS,) distance to the nearest bark in each horizontal direction from one camera."""
    depth = np.full(_N_SECTORS, np.inf, np.float32)
    away = circles[:, :2] - camera[:2]
    distance = np.linalg.norm(away, axis=1)
    for (dx, dy), d, radius in zip(away, distance, circles[:, 2], strict=True):
        if radius < d < RANGE_M:
            middle = np.arctan2(dy, dx) / (2 * np.pi) * _N_SECTORS
            half = np.arcsin(radius / d) / (2 * np.pi) * _N_SECTORS
            sectors = np.arange(int(np.ceil(middle - half)), int(np.floor(middle + half)) + 1) % _N_SECTORS
            depth[sectors] = np.minimum(depth[sectors], d - radius)
    return depth


def visibility(points: Float, normals: Float | None, cameras: Float64, circles: Float64) -> Visibility:
    """How well each patch is seen from a walk.

    Args:
        points: (M, 3) middles of the patches, metres.
        normals: (M, 3) outward; None for leaves, which are seen from any side.
        cameras: (C, 3) positions.
        circles: (T, 3) x, y and radius of the stems that hide what is behind them.
    """
    points = np.asarray(points, np.float32)
    score, n_seen = np.zeros(len(points), np.float32), np.zeros(len(points), np.int32)
    best_score, best = np.zeros((len(points), 2), np.float32), np.full((len(points), 2), -1, np.int32)
    tree = cKDTree(points[:, :2])
    for number, camera in enumerate(cameras):
        near = np.asarray(tree.query_ball_point(camera[:2], RANGE_M), np.intp)
        if not len(near):
            continue
        depth = _first_hit(camera, circles)
        ray = camera.astype(np.float32) - points[near]
        flat = np.hypot(ray[:, 0], ray[:, 1])
        turn = np.arctan2(-ray[:, 1], -ray[:, 0]) / (2 * np.pi)
        sector = np.round(turn * _N_SECTORS).astype(np.intp) % _N_SECTORS
        distance = np.linalg.norm(ray, axis=1)
        facing = np.float32(0.7) if normals is None else np.einsum("ij,ij->i", normals[near], ray) / distance
        # Grazing views do not match between photos.
        seen = (flat < depth[sector] + _SLACK_M) & (facing >= 0.15)
        value = np.where(seen, facing, 0) * (2.5 / np.maximum(distance, 1.5)) ** 2
        score[near] += value
        n_seen[near] += value > 0
        first = value > best_score[near, 0]
        second = ~first & (value > best_score[near, 1])
        moved, kept = near[first], near[second]
        best_score[moved, 1], best[moved, 1] = best_score[moved, 0], best[moved, 0]
        best_score[moved, 0], best[moved, 0] = value[first], number
        best_score[kept, 1], best[kept, 1] = value[second], number
    weight = np.where(n_seen >= 2, 1 - np.exp(-0.6 * score), 0.0)
    best[:, 1] = np.where(best[:, 1] < 0, best[:, 0], best[:, 1])
    return Visibility(weight.astype(np.float64), best)


@dataclass(frozen=True, eq=False)
class Noise:
    """The error of a photogrammetric cloud.

    Along the ray it is heavy-tailed and grows with distance; neighbours share a part of it, because matching windows
    overlap; surfaces come out a little too thick.

    Attributes:
        level: 0 none, 1 a careful video.
        shared: (3 fields) the part that neighbours share, one per coordinate scale.
    """

    level: float
    shared: WaveField

    @classmethod
    def random(cls, rng: np.random.Generator, level: float) -> Noise:
        """The noise of one reconstruction."""
        return cls(level, WaveField.random(rng, n_dims=3, wavelengths_m=(0.12, 1.2), amplitude=1.0, n_waves=12))

    def apply(self, points: Float32, normals: Float | None, eyes: Float, rng: np.random.Generator) -> None:
        """Move (N, 3) points in place, each seen from its (N, 3) eye. Normals make surfaces bloat; leaves have none."""
        if self.level == 0:
            return
        for start in range(0, len(points), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            ray = points[chunk] - np.asarray(eyes[chunk], np.float32)
            distance = np.linalg.norm(ray, axis=1).astype(np.float32)
            ray /= np.maximum(distance, 1e-3)[:, None]
            # Student's t with 3 degrees of freedom, its far tail cut: those become flying points elsewhere.
            tail = rng.standard_normal(len(ray), np.float32)
            tail /= np.sqrt(rng.standard_gamma(1.5, len(ray), np.float32) / np.float32(1.5))
            along = np.clip(tail, -6, 6) * (0.0010 + 0.0006 * distance)
            along += self.shared(points[chunk]) * (0.0008 + 0.0004 * distance)
            points[chunk] += np.float32(self.level) * along[:, None] * ray
            if normals is not None:
                swell = np.float32(self.level) * (0.0005 + 0.0001 * distance)
                points[chunk] += swell[:, None] * np.asarray(normals[chunk], np.float32)

    def fly(self, points: Float32, grazing: Bool, eyes: Float, rng: np.random.Generator) -> None:
        """Push a few of the `grazing` points back along their ray, as happens behind silhouettes. In place."""
        share = min(0.06 * self.level, 0.3)
        chosen = np.flatnonzero(grazing & (rng.random(len(points), np.float32) < share))
        ray = points[chosen] - np.asarray(eyes[chosen], np.float32)
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-3)
        points[chosen] += (rng.exponential(0.18, len(chosen)).astype(np.float32) + np.float32(0.02))[:, None] * ray


def draw_cells(rng: np.random.Generator, weights: NDArray[np.floating[Any]], n_points: int) -> NDArray[np.intp]:
    """(~n_points,) sorted cell numbers, each cell drawn in proportion to its weight."""
    total = float(weights.sum())
    if total <= 0 or n_points <= 0:
        return np.zeros(0, np.intp)
    return np.repeat(np.arange(len(weights)), rng.poisson(weights * (n_points / total)))
