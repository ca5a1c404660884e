"""Which way is up in a cloud whose file does not say: ground lies across it, stems stand along it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, median_filter
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float64, as_points
from dbh_studio.core.transforms import UP_AXES, rotation_to_z_up

_SAMPLE = 60_000
_NEIGHBOURS = 24
_NORMALS = 30_000
# To tell six axes apart takes fewer than the last degree of any direction does.
_PLANAR_FOR_AXES = 700
# Two threads are there on any machine; the result does not depend on them.
_N_WORKERS = min(4, os.cpu_count() or 1)
_SCORED = 5_000
_CELLS = 40
_LEAST_GROUND = 0.15
_FLAT = np.cos(np.radians(20.0))
_SLOPING = np.cos(np.radians(35.0))
_STEEP = np.sin(np.radians(15.0))
# Shares of a cloud without any structure: of directions drawn evenly over the sphere.
_FLAT_BY_CHANCE = 1.0 - _FLAT
_STEEP_BY_CHANCE = _STEEP
_GROUND_WEIGHT = 1.5


@dataclass(frozen=True, eq=False)
class UpDirection:
    """The direction away from the ground.

    Attributes:
        direction: (3,) unit vector in the frame of the points.
        axis: The nearest of `UP_AXES`.
        off_axis_deg: Angle between the two.
        confidence: 0 (a guess) to 1 (no other direction comes near).
        has_ground: Whether a ground surface was seen.
    """

    direction: Float64
    axis: str
    off_axis_deg: float
    confidence: float
    has_ground: bool


def axis_vector(axis: str) -> Float64:
    """(3,) unit vector of one of `UP_AXES`."""
    return rotation_to_z_up(axis).T @ np.array([0.0, 0.0, 1.0])


def nearest_axis(direction: NDArray[Any]) -> str:
    """The one of `UP_AXES` that makes the smallest angle with `direction`."""
    return max(UP_AXES, key=lambda axis: float(axis_vector(axis) @ np.asarray(direction, np.float64)))


def rotation_from_up(direction: NDArray[Any]) -> Float64:
    """(3, 3) proper rotation that turns the up direction into +z.

    It is `rotation_to_z_up` of the nearest axis followed by the smallest turn that levels the rest, so a named axis
    gives exactly the named rotation.

    Args:
        direction: (3,) not zero; its length does not matter.
    """
    up = np.asarray(direction, np.float64)
    length = np.linalg.norm(up)
    if up.shape != (3,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"the up direction is {direction!r} but a (3,) vector is needed")
    named = rotation_to_z_up(nearest_axis(up))
    x, y, z = named @ (up / length)
    # Rodrigues for the turn from (x, y, z) to +z about the horizontal axis; z > 0 because the axis was the nearest.
    k = 1.0 / (1.0 + z)
    level = np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])
    u, _, vt = np.linalg.svd(level @ named)
    rotation: Float64 = u @ vt
    return rotation


def estimate_up(points: NDArray[Any], *, axes_only: bool = False, prior: str | None = None) -> UpDirection:
    """Estimate the up direction from surface normals.

    About the right direction, ground normals point along it and stem normals across it; about a wrong one, stem normals
    spread over all angles. The direction that explains most normals wins; the ground is then put below the stems.

    Args:
        points: (N, 3), any unit.
        axes_only: Consider the six axes only (for formats that are levelled by convention).
        prior: An axis to take unless the points clearly speak against it.
    """
    points = as_points(points, name="points")
    sample = np.asarray(points[:: max(1, len(points) // _SAMPLE)], np.float64)
    default = prior or "+z"
    unsure = UpDirection(axis_vector(default), default, 0.0, 0.0, False)
    if len(sample) < 200:
        return unsure
    normals, where = _normals(sample, _PLANAR_FOR_AXES if axes_only else None)
    if len(normals) < 100:
        return unsure
    lines = np.eye(3) if axes_only else np.concatenate([np.eye(3), _hemisphere(1500)])
    thinned = normals[:: max(1, len(normals) // _SCORED)]
    scores = _scores(thinned, lines)
    best = int(np.argmax(scores))
    up = lines[best]
    if not axes_only:
        up = _refined(normals, up)
    far = np.abs(lines @ up) < np.cos(np.radians(30.0))
    margin = float(_scores(thinned, up[None])[0] - scores[far].max())
    sign, has_ground, sign_margin = _sign(where, normals, sample, up)
    confidence = float(np.clip(margin / 0.25, 0.0, 1.0) * (0.5 + 0.5 * sign_margin))
    up = sign * up
    if prior is not None and nearest_axis(up) != prior and (confidence < 0.6 or _opposite(nearest_axis(up), prior)):
        return UpDirection(axis_vector(prior), prior, 0.0, max(0.0, 0.5 - confidence), has_ground)
    axis = nearest_axis(up)
    angle = float(np.degrees(np.arccos(np.clip(up @ axis_vector(axis), -1.0, 1.0))))
    return UpDirection(up, axis, angle, confidence, has_ground)


def _opposite(a: str, b: str) -> bool:
    return a[1] == b[1] and a != b


def _hemisphere(n: int) -> Float64:
    """(n, 3) unit vectors spread evenly over half a sphere (a Fibonacci lattice)."""
    i = np.arange(n) + 0.5
    z = i / n
    angle = np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _normals(sample: Float64, n_enough: int | None) -> tuple[Float64, Float64]:
    """(M, 3) normals of planar neighbourhoods, one per voxel so that dense places do not outvote, and (M, 3) where.

    With `n_enough`, a third of the places is looked at first, and the others only where fewer than that are planar.
    """
    extent = np.ptp(sample, axis=0)
    step = float(np.sqrt(np.sort(extent)[1:].prod()) / 150.0) or 1.0
    voxels = np.floor((sample - sample.min(axis=0)) / step).astype(np.int64)
    keys = (voxels[:, 0] * 1_000_003 + voxels[:, 1]) * 1_000_003 + voxels[:, 2]
    _, first = np.unique(keys, return_index=True)
    # Thinned over the whole list, which is in order of place.
    places = sample[first[:: max(1, len(first) // _NORMALS)]]
    tree = cKDTree(sample, balanced_tree=False, compact_nodes=False)
    if n_enough is None:
        return _planar_normals(tree, sample, places)
    normals, where = _planar_normals(tree, sample, places[::3])
    if len(normals) >= n_enough:
        return normals, where
    others = np.delete(places, slice(None, None, 3), axis=0)
    more, more_where = _planar_normals(tree, sample, others)
    return np.concatenate([normals, more]), np.concatenate([where, more_where])


def _planar_normals(tree: cKDTree, sample: Float64, places: Float64) -> tuple[Float64, Float64]:
    """(M, 3) normals of those neighbourhoods of (N, 3) places that are planar, and (M, 3) where."""
    # A trunk seen in a sparse sample is thinner than its neighbourhood of k points, so the radius is bounded too.
    _, neighbours = tree.query(places, k=_NEIGHBOURS, workers=_N_WORKERS)
    local = sample[neighbours]
    local = local - local.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(local.transpose(0, 2, 1) @ local)
    planar = (values[:, 0] < 0.08 * values[:, 1]) & (values[:, 1] > 0.05 * values[:, 2])
    return vectors[planar, :, 0], places[planar]


def _scores(normals: Float64, lines: Float64) -> Float64:
    """(L,) how much more of the normals each line explains than chance would."""
    along = np.abs(normals @ lines.T)
    flat = (along > _FLAT).mean(axis=0) - _FLAT_BY_CHANCE
    steep = (along < _STEEP).mean(axis=0) - _STEEP_BY_CHANCE
    scores: Float64 = _GROUND_WEIGHT * flat + steep
    return scores


def _refined(normals: Float64, up: Float64) -> Float64:
    """Improve a direction: stems are what stands across it, and unlike the ground they do not follow a slope."""
    for limit_deg in (25.0, 20.0, 15.0, 10.0, 10.0, 10.0):
        along = np.abs(normals @ up)
        stems = normals[along < np.sin(np.radians(limit_deg))]
        if len(stems) < 100:
            return up
        values, vectors = np.linalg.eigh(stems.T @ stems / len(stems))
        if values[1] < 0.1:  # All walls face one way: nothing says how far up tilts along them.
            return up
        up = vectors[:, 0] * (1.0 if vectors[:, 0] @ up > 0 else -1.0)
    return up


def _sign(where: Float64, normals: Float64, sample: Float64, up: Float64) -> tuple[float, bool, float]:
    """Which end of the line is up (±1), whether there is ground, and how clear that is (0..1)."""
    turn = rotation_from_up(up).T
    level, at = sample @ turn, where @ turn
    # Ground may slope, so wider than what counts as flat in the search.
    lying = np.abs(normals @ up) > _SLOPING
    flip = np.array([1.0, 1.0, -1.0])
    right, wrong = _ground_evidence(level, at, lying), _ground_evidence(level * flip, at * flip, lying)
    if max(right, wrong) > _LEAST_GROUND:
        clear = min(1.0, abs(right - wrong) / max(right, wrong))
        return (1.0 if right >= wrong else -1.0), True, clear
    # Without ground: a crown is wider than the stem below it.
    z = level[:, 2]
    bottom, top = np.quantile(z, [0.005, 0.995])
    third = (top - bottom) / 3.0
    areas = [_area(level[(z >= bottom) & (z < bottom + third)]), _area(level[(z <= top) & (z > top - third)])]
    clear = abs(areas[1] - areas[0]) / max(sum(areas), 1)
    return (1.0 if areas[1] >= areas[0] else -1.0), False, float(clear)


def _area(level: Float64) -> int:
    """How many of the finest useful cells hold points."""
    if len(level) < 2:
        return 0
    cells = np.floor(level[:, :2] / max(np.ptp(level[:, 2]) / 20.0, 1e-12)).astype(np.int64)
    return len(np.unique(cells, axis=0))


def _ground_evidence(level: Float64, at: Float64, lying: Bool) -> float:
    """How well the lowest points make a ground: the share of surfaces that lie on it, less the share below it.

    The lowest point of each cell, smoothed over its neighbours, follows the ground on a slope and under crowns. Seen
    from the wrong side it follows the canopy, where little lies flat, or in the open the ground, with stems below it.
    """
    lower = level[:, :2].min(axis=0)
    size = float((level[:, :2].max(axis=0) - lower).max()) / _CELLS or 1.0
    cells = np.minimum(((level[:, :2] - lower) / size).astype(np.int64), _CELLS - 1)
    lowest = np.full((_CELLS, _CELLS), np.inf)
    np.minimum.at(lowest, (cells[:, 0], cells[:, 1]), level[:, 2])
    empty = ~np.isfinite(lowest)
    if empty.any():
        lowest = lowest[tuple(distance_transform_edt(empty, return_distances=False, return_indices=True))]
    surface = median_filter(lowest, size=5)
    cells = np.clip(((at[:, :2] - lower) / size).astype(np.int64), 0, _CELLS - 1)
    above = at[:, 2] - surface[cells[:, 0], cells[:, 1]]
    thin = max(0.03 * float(np.subtract(*np.quantile(level[:, 2], [0.995, 0.005]))), 0.5 * size)
    return float((lying & (np.abs(above) < thin)).mean() - (above < -thin).mean())
