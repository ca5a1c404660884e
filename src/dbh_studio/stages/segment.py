"""From a cloud to trunks: candidates, then the paper's chain (section "Automated Tree Trunk Segmentation").

    candidates   image masks where there are any, otherwise surfaces of stems found by `stem_detection`
    ground       what is lower than the clearance is not trunk
    normals      what does not face sideways is not trunk
    clusters     DBSCAN
    sizes        Otsu's threshold on the clusters' size; by default it cannot drop what is a stem by its rings
    expansion    points near a cluster join it

Everything is computed on points thinned to one per small cube and carried back to all points at the end, so that time
and memory follow the surface of the stems and not the number of points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32, Int64, UInt8, as_points, readonly
from dbh_studio.core.chain_steps import ChainSteps, NearMiss, Step
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.neighbours import N_WORKERS, point_spacing
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.voxels import MAX_CUBES, thin
from dbh_studio.errors import SettingError
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.stem_detection import LAYER_M, Stem, search_stems
from dbh_studio.stages.trunk_chain import Chain, Outcome

_CHUNK = 1 << 20
# More thinned points than this in the search slab are thinned further, so that large plots stay within memory and time.
_MAX_SLAB_POINTS = 600_000
_PIXEL_M = 0.10
# The plot is where 98 % of the points are, and as far around as this many times its size. What is beyond is stray, and
# one stray point would stretch every grid over kilometres.
_STRAY_TAIL, _STRAY_SIZES = 0.01, 5.0
_STRAY_SAMPLE = 200_000

NO_TRUNK_NOTE = (
    "No trunk was found. Check the scale and the up axis, the search heights, and that the cloud shows stems "
    "between them; single trunks can also be selected by hand."
)


@dataclass(frozen=True, eq=False)
class SegmentationResult:
    """The trunks of a plot.

    Attributes:
        point_sets: Per trunk the sorted indices into the cloud; disjoint, in order of x, then y.
        stems: What the detector saw of each, in the same order; None for a trunk that came from masks alone.
        notes: What the person should know, in plain words.
        steps: What became of every point and every cluster.
    """

    point_sets: tuple[Int32, ...]
    stems: tuple[Stem | None, ...]
    notes: tuple[str, ...]
    steps: ChainSteps


def segment_trunks(
    points_world: Float,
    ground: GroundModel,
    *,
    settings: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
    candidates: Bool | None = None,
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> SegmentationResult:
    """Find the trunks of a plot.

    Args:
        points_world: (N, 3) points, metres, +z up; float32 saves memory.
        ground: From `core.ground.fit_ground`.
        settings: Every parameter of the detector and the chain.
        candidates: (N,) points that image masks call trunk ("label count of at least one" in the paper); None where
            there are no masks, and the detector stands in for them.
        progress: Called between steps and chunks.
        seed: Of the random samples: the same seed gives the same trunks.

    Returns:
        The trunks; none, with a note, where nothing looks like one.

    Raises:
        ValueError: Wrong shapes.
        SettingError: The plot would be tens of kilometres wide: the scale is wrong.
        CancelledError: From `progress`.
    """
    points = as_points(points_world, name="points_world")
    if candidates is not None and np.shape(candidates) != (len(points),):
        raise ValueError(f"candidates have shape {np.shape(candidates)} but ({len(points)},) is needed")
    top_m = max(settings.slab_high_m, settings.trunk_top_m)
    height = _heights(points, ground, top_m, subprogress(progress, 0.0, 0.15))
    wanted = None if candidates is None else np.asarray(candidates, bool)
    slab, spacing = _slab(points, height, wanted, settings)
    stems: tuple[Stem, ...] = ()
    misses: tuple[NearMiss, ...] = ()
    if wanted is None or settings.part_touching:
        stems, misses = search_stems(
            slab, spacing_m=spacing, settings=settings, progress=subprogress(progress, 0.2, 0.5), seed=seed
        )
    # West to east, so that the numbering does not depend on which stem was surest.
    stems = tuple(sorted(stems, key=lambda stem: tuple(stem.xy_at(1.3))))
    step = _steps_by_height(height, wanted, settings)
    rest = subprogress(progress, 0.5, 1.0)
    if wanted is not None:
        rows = np.flatnonzero(wanted)
        rows = rows[(height[rows] >= settings.ground_clearance_m) & (height[rows] < settings.trunk_top_m)]
    elif stems:
        rows = rows_in_column(points, height, *_footprint(stems, settings), settings)
    else:
        rows = np.empty(0, np.int64)
    rest(0.1, "Following the stems")
    chain = Chain(levelled(points, height, rows), stems, spacing, settings, subprogress(rest, 0.1, 0.8), seed)
    outcome = chain.of_stems() if wanted is None else chain.of_masks()
    step[rows] = outcome.steps
    all_rows, labels, joined_from = rows, outcome.labels, outcome.joined_from
    if wanted is not None and len(outcome.stems):
        all_rows, labels = _expanded_beyond_masks(points, height, rows, labels, chain, settings)
        step[all_rows[len(rows) :]] = Step.JOINED
        joined_from[Step.NO_CANDIDATE] += len(all_rows) - len(rows)
    rest(0.95, "Following the stems")
    steps = ChainSteps(
        labels=readonly(step),
        dropped_cluster=readonly(outcome.details[outcome.steps == Step.DROPPED]),
        tilt_deg=readonly(outcome.details[outcome.steps == Step.NOT_SIDEWAYS].astype(np.uint8)),
        joined_from=tuple(int(n) for n in joined_from),
        clusters=tuple(replace(cluster, point=int(rows[cluster.point])) for cluster in outcome.clusters),
        size_threshold=outcome.size_threshold,
        settings=settings,
        from_masks=wanted is not None,
        n_stems_detected=len(stems),
        spacing_m=spacing,
        near_misses=misses if wanted is None else (),
    )
    return _result(all_rows, labels, outcome, steps)


def _steps_by_height(height: Float32, wanted: Bool | None, settings: TrunkSettings) -> UInt8:
    """(N,) which points their height drops: all, or those in a mask. The others are no candidates until they are."""
    step = np.full(len(height), Step.NO_CANDIDATE, np.uint8)
    for start in range(0, len(height), _CHUNK):
        part, own = height[start : start + _CHUNK], step[start : start + _CHUNK]
        low, high = part < settings.ground_clearance_m, ~(part < settings.trunk_top_m)
        if wanted is not None:
            low &= wanted[start : start + _CHUNK]
            high &= wanted[start : start + _CHUNK]
        own[low], own[high] = Step.TOO_LOW, Step.TOO_HIGH
    return step


def levelled(points: Float, height: Float, rows: Int64) -> Float32:
    """(M, 3) float32 x, y and height above ground of the points at `rows`: the slope is taken out, verticals stay."""
    part = np.empty((len(rows), 3), np.float32)
    part[:, :2] = points[rows, :2]
    part[:, 2] = height[rows]
    return part


def _heights(points: Float, ground: GroundModel, top_m: float, progress: Progress) -> Float32:
    """(N,) height above ground; NaN, which is at no height, for stray points far outside the plot.

    Crowns are most of many clouds, and no step looks at them: what is higher than `top_m` above any ground is NaN too.
    """
    lower, upper = _plot_box(points)
    highest_z = ground.highest_z(lower, upper) + top_m
    height = np.full(len(points), np.nan, np.float32)
    for start in range(0, len(points), _CHUNK):
        progress(start / len(points), "Heights above ground")
        part = points[start : start + _CHUNK]
        wanted = part[:, 2] <= highest_z
        for axis in range(2):
            wanted &= (part[:, axis] >= lower[axis]) & (part[:, axis] <= upper[axis])
        rows = np.flatnonzero(wanted)
        height[start + rows] = ground.height_above(part[rows])
    return height


def _plot_box(points: Float) -> tuple[Float64, Float64]:
    """(2,) lower and (2,) upper corner, in plan, of what belongs to the plot."""
    sample = points[:: max(1, len(points) // _STRAY_SAMPLE), :2].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not len(sample):
        return np.zeros(2), np.zeros(2)
    lower, upper = np.quantile(sample, [_STRAY_TAIL, 1.0 - _STRAY_TAIL], axis=0)
    # The larger side counts for both: a narrow strip is not searched for strays across.
    margin = _STRAY_SIZES * float((upper - lower).max()) + 1.0
    return lower - margin, upper + margin


def _slab(points: Float, height: Float32, wanted: Bool | None, settings: TrunkSettings) -> tuple[Float32, float]:
    """Thinned points of the search slab, and how far apart they are on a surface."""
    inside = (height >= settings.slab_low_m) & (height < settings.slab_high_m)
    rows = np.flatnonzero(inside if wanted is None else inside & wanted)
    edge = settings.thinning_m
    part = levelled(points, height, rows)
    width = float(np.ptp(part[:, :2], axis=0).max()) if len(part) else 0.0
    if not width < MAX_CUBES * edge:
        raise SettingError(
            f"The plot would be {width / 1000.0:,.0f} km wide.", "Check the scale, and crop the cloud to the plot."
        )
    slab = thin(part, edge).points
    while len(slab) > _MAX_SLAB_POINTS:
        edge *= 1.3
        slab = thin(slab, edge).points
    spacing = point_spacing(slab)
    return slab, edge if np.isnan(spacing) else max(spacing, edge)


def _footprint(stems: tuple[Stem, ...], settings: TrunkSettings) -> tuple[Float64, Float64]:
    """(K, 2) positions along the stems' axes and (K,) how far from them a stem's surface may lie there."""
    layers = np.arange(settings.ground_clearance_m, settings.trunk_top_m, LAYER_M)
    xy = [stem.xy_at(height) for stem in stems for height in layers]
    # Beyond the heights where rings were seen a stem may bend away from its axis.
    beyond = [max(stem.heights_m[0] - h, h - stem.heights_m[-1], 0.0) for stem in stems for h in layers]
    radius = np.repeat([stem.radius_m for stem in stems], len(layers))
    return np.asarray(xy), 1.6 * radius + 0.12 + 0.06 * np.asarray(beyond)


def rows_in_column(points: Float, height: Float32, xy: Float64, reach: Float64, settings: TrunkSettings) -> Int64:
    """Rows of the points between ground clearance and trunk top that are, in plan, near any of the positions.

    On a raster, so that the time does not depend on the number of positions and little on that of the points.

    Args:
        points: (N, 3) world.
        height: (N,) above ground.
        xy: (K, 2) positions.
        reach: (K,) metres.
        settings: Heights.
    """
    lower = xy.min(axis=0) - reach.max() - _PIXEL_M
    shape = np.ceil((xy.max(axis=0) + reach.max() + _PIXEL_M - lower) / _PIXEL_M).astype(int) + 1
    raster = np.zeros(shape, bool)
    for size in np.unique(np.ceil(reach / _PIXEL_M).astype(int)):
        chosen = np.ceil(reach / _PIXEL_M).astype(int) == size
        steps = np.arange(-size, size + 1)
        disc = np.argwhere(np.hypot(steps[:, None], steps[None, :]) <= size + 0.5) - size
        pixel = ((xy[chosen] - lower) / _PIXEL_M).astype(int)
        at = np.clip((pixel[:, None, :] + disc[None]).reshape(-1, 2), 0, shape - 1)
        raster[at[:, 0], at[:, 1]] = True
    found = []
    for start in range(0, len(points), _CHUNK):
        part = height[start : start + _CHUNK]
        rows = np.flatnonzero((part >= settings.ground_clearance_m) & (part < settings.trunk_top_m)) + start
        i, j = (np.floor((points[rows, axis] - lower[axis]) / _PIXEL_M).astype(np.int32) for axis in (0, 1))
        inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
        found.append(rows[inside][raster[i[inside], j[inside]]])
    return np.concatenate(found)


def _expanded_beyond_masks(
    points: Float, height: Float32, rows: Int64, labels: Int32, chain: Chain, settings: TrunkSettings
) -> tuple[Int64, Int32]:
    """Points outside the masks that are near a trunk found inside them join it."""
    kept, kept_labels = chain.kept_points()
    reach = np.full(len(kept), settings.expand_distance_m)
    around = rows_in_column(points, height, kept[:, :2].astype(np.float64), reach, settings)
    # What the chain has judged stays as it was judged.
    around = np.setdiff1d(around, rows, assume_unique=True)
    distance, nearest = cKDTree(kept).query(
        levelled(points, height, around), distance_upper_bound=max(settings.expand_distance_m, 1e-9), workers=N_WORKERS
    )
    near = np.isfinite(distance)
    return np.concatenate([rows, around[near]]), np.concatenate([labels, kept_labels[nearest[near]]])


def _result(rows: Int64, labels: Int32, outcome: Outcome, steps: ChainSteps) -> SegmentationResult:
    """Sorted point sets in order of position, without empty ones."""
    inside = labels >= 0
    rows, labels = rows[inside], labels[inside]
    order = np.lexsort((rows, labels))
    edges = np.searchsorted(labels[order], np.arange(len(outcome.stems) + 1))
    sets = [rows[order[a:b]].astype(np.int32) for a, b in pairwise(edges)]
    present = [k for k, points in enumerate(sets) if len(points)]
    notes = () if present else (NO_TRUNK_NOTE,)
    return SegmentationResult(
        tuple(readonly(sets[k]) for k in present), tuple(outcome.stems[k] for k in present), notes, steps
    )
