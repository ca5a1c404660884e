"""Help with correcting trunks: a trunk that is several stems is parted, a stem is followed from one click.

Both use what finds stems in a whole cloud (`stem_detection`, `stem_tracking`), on the points of one place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Int32, Int64, as_points
from dbh_studio.core.clusters import dbscan
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.neighbours import N_WORKERS, point_spacing
from dbh_studio.core.voxels import thin
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.stem_detection import detect_stems
from dbh_studio.stages.stem_tracking import StemModels, follow_stems

_DEFAULTS = TrunkSettings()
# How far from a click the foot and the top of a leaning stem may be, beside half of the thickest trunk.
_LEAN_M = 1.0
# A click on a stem is so near to its surface.
_HIT_M = 0.15
# Parts smaller than this share of a trunk are branches and shrubs, not stems.
_LEAST_SHARE = 0.12


@dataclass(frozen=True, eq=False)
class GrownStem:
    """A stem followed from a click.

    Attributes:
        rows: (K,) sorted rows of its points.
        note: How it was found, where that must be looked at; empty where its rings were seen.
    """

    rows: Int64
    note: str = ""


def part_stems(
    points_world: Float, ground: GroundModel, *, settings: TrunkSettings = _DEFAULTS, seed: int = 0
) -> Int32 | Refusal:
    """Part the points of one trunk into its stems: twins from the ground, a fork below breast height, two neighbours.

    By the rings of the stems where two are seen, else by what hangs together.

    Args:
        points_world: (N, 3) points of the trunk, metres, +z up.
        ground: Under the plot.
        settings: As for finding trunks.
        seed: Of the random samples.

    Returns:
        (N,) which stem each point belongs to, from 0, the largest first; or why there is only one.
    """
    points = as_points(points_world, name="points_world")
    levelled = _levelled(points, ground)
    labels = _by_rings(levelled, settings, seed)
    if labels is None:
        labels = _by_gaps(levelled, settings)
    if labels is None:
        return Refusal(
            "one_stem",
            "Only one stem is seen in this trunk.",
            "Draw a line between the two stems, or select the points of one of them.",
        )
    order = np.argsort(-np.bincount(labels), kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return np.asarray(rank[labels], np.int32)


def grow_stem(
    points_world: Float,
    seed_xyz: Any,
    ground: GroundModel,
    *,
    is_free: Bool | None = None,
    settings: TrunkSettings = _DEFAULTS,
    seed: int = 0,
) -> GrownStem | Refusal:
    """Follow the stem that a click hit, from the ground up to the trunk top.

    Where rings show a stem there, its surface is taken; else what hangs together within the thickest trunk's width.

    Args:
        points_world: (N, 3) all points, metres, +z up.
        seed_xyz: (3,) where the click hit, world.
        ground: Under the plot.
        is_free: (N,) which points may be taken; None takes all.
        settings: As for finding trunks.
        seed: Of the random samples.
    """
    points = as_points(points_world, name="points_world")
    place = np.asarray(seed_xyz, np.float64).reshape(3)
    reach = 0.5e-2 * settings.max_diameter_cm + _LEAN_M
    rows = _column(points, place, reach, is_free)
    if not len(rows):
        return Refusal("nothing_there", "There are no free points there.", "Click on the stem itself.")
    levelled = _levelled(points[rows], ground)
    between = (levelled[:, 2] >= settings.ground_clearance_m) & (levelled[:, 2] < settings.trunk_top_m)
    rows, levelled = rows[between], levelled[between]
    at = np.array([*place[:2], float(ground.height_above(place[None].astype(np.float32))[0])])
    own = _stem_at(levelled, at, settings, seed)
    if own is not None and own.any():
        return GrownStem(rows[own])
    own = _connected_to(levelled, at, settings)
    if own is None:
        return Refusal(
            "no_stem",
            "Nothing that could be a stem hangs together there.",
            "Click nearer to breast height, or select the stem's points with the lasso.",
        )
    return GrownStem(rows[own], "no ring was seen there, so what hangs together was taken: look whether it is a stem")


# ---- by rings


def _by_rings(levelled: Float32, settings: TrunkSettings, seed: int) -> Int32 | None:
    models = _surfaces(levelled, settings, seed)
    if models is None or len(models.band_m) < 2:
        return None
    labels = models.owner(levelled)[0]
    known = labels >= 0
    if len(np.unique(labels[known])) < 2:
        return None
    # Branches, bark that stands off and the foot between two stems go with the nearest surface.
    tree = cKDTree(levelled[known], balanced_tree=False, compact_nodes=False)
    labels[~known] = labels[known][tree.query(levelled[~known], workers=N_WORKERS)[1]]
    return _large_parts(labels, levelled)


def _surfaces(levelled: Float32, settings: TrunkSettings, seed: int) -> StemModels | None:
    """The surfaces of the stems whose rings stack up; None where there is none."""
    thinned = thin(levelled, settings.thinning_m).points
    inside = (thinned[:, 2] >= settings.slab_low_m) & (thinned[:, 2] < settings.slab_high_m)
    slab = thinned[inside]
    spacing = point_spacing(slab)
    spacing = settings.thinning_m if np.isnan(spacing) else max(spacing, settings.thinning_m)
    stems = detect_stems(slab, spacing_m=spacing, settings=settings, seed=seed)
    if not stems:
        return None
    return follow_stems(thinned, stems, spacing_m=spacing, settings=settings, seed=seed)


def _stem_at(levelled: Float32, at: NDArray[Any], settings: TrunkSettings, seed: int) -> Bool | None:
    """(N,) the points of the stem whose surface is at a place; None where there is none."""
    models = _surfaces(levelled, settings, seed) if len(levelled) else None
    if models is None:
        return None
    layer = int(models.layer_of(at[2:3])[0])
    if not settings.ground_clearance_m - _LEAN_M <= at[2] <= settings.trunk_top_m + _LEAN_M:
        return None
    off = np.hypot(*(models.xy_m[:, layer] - at[:2]).T) - models.radius_m[:, layer]
    nearest = int(np.argmin(np.abs(off)))
    if abs(off[nearest]) > _HIT_M + models.band_m[nearest]:
        return None
    owner, distance = models.owner(levelled)
    return np.asarray((owner == nearest) & (distance <= 1.0))


# ---- by what hangs together


def _by_gaps(levelled: Float32, settings: TrunkSettings) -> Int32 | None:
    """Parts that do not touch between the search heights, and every other point with the nearest of them."""
    inside = (levelled[:, 2] >= settings.slab_low_m) & (levelled[:, 2] < settings.slab_high_m)
    slab = thin(levelled[inside], settings.thinning_m)
    spacing = point_spacing(slab.points)
    if np.isnan(spacing):
        return None
    cluster = dbscan(slab.points, distance=max(2.5 * spacing, 2.0 * settings.thinning_m), min_points=3)
    size = np.bincount(cluster[cluster >= 0], slab.counts[cluster >= 0])
    large = np.flatnonzero(size >= _LEAST_SHARE * size.sum()) if len(size) else np.empty(0, int)
    tall = [k for k in large if np.ptp(slab.points[cluster == k, 2]) >= 0.5 * settings.stem_length_m]
    if len(tall) < 2:
        return None
    chosen = np.isin(cluster, tall)
    tree = cKDTree(slab.points[chosen], balanced_tree=False, compact_nodes=False)
    nearest = tree.query(levelled, workers=N_WORKERS)[1]
    return np.asarray(np.unique(cluster[chosen], return_inverse=True)[1][nearest], np.int32)


def _connected_to(levelled: Float32, at: NDArray[Any], settings: TrunkSettings) -> Bool | None:
    """(N,) what hangs together with the point nearest to a place; None where that is nothing, or wider than a trunk."""
    if len(levelled) < 3:
        return None
    thinned = thin(levelled, settings.thinning_m)
    spacing = point_spacing(thinned.points)
    if np.isnan(spacing):
        return None
    gap, nearest = cKDTree(thinned.points).query(at)
    cluster = dbscan(thinned.points, distance=max(2.5 * spacing, 2.0 * settings.thinning_m), min_points=3)
    if gap > _HIT_M + 2.0 * spacing or cluster[nearest] < 0:
        return None
    own = cluster == cluster[nearest]
    low, high = np.quantile(thinned.points[own, :2], [0.05, 0.95], axis=0)
    if float((high - low).max()) > 1e-2 * settings.max_diameter_cm:
        return None
    return thinned.labels_of_points(own)


# ---- parts


def _levelled(points: Float, ground: GroundModel) -> Float32:
    """(N, 3) float32 x, y and height above the ground below each point."""
    levelled = np.empty((len(points), 3), np.float32)
    levelled[:, :2] = points[:, :2]
    levelled[:, 2] = ground.height_above(points)
    return levelled


def _column(points: Float, place: NDArray[Any], reach: float, is_free: Bool | None) -> Int64:
    """Rows of the free points that are, in plan, within `reach` of a place."""
    rows = np.flatnonzero(np.abs(points[:, 0] - np.float32(place[0])) <= reach)
    rows = rows[np.abs(points[rows, 1] - np.float32(place[1])) <= reach]
    off = points[rows, :2] - place[:2]
    rows = rows[off[:, 0] ** 2 + off[:, 1] ** 2 <= reach * reach]
    return rows if is_free is None else rows[is_free[rows]]


def _large_parts(labels: Int32, points: Float32) -> Int32 | None:
    """The labels from 0 without gaps, small parts given to the nearest large one; None where fewer are than two."""
    size = np.bincount(labels)
    large = np.flatnonzero(size >= _LEAST_SHARE * len(labels))
    if len(large) < 2:
        return None
    keeps = np.isin(labels, large)
    if not keeps.all():
        tree = cKDTree(points[keeps], balanced_tree=False, compact_nodes=False)
        labels[~keeps] = labels[keeps][tree.query(points[~keeps], workers=N_WORKERS)[1]]
    return np.asarray(np.unique(labels, return_inverse=True)[1], np.int32)
