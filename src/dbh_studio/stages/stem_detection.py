"""Where stems stand, from geometry alone: rings in thin layers that stack up along a line.

It takes the place of the image masks in the paper where there are none. What it asks of a stem is what masks cannot
give: a hollow, round, continuous surface over at least `stem_length_m` of height. Foliage gives no rings that stack up,
ground and walls no small rings, and two stems that touch give two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Float, Float64, Int32, Int64
from dbh_studio.core.chain_steps import NearMiss
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.rings import Rings, find_rings
from dbh_studio.settings import TrunkSettings

LAYER_M = 0.20
# Larger pieces than this may hold stems amid branches, and are also searched in windows of this size.
_WINDOW_M = 0.7
_MIN_POINTS = 8
# Layers with a clean ring, summed as shares. Measured: shrubs up to 1.2, real stems in noisy, sparse clouds from 3.1.
_MIN_CLEAN_LAYERS = 2.0
# Between the surfaces of a near miss and of a stem.
_APART_M = 0.15


@dataclass(frozen=True, eq=False)
class Stem:
    """A stack of rings that looks like a stem.

    Attributes:
        axis: (2, 2) x, y at height 0 and their change per metre of height.
        heights_m: (L,) heights of the layers in which a ring was seen, ascending.
        xy_m: (L, 2) centres of those rings.
        radii_m: (L,)
        coverage_deg: Mean arc seen per ring.
        score: Layers with a clean ring times the arc seen: larger is surer.
    """

    axis: Float64
    heights_m: Float64
    xy_m: Float64
    radii_m: Float64
    coverage_deg: float
    score: float

    @property
    def radius_m(self) -> float:
        """Median radius."""
        return float(np.median(self.radii_m))

    def xy_at(self, height_m: float) -> Float64:
        """(2,) position of the axis at a height."""
        return self.axis[0] + height_m * self.axis[1]


# A stem, and the settings that speak against it.
_Stack = tuple[Stem, tuple[str, ...]]


def detect_stems(
    levelled: Float,
    *,
    spacing_m: float,
    settings: TrunkSettings,
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> tuple[Stem, ...]:
    """The stems of `search_stems`."""
    return search_stems(levelled, spacing_m=spacing_m, settings=settings, progress=progress, seed=seed)[0]


def search_stems(
    levelled: Float,
    *,
    spacing_m: float,
    settings: TrunkSettings,
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> tuple[tuple[Stem, ...], tuple[NearMiss, ...]]:
    """Find the stems in a slab, and what is none only because a setting asks for more.

    Args:
        levelled: (N, 3) thinned points of the slab: x, y, height above ground, metres.
        spacing_m: Their typical distance on a surface.
        settings: Diameters and slab.
        progress: Called between steps.
        seed: Of the random samples.

    Returns:
        Stems, surest first, none where nothing looks like one; and near misses from west to east.
    """
    if len(levelled) < _MIN_POINTS:
        return (), ()
    progress(0.0, "Looking for stems")
    rows, group, layer_of_group = _pieces(levelled, spacing_m, settings)
    if not len(rows):
        return (), ()
    progress(0.3, "Looking for stems")
    rings = find_rings(
        levelled[rows, :2],
        group,
        radius_min=0.5e-2 * settings.min_diameter_cm,
        radius_max=0.5e-2 * settings.max_diameter_cm,
        tolerance=max(0.02, 0.6 * spacing_m),
        seed=seed,
    )
    layer = layer_of_group[rings.group]
    good = _looks_round(rings)
    rings, layer = rings.subset(good), layer[good]
    stacks = _stack(rings, layer, settings, subprogress(progress, 0.7, 1.0))
    stems = _without_doubles([stem for stem, doubts in stacks if not doubts])
    return stems, _near_misses([stack for stack in stacks if stack[1]], stems)


def _pieces(levelled: Float, spacing_m: float, settings: TrunkSettings) -> tuple[Int64, Int32, Int32]:
    """Connected pieces of every layer, and windows of the large ones.

    Returns:
        (M,) rows of `levelled` (some more than once), (M,) the piece each belongs to, (G,) the layer of each piece.
    """
    layer = np.floor(levelled[:, 2] / LAYER_M).astype(np.int32)
    reach = max(0.05, 2.5 * spacing_m)
    piece = _connected_in_layers(levelled, layer, reach)
    n_pieces = int(piece.max()) + 1
    size = np.bincount(piece, minlength=n_pieces)
    lower, upper = np.full((n_pieces, 2), np.inf), np.full((n_pieces, 2), -np.inf)
    np.minimum.at(lower, piece, levelled[:, :2])
    np.maximum.at(upper, piece, levelled[:, :2])
    extent = (upper - lower).max(axis=1)
    thick_enough = (size >= _MIN_POINTS) & (extent >= 0.5e-2 * settings.min_diameter_cm)
    rows = [np.flatnonzero((thick_enough & (extent <= 1.2e-2 * settings.max_diameter_cm))[piece])]
    groups = [piece[rows[0]].astype(np.int64)]
    large = np.flatnonzero((thick_enough & (extent > _WINDOW_M))[piece])
    offset = n_pieces
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        window = np.floor(levelled[large, :2] / _WINDOW_M + shift).astype(np.int64)
        window -= window.min(axis=0, initial=0)
        key = (piece[large] * (window[:, 0].max(initial=0) + 1) + window[:, 0]) * (window[:, 1].max(initial=0) + 1)
        names, inverse, count = np.unique(key + window[:, 1], return_inverse=True, return_counts=True)
        kept = count[inverse] >= _MIN_POINTS
        rows.append(large[kept])
        groups.append(offset + inverse[kept])
        offset += len(names)
    all_rows, all_groups = np.concatenate(rows), np.concatenate(groups)
    names, inverse = np.unique(all_groups, return_inverse=True)
    layer_of_group = np.zeros(len(names), np.int32)
    layer_of_group[inverse] = layer[all_rows]
    return all_rows, inverse.astype(np.int32), layer_of_group


def _connected_in_layers(levelled: Float, layer: Int32, reach: float) -> Int32:
    """(N,) piece of every point: points within `reach` in plan and in the same layer are connected."""
    # In plan, on a raster: pixels of half the reach that touch are connected. Bounded by the raster, not by the points.
    pixel = np.floor(levelled[:, :2] / (0.5 * reach)).astype(np.int64)
    pixel -= pixel.min(axis=0) - 1
    width = pixel.max(axis=0) + 2
    key = (layer.astype(np.int64) * width[0] + pixel[:, 0]) * width[1] + pixel[:, 1]
    cells, inverse = np.unique(key, return_inverse=True)
    first, second = [], []
    for step in (1, width[1] - 1, width[1], width[1] + 1):
        at = np.searchsorted(cells, cells + step)
        hit = np.flatnonzero(cells[np.minimum(at, len(cells) - 1)] == cells + step)
        first.append(hit)
        second.append(at[hit])
    i, j = np.concatenate(first), np.concatenate(second)
    graph = coo_matrix((np.ones(len(i), bool), (i, j)), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(graph, directed=False)[1][inverse], np.int32)


def _looks_round(rings: Rings) -> np.ndarray:
    """Which rings may be a slice of stem: enough of the circle seen, hollow, and not a chance circle in a thicket."""
    return (
        (rings.coverage_deg >= 75.0)
        & (rings.n_on >= _MIN_POINTS)
        & (rings.inside_share <= 0.35)
        & (rings.clutter_share <= 1.0)
    )


def _stack(rings: Rings, layer: Int32, settings: TrunkSettings, progress: Progress) -> list[_Stack]:
    """Lines along which rings of similar radius stack up."""
    if len(rings) < 3:
        return []
    height = (layer.astype(np.float64) + 0.5) * LAYER_M
    # Rings that may follow each other in one stem, up to four layers apart.
    pairs = cKDTree(np.column_stack([rings.xy, 0.5 * height])).query_pairs(0.6, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    rise = np.abs(height[i] - height[j])
    mean_radius = 0.5 * (rings.radius[i] + rings.radius[j])
    near = np.hypot(*(rings.xy[i] - rings.xy[j]).T) <= 0.03 + 0.3 * mean_radius + np.minimum(rise, 0.5) * 0.5
    alike = np.abs(rings.radius[i] - rings.radius[j]) <= 0.02 + 0.4 * mean_radius
    linked = near & alike & (rise > 0) & (rise <= 4.5 * LAYER_M)
    graph = coo_matrix((np.ones(linked.sum(), bool), (i[linked], j[linked])), shape=(len(rings), len(rings)))
    stack = connected_components(graph, directed=False)[1]
    order = np.argsort(stack, kind="stable")
    stacks = np.split(order, np.flatnonzero(np.diff(stack[order])) + 1)
    stems: list[_Stack] = []
    for k, rows in enumerate(stacks):
        if k % 50 == 0:
            progress(k / len(stacks), "Looking for stems")
        stems += _stems_in_stack(rings.subset(rows), height[rows], settings)
    return stems


def _stems_in_stack(rings: Rings, height: Float64, settings: TrunkSettings) -> list[_Stack]:
    """The best line through the rings' centres, then the best of what is left, while there is evidence for a stem."""
    stems: list[_Stack] = []
    left = np.arange(len(rings))
    while len(np.unique(height[left])) >= 3:
        on = _best_line(rings.xy[left], rings.radius[left], height[left], rings.coverage_deg[left], settings)
        stack = _as_stem(rings.subset(left[on]), height[left[on]], settings) if len(on) else None
        if stack is None:
            break
        stems.append(stack)
        stem, doubts = stack
        if doubts:
            break
        # What the stem explains goes with it, also rings of another size about the same axis.
        axis = stem.axis[0] + height[left][:, None] * stem.axis[1]
        left = left[np.hypot(*(rings.xy[left] - axis).T) > 0.03 + 0.5 * stem.radius_m]
    return stems


def _best_line(xy: Float64, radius: Float64, height: Float64, coverage: Float64, settings: TrunkSettings) -> Int64:
    """Rows of the rings about the line that most of the arc seen is on; one ring per layer."""
    i, j = np.triu_indices(len(height), 1)
    apart = np.abs(height[i] - height[j]) > 1.5 * LAYER_M
    i, j = i[apart], j[apart]
    if len(i) > 400:
        some = np.linspace(0, len(i) - 1, 400).astype(int)
        i, j = i[some], j[some]
    if not len(i):
        return np.empty(0, np.int64)
    slope = (xy[j] - xy[i]) / (height[j] - height[i])[:, None]
    foot = xy[i] - slope * height[i][:, None]
    tilt = np.hypot(slope[:, 0], slope[:, 1]) <= np.tan(np.radians(settings.normal_max_deg))
    typical = np.sqrt(radius[i] * radius[j])
    predicted = foot[:, None, :] + slope[:, None, :] * height[None, :, None]
    gap = np.hypot(*(xy[None] - predicted).transpose(2, 0, 1))
    on = (gap <= (0.025 + 0.2 * typical)[:, None]) & (
        np.abs(radius[None] - typical[:, None]) <= 0.015 + 0.35 * typical[:, None]
    )
    layers = np.unique(height, return_inverse=True)[1]
    quality = np.where(on, coverage[None] * (1.0 - 0.5 * gap / (0.025 + 0.2 * typical)[:, None]), 0.0)
    best_in_layer = np.stack([quality[:, layers == k].max(axis=1) for k in range(layers.max() + 1)], axis=1)
    support = best_in_layer.sum(axis=1) * tilt
    best = int(support.argmax())
    rows = [int(np.where(layers == k, quality[best], -1.0).argmax()) for k in np.flatnonzero(best_in_layer[best] > 0)]
    return np.asarray(rows, np.int64) if support[best] > 0 else np.empty(0, np.int64)


def _as_stem(rings: Rings, height: Float64, settings: TrunkSettings) -> _Stack | None:
    """The rings as a stem, and the settings that speak against it; None where the evidence is too thin for any."""
    n = len(height)
    if n < 4:
        return None
    span = float(np.ptp(height)) + LAYER_M
    coverage = float(rings.coverage_deg.mean())
    spread = float(np.median(np.abs(rings.radius - np.median(rings.radius)))) / float(np.median(rings.radius))
    length = min(settings.stem_length_m, 0.6 * (settings.slab_high_m - settings.slab_low_m))
    if n * LAYER_M < 0.5 * span or spread > 0.25:
        return None
    # Chance circles in foliage have points inside and just outside; the surface of a stem stands free.
    clean = float(np.clip(1.0 - 2.0 * rings.inside_share - rings.clutter_share, -1.0, 1.0).sum())
    if clean < _MIN_CLEAN_LAYERS:
        return None
    design = np.column_stack([np.ones(n), height])
    axis = np.asarray(np.linalg.lstsq(design, rings.xy, rcond=None)[0], np.float64)
    order = np.argsort(height)
    stem = Stem(axis, height[order], rings.xy[order], rings.radius[order], coverage, clean * coverage)
    doubts = (("stem_length_m", span < length), ("min_arc_deg", coverage < settings.min_arc_deg))
    return stem, tuple(name for name, is_doubt in doubts if is_doubt)


def _near_misses(stacks: list[_Stack], stems: tuple[Stem, ...]) -> tuple[NearMiss, ...]:
    """Those that stand by themselves: neither at a stem that was found nor at a surer near miss."""
    known = list(stems)
    misses = []
    for stem, doubts in sorted(stacks, key=lambda stack: -stack[0].score):
        middle = float(stem.heights_m.mean())
        x, y = stem.xy_at(middle)
        apart = [np.hypot(*(other.xy_at(middle) - (x, y))) - other.radius_m - stem.radius_m for other in known]
        if min(apart, default=np.inf) < _APART_M:
            continue
        known.append(stem)
        low, high = float(stem.heights_m[0]), float(stem.heights_m[-1])
        misses.append(
            NearMiss(
                x_m=float(x),
                y_m=float(y),
                low_m=low,
                high_m=high,
                diameter_m=2.0 * stem.radius_m,
                span_m=high - low + LAYER_M,
                coverage_deg=stem.coverage_deg,
                n_layers=len(stem.heights_m),
                reasons=doubts,
            )
        )
    return tuple(sorted(misses, key=lambda miss: (miss.x_m, miss.y_m)))


def _without_doubles(stems: list[Stem]) -> tuple[Stem, ...]:
    """Of stems that stand within each other the surest, and of stems that touch none that is much less sure.

    The far side of a leaning or rough stem makes a second, weaker stack of rings; real twins are about equally clear.
    """
    stems = sorted(stems, key=lambda stem: -stem.score)
    radius = np.array([stem.radius_m for stem in stems])
    score = np.array([stem.score for stem in stems])
    axes = np.array([stem.axis for stem in stems]).reshape(-1, 2, 2)
    kept: list[int] = []
    for k, stem in enumerate(stems):
        middle = float(stem.heights_m.mean())
        others = np.asarray(kept, int)
        distance = np.hypot(*(axes[others, 0] + middle * axes[others, 1] - stem.xy_at(middle)).T)
        within = distance <= np.maximum(0.75 * np.maximum(radius[k], radius[others]), 0.04)
        touching = distance <= 1.3 * (radius[k] + radius[others]) + 0.02
        if not (within | (touching & (score[k] < 0.45 * score[others]))).any():
            kept.append(k)
    return tuple(stems[k] for k in kept)
