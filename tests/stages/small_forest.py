"""A small forest with every point's tree known: slope, lean, taper, shrubs, crowns, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Tree:
    """A stem as a leaning, tapering cylinder with an elliptical section."""

    x: float
    y: float
    dbh_m: float
    lean_deg: float = 0.0
    lean_to_deg: float = 0.0
    flattening: float = 0.0
    seen_deg: float = 360.0


def ground_z(x: np.ndarray, y: np.ndarray, slope_deg: float) -> np.ndarray:
    return np.tan(np.radians(slope_deg)) * x + 0.15 * np.sin(0.7 * x) * np.cos(0.5 * y)


def stem_points(tree: Tree, slope_deg: float, spacing: float, noise: float, rng: np.random.Generator) -> np.ndarray:
    height = 9.0
    n = int(height * np.pi * tree.dbh_m / spacing**2 * tree.seen_deg / 360.0)
    h = rng.uniform(0.0, height, n)
    angle = np.radians(rng.uniform(0.0, tree.seen_deg, n))
    radius = 0.5 * tree.dbh_m * (1.0 - 0.05 * (h - 1.3)) + rng.normal(0.0, noise, n)
    a, b = radius * (1.0 + tree.flattening), radius * (1.0 - tree.flattening)
    lean = np.tan(np.radians(tree.lean_deg)) * h
    x = tree.x + a * np.cos(angle) + lean * np.cos(np.radians(tree.lean_to_deg))
    y = tree.y + b * np.sin(angle) + lean * np.sin(np.radians(tree.lean_to_deg))
    return np.column_stack([x, y, float(ground_z(np.array(tree.x), np.array(tree.y), slope_deg)) + h])


def ball(x: float, y: float, z: float, radius: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """Foliage: points in a ball, denser towards its middle, flattened."""
    offset = rng.normal(0.0, 0.45 * radius, (n, 3)) * [1.0, 1.0, 0.7]
    return np.array([x, y, z]) + offset


def forest(
    trees: list[Tree],
    *,
    size: float = 12.0,
    slope_deg: float = 0.0,
    spacing: float = 0.02,
    noise: float = 0.01,
    n_shrubs: int = 0,
    crowns: bool = True,
    outliers: float = 0.0,
    ground: bool = True,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) float32 points and (N,) labels: 1… the trees, 0 anything else."""
    rng = np.random.default_rng(seed)
    parts, labels = [], []
    if ground:
        n = int(size * size / spacing**2 / 4)
        xy = rng.uniform(-size / 2, size / 2, (n, 2))
        z = ground_z(xy[:, 0], xy[:, 1], slope_deg) + rng.normal(0.0, noise, n)
        parts.append(np.column_stack([xy, z]))
        labels.append(np.zeros(n, int))
    for i, tree in enumerate(trees):
        stem = stem_points(tree, slope_deg, spacing, noise, rng)
        parts.append(stem)
        labels.append(np.full(len(stem), i + 1))
        if crowns:
            crown = ball(tree.x, tree.y, stem[:, 2].max() + 1.0, 2.5, 4000, rng)
            parts.append(crown)
            labels.append(np.zeros(len(crown), int))
    for _ in range(n_shrubs):
        x, y = rng.uniform(-0.45 * size, 0.45 * size, 2)
        if all(np.hypot(x - t.x, y - t.y) > 0.9 for t in trees):
            base = float(ground_z(np.array(x), np.array(y), slope_deg))
            shrub = ball(x, y, base + 0.8, rng.uniform(0.5, 1.1), 2500, rng)
            parts.append(shrub)
            labels.append(np.zeros(len(shrub), int))
    points = np.concatenate(parts)
    label = np.concatenate(labels)
    if outliers:
        n = int(outliers * len(points))
        low, high = points.min(axis=0) - [0, 0, 3.0], points.max(axis=0)
        points = np.concatenate([points, rng.uniform(low, high, (n, 3))])
        label = np.concatenate([label, np.zeros(n, int)])
    order = rng.permutation(len(points))
    return points[order].astype(np.float32), label[order]


STAND = [
    Tree(-4.0, -4.0, 0.30, 5.0, 30.0),
    Tree(-3.5, 3.0, 0.12, 12.0, 200.0),
    Tree(0.0, -1.0, 0.45, 3.0, 90.0, flattening=0.06),
    Tree(0.6, 4.2, 0.08, 0.0),
    Tree(3.2, -3.6, 0.22, 15.0, 300.0),
    Tree(4.3, 2.0, 0.60, 1.0, seen_deg=200.0),
    Tree(-1.5, 1.2, 0.18, 7.0, 120.0, seen_deg=160.0),
]
