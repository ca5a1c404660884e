"""The forest floor and what lies on it."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float32, Float64, UInt8
from dbh_studio.core.synthetic.capture import draw_cells
from dbh_studio.core.synthetic.fields import WaveField
from dbh_studio.core.synthetic.plants import Painted, paint
from dbh_studio.core.synthetic.scene import Scene

# Fallen leaves: of 1009 squares of the floor those from .. to have this colour.
_LEAVES = (
    (0, 90, (188, 142, 88)),
    (90, 150, (166, 112, 66)),
    (150, 190, (202, 174, 116)),
    (190, 240, (100, 78, 58)),
)


def make_ground(scene: Scene, n_points: int) -> Painted:
    """The forest floor: litter, leaves, moss and bare soil."""
    rng, side, cell = scene.rng, scene.recipe.side_m, 0.25
    n_side = int(np.ceil(side / cell))
    corner = np.stack(np.meshgrid(np.arange(n_side), np.arange(n_side)), axis=-1).reshape(-1, 2) * cell
    middle = corner + cell / 2
    up = np.tile(np.array([0, 0, 1.0]), (len(middle), 1))
    seen = scene.see(np.column_stack([middle, scene.terrain.smooth_z(middle)]), up)
    # The view falls off quickly along the ground; a third of that is taken back, as dense matching fills the floor.
    weight = seen.weight**0.65
    cells = draw_cells(rng, weight, n_points)
    xy = corner[cells] + rng.random((len(cells), 2)) * cell
    inside = (xy < side).all(axis=1)
    for x, y, radius in scene.circles:
        inside &= np.hypot(xy[:, 0] - x, xy[:, 1] - y) > radius
    # Where matching failed: ragged gaps, rather than discs.
    gaps = WaveField.random(rng, n_dims=2, wavelengths_m=(0.4, 2.5), amplitude=1.0, n_waves=14)
    if scene.recipe.noise > 0:
        inside &= gaps(xy) < 2.5
    xy, cells = xy[inside], cells[inside]
    clods = scene.terrain.roughness(xy)
    points = np.column_stack([xy, scene.terrain.z(xy)]).astype(np.float32)
    points[:, 2] += rng.normal(0, 0.006, len(points)).astype(np.float32)
    colour = _floor_colour(rng, points, clods)
    normals = np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape)
    eyes = scene.eyes(points, normals, seen.cameras[cells, rng.integers(0, 2, len(cells))])
    scene.noise.apply(points, normals, eyes, rng)
    return Painted(points, colour)


def _floor_colour(rng: np.random.Generator, points: Float32, clods: Float32) -> UInt8:
    """Brown litter with single fallen leaves, patches of moss, and darker hollows."""
    broad = WaveField.random(rng, n_dims=2, wavelengths_m=(1.2, 7), amplitude=1.0)(points)
    fine = WaveField.random(rng, n_dims=2, wavelengths_m=(0.15, 0.8), amplitude=1.0, n_waves=14)(points)
    litter = np.array([142, 112, 82], np.float32) + np.array([15, 12, 9], np.float32) * fine[:, None]
    mossy = np.clip(0.75 * broad + 0.35 * fine - 0.75, 0, 1)[:, None]
    colour = (1 - mossy) * litter + mossy * np.array([108, 134, 62], np.float32)
    # One colour per fallen leaf: the floor is cut into 5 cm squares and some of them are leaves.
    square = np.floor(points[:, :2] / 0.05).astype(np.int64)
    draw = ((square[:, 0] * 73_856_093) ^ (square[:, 1] * 19_349_663)) % 1009
    for low, high, rgb in _LEAVES:
        leaf = (draw >= low) & (draw < high) & (mossy[:, 0] < 0.5)
        colour[leaf] = rgb
    return paint(colour, 0.95 + 4.0 * clods + 0.07 * rng.standard_normal(len(points), np.float32))


def make_logs(scene: Scene, n_points: int) -> list[Painted]:
    """Fallen stems, half sunk into the litter, mossy above."""
    rng, parts, side = scene.rng, [], scene.recipe.side_m
    for _ in range(scene.recipe.n_logs):
        n = n_points // max(scene.recipe.n_logs, 1)
        heading, length, radius = rng.uniform(0, 2 * np.pi), rng.uniform(3, min(9.0, side / 2)), rng.uniform(0.07, 0.2)
        step = np.array([np.cos(heading), np.sin(heading)])
        start = _log_place(scene, step * length)
        along, angle = rng.random(n), rng.uniform(-0.35, np.pi + 0.35, n)
        r = radius * (1 - 0.35 * along) * (1 + 0.05 * np.cos(2 * angle + 5 * along) + 0.02 * np.cos(17 * angle))
        across = np.array([-step[1], step[0]])
        xy = start + np.outer(along * length, step) + (r * np.cos(angle))[:, None] * across
        ends = scene.terrain.smooth_z(np.stack([start, start + step * length])).astype(np.float64)
        z = ends[0] + (ends[1] - ends[0]) * along + 0.6 * radius + r * np.sin(angle)
        points = np.column_stack([xy, z]).astype(np.float32)
        points = points[points[:, 2] > scene.terrain.z(points) - 0.01]
        up = np.clip((points[:, 2] - scene.terrain.smooth_z(points)) / (2 * radius), 0, 1)
        blotch = WaveField.random(rng, n_dims=3, wavelengths_m=(0.1, 1.0), amplitude=1.0)(points)
        moss = np.clip(1.4 * up - 0.5 + 0.5 * blotch, 0, 1)[:, None]
        colour = (1 - moss) * np.array([118, 92, 70], np.float32) + moss * np.array([106, 132, 58], np.float32)
        parts.append(Painted(points, paint(colour, 0.7 + 0.35 * up + 0.08 * blotch)))
    return parts


def _log_place(scene: Scene, span: Float64) -> Float64:
    """(2,) where a log begins, clear of the stems if any of the places tried is."""
    side = scene.recipe.side_m
    low, high = np.maximum(0.5, 0.5 - span), np.minimum(side - 0.5, side - 0.5 - span)
    starts = scene.rng.uniform(np.minimum(low, high), np.maximum(low, high), (40, 2))
    if not len(scene.circles):
        first: Float64 = starts[0]
        return first
    on_log = starts[:, None] + np.linspace(0, 1, 25)[:, None] * span
    gaps = np.linalg.norm(on_log[:, :, None] - scene.circles[:, :2], axis=3) - scene.circles[:, 2]
    best: Float64 = starts[int(gaps.min(axis=(1, 2)).argmax())]
    return best
