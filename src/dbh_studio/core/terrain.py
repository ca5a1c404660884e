"""A terrain surface from a cloud: robust low points per cell, then a surface pulled down from coarse to fine.

The idea is hierarchical robust interpolation (Kraus & Pfeifer 1998, ISPRS J. 53:193-203): a smooth surface is fitted to
the low points of all cells; cells above it count less, cells on it stay, and the next, finer surface starts from there.
What has no ground (under a stem, beneath a shrub, outside the cloud) is filled by the coarser surface, which continues
a slope instead of flattening it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Float64
from dbh_studio.core.neighbours import N_WORKERS
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.surfaces import local_plane

_CHUNK = 1 << 19
_CELLS_AT_ONCE = 20_000
# Height of the bins in which a column's points are counted. Ground noise (a few cm) stays within two of them.
_BIN_M = 0.25
# A bin is ground only with this share of the column's fullest bin: isolated noise below ground has far less.
_SUPPORT_SHARE = 0.03
# Residuals about the first surface are re-read within this band, in steps of 2 cm.
_BAND_M, _STEP_M = 0.80, 0.02
# Each level: standard deviation of the smoothing (in cells) and how far above the surface a cell may lie and count, m.
_LEVELS = ((24.0, 2.0), (12.0, 1.0), (6.0, 0.5), (3.0, 0.3))
_FINE_LEVELS = ((2.0, 0.2), (1.0, 0.15))
# More than noise below the surface: it is the underside of crowns, and stems hang below it.
_BELOW_SHARE = 0.03
# A stem's base is settled on the points this near in plan; bases nearer to each other than this are one.
_BASE_REACH_M, _BASE_GAP_M = 0.75, 0.5
# Without ground, what is lower than this above the lower surface of the cloud may be a stem's foot, not a crown.
_CROWN_BASE_M = 1.0
_MAX_NODES = 250_000
_MAX_BINS = 24_000_000
# Below this share of the footprint with ground in it, the ground has been removed. Measured: plots with ground 0.5-1.0,
# LPine1 (removed) 0.03, single trees cut out of their plot 0.1.
_GROUND_SHARE = 0.15


@dataclass(frozen=True, eq=False)
class Terrain:
    """What `fit_terrain` found; the fields are those of `ground.TerrainGround`, `bases_m` those of `StemBaseGround`."""

    z_m: Float32
    corner_xy_m: Float64
    cell_m: float
    slope_xy: Float64
    seen: Bool
    notes: tuple[str, ...] = ()
    bases_m: Float64 | None = None


@dataclass(frozen=True)
class _Grid:
    """Square cells, the plane the cloud is levelled with, and the range of levelled heights in which ground may lie."""

    corner_xy: Float64
    cell: float
    shape: tuple[int, int]
    trend: Float64
    z_low: float
    n_bins: int

    def cells(self, points: Float) -> tuple[Any, Float32]:
        """(N,) flat cell index, -1 outside or where not finite, and (N,) levelled height above `z_low`."""
        scalar = points.dtype.type
        x, y = (points[:, axis] - scalar(self.corner_xy[axis]) for axis in (0, 1))
        with np.errstate(invalid="ignore"):  # infinite coordinates: they are left out below
            height = points[:, 2] - scalar(self.trend[0]) * x - scalar(self.trend[1]) * y - scalar(self.z_low)
        # Column by column: reductions over the short axis of an (N, 2) array are several times slower.
        inside = np.isfinite(height)
        index = np.zeros(len(points), np.int32)
        for position, n in zip((x, y), self.shape, strict=True):
            steps = np.nan_to_num(position * scalar(1.0 / self.cell), nan=-1.0, posinf=-1.0, neginf=-1.0)
            inside &= (steps >= 0) & (steps < n)
            index = index * np.int32(n) + np.clip(steps, 0, n - 1).astype(np.int32)
        return np.where(inside, index, np.int32(-1)), height.astype(np.float32)


def fit_terrain(points: Float, *, cell_m: float, max_slope_deg: float, progress: Progress = ignore_progress) -> Terrain:
    """The terrain under (N, 3) points, metres, +z up.

    Args:
        points: (N, 3); non-finite points are ignored.
        cell_m: Wanted distance between nodes; coarser on sparse or very large clouds.
        max_slope_deg: A cell that rises more steeply than this from a lower neighbour is not ground.
        progress: Called between chunks.

    Returns:
        The surface, never NaN; with `bases_m` where there is no ground in the cloud.

    Raises:
        ValueError: No finite point.
    """
    progress(0.0, "Finding the ground")
    grid = _make_grid(points, cell_m, max_slope_deg)
    column = _columns(points, grid, progress)
    low, occupied = _robust_low(column, grid)
    gentle = _gentle(low, grid, max_slope_deg)
    usable = _supported(low, grid.cell) & gentle
    surface = _pull_down(low, usable, _LEVELS, np.full(grid.shape, _floor(low, usable)))
    progress(0.55, "Refining the ground")
    refined, sheet = _refine(points, grid, surface, progress)
    surface, is_ground = _through_sheets(refined, sheet, occupied, grid, max_slope_deg)
    n_occupied = max(int(np.count_nonzero(occupied)), 1)
    share = float(np.count_nonzero(is_ground)) / n_occupied
    x, y = (np.arange(n)[:, None] + 0.5 for n in grid.shape)
    level = grid.cell * (grid.trend[0] * x + grid.trend[1] * y.T) + grid.z_low
    slope = _overall_slope(surface, grid.cell) + grid.trend
    corner = grid.corner_xy + 0.5 * grid.cell
    terrain = Terrain((surface + level).astype(np.float32), corner, grid.cell, slope, is_ground)
    if share < _GROUND_SHARE or _share_below(column, surface) > _BELOW_SHARE:
        surface = _pull_down(low, gentle, _LEVELS, np.full(grid.shape, _floor(low, gentle)))
        bases = _stem_bases(points, low, surface, level, grid)
        return replace(terrain, bases_m=_settled(points, bases, subprogress(progress, 0.9, 1.0)))
    return replace(terrain, notes=_notes(share))


def _through_sheets(
    refined: Float64, sheet: Bool, occupied: Bool, grid: _Grid, max_slope_deg: float
) -> tuple[Float64, Bool]:
    """(nx, ny) the final surface, and in which cells ground was really seen."""
    # Where the ground is hidden, the foot of a stem is no ground either; without any sheets it is all there is.
    enough = np.count_nonzero(sheet) >= _GROUND_SHARE * np.count_nonzero(occupied)
    usable = sheet if enough else np.isfinite(refined)
    # From the start again: where a foot had raised the first surface, corrections from around would not reach.
    surface = _pull_down(refined, usable, _LEVELS + _FINE_LEVELS, np.full(grid.shape, _floor(refined, usable)))
    is_ground = sheet & (np.abs(np.where(sheet, refined, np.inf) - surface) < _FINE_LEVELS[-1][1])
    return surface, is_ground & (_steepness(surface, grid) <= np.tan(np.radians(max_slope_deg)))


def _make_grid(points: Float, cell_m: float, max_slope_deg: float) -> _Grid:
    """Cells over the bulk of the cloud, levelled by its overall plane, at most `_MAX_NODES` and `_MAX_BINS`."""
    sample = points[:: max(1, len(points) // 200_000)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not len(sample):
        raise ValueError("the cloud has no finite point to fit the ground to")
    # Stray points far outside would stretch the grid: 0.05 % each side are left out, and the margin takes the rim back.
    lower, upper = np.quantile(sample[:, :2], [0.0005, 0.9995], axis=0)
    margin = np.maximum(0.02 * (upper - lower), cell_m)
    lower, upper = lower - margin, upper + margin
    trend = _overall_plane(sample)
    if np.hypot(*trend) > np.tan(np.radians(max_slope_deg)):
        trend = np.zeros(2)  # crowns, not ground: a cloud without ground has no overall plane
    height = sample[:, 2] - (sample[:, :2] - lower) @ trend
    z_low, z_high = np.quantile(height, [0.0005, 0.9995]) + [-1.0, 0.5]
    n_bins = max(4, int(np.ceil((z_high - z_low) / _BIN_M)))
    size = upper - lower
    # A cell should hold some points of ground: on sparse clouds about ten points of any kind.
    sparse = float(np.sqrt(10.0 * size.prod() / max(len(points), 1)))
    cell = max(cell_m, min(sparse, 4.0 * cell_m), float(np.sqrt(size.prod() / _MAX_NODES)))
    cell = max(cell, float(np.sqrt(size.prod() * n_bins / _MAX_BINS)))
    shape = tuple(int(n) for n in np.maximum(np.ceil(size / cell), 2))
    return _Grid(lower, cell, (shape[0], shape[1]), trend, float(z_low), n_bins)


def _overall_plane(sample: Float64) -> Float64:
    """(2,) slope along x and y of the low points of a coarse grid: it only has to be right to some degrees."""
    size = sample[:, :2].max(axis=0) - sample[:, :2].min(axis=0)
    blocks = np.clip(np.ceil(size / 2.0), 1, 24).astype(int)
    ij = np.minimum((sample[:, :2] - sample[:, :2].min(axis=0)) / np.maximum(size, 1e-9) * blocks, blocks - 1).astype(
        int
    )
    key = ij[:, 0] * blocks[1] + ij[:, 1]
    order = np.lexsort((sample[:, 2], key))
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(start, append=len(order))
    low = sample[order[start + count // 20]]  # the 5 % point, because the lowest may be noise
    # Blocks with few points are overhanging crowns and stray points.
    low = low[count >= 0.25 * np.median(count)]
    if len(low) < 6:
        return np.zeros(2)
    # The plane that most blocks are near, then least squares on those: half of the blocks may show crowns only.
    centred = low - low.mean(axis=0)
    corners = centred[np.random.default_rng(0).integers(0, len(low), (600, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal, first = normal[np.abs(normal[:, 2]) > 1e-9], corners[np.abs(normal[:, 2]) > 1e-9, 0]
    slopes = -normal[:, :2] / normal[:, 2:]
    slopes, first = slopes[np.hypot(*slopes.T) < 2.0], first[np.hypot(*slopes.T) < 2.0]
    if not len(slopes):
        return np.zeros(2)
    level = first[:, 2] - np.einsum("ij,ij->i", slopes, first[:, :2])
    residual = centred[None, :, 2] - slopes @ centred[:, :2].T - level[:, None]
    near = np.abs(residual) < 1.0
    # Of planes that as many blocks are near the gentler one: the underside of crowns may be as even as the ground.
    best = int((near.sum(axis=1) - 1e-3 * np.hypot(*slopes.T)).argmax())
    design = np.column_stack([centred[near[best], :2], np.ones(near[best].sum())])
    return np.asarray(np.linalg.lstsq(design, centred[near[best], 2], rcond=None)[0][:2])


def _columns(points: Float, grid: _Grid, progress: Progress) -> Any:
    """(nx·ny, n_bins) how many points every cell holds at every height."""
    n_cells = grid.shape[0] * grid.shape[1]
    counts = np.zeros(n_cells * grid.n_bins, np.int32)
    for start in range(0, len(points), _CHUNK):
        progress(0.5 * start / len(points), "Finding the ground")
        cell, height = grid.cells(points[start : start + _CHUNK])
        keep = (cell >= 0) & (height >= 0) & (height < grid.n_bins * _BIN_M)
        bin_ = cell[keep] * np.int64(grid.n_bins) + (height[keep] / _BIN_M).astype(np.int64)
        np.add.at(counts, bin_, np.int32(1))
    return counts.reshape(n_cells, grid.n_bins)


def _robust_low(column: Any, grid: _Grid) -> tuple[Float64, Bool]:
    """(nx, ny) levelled height of the lowest bin with real support (NaN where none), and which cells have points.

    Noise below ground is thin: a bin counts only with a share of the points of its column's fullest bin.
    """
    # Two neighbouring bins together, because the ground may lie across their border.
    pair = column.copy()
    pair[:, :-1] += column[:, 1:]
    peak = pair.max(axis=1)
    supported = pair >= np.maximum(_SUPPORT_SHARE * peak, 2.0)[:, None]
    first = supported.argmax(axis=1)
    has = supported.any(axis=1)
    here, above = (column[np.arange(len(column)), np.minimum(first + step, grid.n_bins - 1)] for step in (0, 1))
    # The centre of mass of the two bins, in bins.
    height = first + 0.5 + above / np.maximum(here + above, 1)
    low = np.where(has, height * _BIN_M, np.nan)
    return low.reshape(grid.shape), (peak > 0).reshape(grid.shape)


def _supported(low: Float64, cell: float) -> Bool:
    """Which cells agree, within a 45° slope, with some other cells nearby: pits of noise agree with none."""
    reach = 4
    padded = np.pad(low, reach, constant_values=np.nan)
    agree = np.zeros(low.shape, np.int16)
    present = np.zeros(low.shape, np.int16)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            if i or j:
                other = padded[reach + i : reach + i + low.shape[0], reach + j : reach + j + low.shape[1]]
                agree += np.abs(other - low) < 0.3 + cell * np.hypot(i, j)
                present += np.isfinite(other)
    return np.isfinite(low) & (agree >= np.minimum(3, present // 4))


def _gentle(low: Float64, grid: _Grid, max_slope_deg: float) -> Bool:
    """Which cells do not rise more steeply than `max_slope_deg` from a lower one nearby."""
    reach = 4
    offset = np.arange(-reach, reach + 1) * grid.cell
    rise = np.tan(np.radians(max_slope_deg)) * np.hypot(offset[:, None], offset[None, :])
    # Slopes are limited in the world, where the trend adds to the levelled heights.
    x, y = (np.arange(n)[:, None] * grid.cell for n in grid.shape)
    world = np.where(np.isfinite(low), low, np.inf) + grid.trend[0] * x + grid.trend[1] * y.T
    limit = ndimage.grey_erosion(world, structure=-(rise + _BIN_M), mode="constant", cval=np.inf)
    return np.asarray(np.isfinite(low) & (world <= limit + 1e-9))


def _floor(low: Float64, usable: Bool) -> float:
    """A level to start from where nothing else is known: the lower part of all cells."""
    values = low[usable] if usable.any() else low[np.isfinite(low)]
    return float(np.quantile(values, 0.25)) if len(values) else 0.0


def _pull_down(low: Float64, usable: Bool, levels: tuple[tuple[float, float], ...], surface: Float64) -> Float64:
    """(nx, ny) smooth surface through the lower of the usable cells, from coarse to fine; starts from `surface`."""
    value = np.where(usable, low, 0.0)
    for sigma, tolerance in levels:
        for widening in (4.0, 2.0, 1.0, 1.0):
            residual = value - surface
            limit = widening * tolerance
            # Below the surface a cell counts fully (it pulls the surface down) unless it is far below: noise.
            weight = np.where(residual > 0, 1.0 / (1.0 + (residual / limit) ** 4), 1.0)
            weight = np.where(usable, weight, 0.0)
            surface = surface + local_plane(residual, weight, sigma)
    return surface


def _share_below(column: Any, surface: Float64) -> float:
    """Share of the points that lie more than a metre below the surface."""
    depth = np.clip((surface.ravel() - 1.0) / _BIN_M, 0, column.shape[1]).astype(np.int64)
    below = np.arange(column.shape[1]) < depth[:, None]
    return float(column[below].sum() / max(column.sum(), 1))


def _refine(points: Float, grid: _Grid, surface: Float64, progress: Progress) -> tuple[Float64, Bool]:
    """(nx, ny) levelled height of the lowest sheet of points near `surface`, NaN where none, and whether it is a sheet.

    About the surface a slope no longer smears a cell's heights, so they can be read to centimetres. A sheet is denser
    than what is directly above it, unlike the foot of a stem, which goes on upwards.
    """
    n_steps = round(2 * _BAND_M / _STEP_M)
    counts = np.zeros((surface.size, n_steps), np.int32)
    flat = surface.ravel().astype(np.float32)
    gx, gy = (g.ravel().astype(np.float32) for g in np.gradient(surface))
    for start in range(0, len(points), _CHUNK):
        progress(0.55 + 0.35 * start / len(points), "Refining the ground")
        part = points[start : start + _CHUNK]
        cell, height = grid.cells(part)
        near = np.flatnonzero((cell >= 0) & (np.abs(height - flat[cell]) < 3 * _BAND_M))
        cell, height = cell[near], height[near]
        fraction = (part[near, :2] - grid.corner_xy) / grid.cell
        fraction -= np.floor(fraction) + 0.5
        residual = height - flat[cell] - fraction[:, 0] * gx[cell] - fraction[:, 1] * gy[cell]
        step = np.floor((residual + _BAND_M) / _STEP_M).astype(np.int64)
        inside = (step >= 0) & (step < n_steps)
        np.add.at(counts.reshape(-1), cell[inside] * np.int64(n_steps) + step[inside], np.int32(1))
    # In parts, because it needs several times the memory of the counts.
    parts = [_lowest_sheet(part) for part in np.array_split(counts, len(counts) // _CELLS_AT_ONCE + 1)]
    level, sheet = (np.concatenate(part) for part in zip(*parts, strict=True))
    return (flat + level).reshape(grid.shape), sheet.reshape(grid.shape)


def _lowest_sheet(counts: Any) -> tuple[Float64, Bool]:
    """Of (M, n) histograms of residuals the (M,) residual of the lowest dense layer (or NaN), and if it is a sheet."""
    width = 5
    smooth = ndimage.uniform_filter1d(counts.astype(np.float32), width, axis=1, mode="constant") * width
    peak = smooth.max(axis=1)
    first = (smooth >= np.maximum(0.3 * peak, 1.5)[:, None]).argmax(axis=1)
    steps = np.arange(counts.shape[1])
    window = (steps >= first[:, None]) & (steps <= first[:, None] + width)
    centre = np.where(window, smooth, -1.0).argmax(axis=1)
    around = np.abs(steps - centre[:, None]) <= 3
    n_around = np.where(around, counts, 0).sum(axis=1)
    middle = (steps + 0.5) * _STEP_M - _BAND_M
    level = np.where(around, counts, 0) @ middle / np.maximum(n_around, 1)
    n_above = np.where((steps > centre[:, None] + 5) & (steps <= centre[:, None] + 12), counts, 0).sum(axis=1)
    # What lies so high in the band that nothing above it could be seen proves nothing.
    sheet = (peak >= 1.5) & (n_around >= 2.0 * n_above) & (centre + 12 < counts.shape[1])
    return np.where(peak >= 1.5, level, np.nan), sheet


def _steepness(surface: Float64, grid: _Grid) -> Float64:
    """(nx, ny) rise per metre of the surface in the world, where the trend adds to it."""
    dx, dy = np.gradient(surface, grid.cell)
    return np.asarray(np.hypot(dx + grid.trend[0], dy + grid.trend[1]))


def _overall_slope(surface: Float64, cell: float) -> Float64:
    """(2,) least-squares slope of the whole surface."""
    x, y = (cell * (np.arange(n) - (n - 1) / 2.0) for n in surface.shape)
    return np.array(
        [
            (x @ surface).sum() / ((x @ x) * surface.shape[1]),
            (surface @ y).sum() / ((y @ y) * surface.shape[0]),
        ]
    )


def _stem_bases(points: Float, low: Float64, surface: Float64, level: Float64, grid: _Grid) -> Float64:
    """(K, 3) the lowest cells of their surroundings: about where the feet of the stems are."""
    height = np.where(np.isfinite(low), low + level, np.inf)
    reach = max(1, round(0.5 / grid.cell))
    lowest = ndimage.minimum_filter(height, 2 * reach + 1, mode="constant", cval=np.inf)
    # Crowns between the stems hang well above the lower surface.
    is_base = np.isfinite(height) & (height <= lowest) & (height < surface + level + _CROWN_BASE_M)
    if not is_base.any():
        is_base = height == height.min()
    if not np.isfinite(height).any():
        return _lowest_point(points)
    i, j = np.nonzero(is_base)
    return np.column_stack([grid.corner_xy + grid.cell * (np.column_stack([i, j]) + 0.5), height[i, j]])


def _lowest_point(points: Float) -> Float64:
    """(1, 3) the lowest finite point: all that a handful of points has to offer."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite[[int(finite[:, 2].argmin())]].astype(np.float64)


def _settled(points: Float, bases: Float64, progress: Progress) -> Float64:
    """(K, 3) bases put on the lowest points about them: not the very lowest, which may be noise, but the third."""
    part, base = _around_bases(points, bases, progress)
    settled = bases.copy()
    if len(part):
        order = np.lexsort((part[:, 2], base))
        part, base = part[order], base[order]
        first = np.flatnonzero(np.diff(base, prepend=-1))
        count = np.diff(first, append=len(base))
        foot = part[first + np.minimum(2, count - 1), 2]
        weight = (part[:, 2] <= np.repeat(foot, count) + 0.2).astype(np.float64)
        middle = np.add.reduceat(part[:, :2] * weight[:, None], first) / np.add.reduceat(weight, first)[:, None]
        settled[base[first]] = np.column_stack([middle, foot])
    # Two cells of one foot settle on the same points: the lower one stays.
    settled = settled[np.argsort(settled[:, 2], kind="stable")]
    crowded = cKDTree(settled[:, :2]).query_pairs(_BASE_GAP_M, output_type="ndarray")
    return np.delete(settled, np.unique(crowded.max(axis=1, initial=-1)), axis=0)


def _around_bases(points: Float, bases: Float64, progress: Progress) -> tuple[Float64, Any]:
    """(M, 3) the points about the height of the base nearest to them in plan, and (M,) the index of that base."""
    tree = cKDTree(bases[:, :2])
    lowest, highest = bases[:, 2].min() - 2 * _BIN_M, bases[:, 2].max() + 2 * _BIN_M
    parts, nearest = [], []
    for start in range(0, len(points), _CHUNK):
        progress(start / len(points), "Looking for the feet of the stems")
        part = points[start : start + _CHUNK].astype(np.float64)
        part = part[(part[:, 2] > lowest) & (part[:, 2] < highest) & np.isfinite(part[:, :2]).all(axis=1)]
        base = tree.query(part[:, :2], distance_upper_bound=_BASE_REACH_M, workers=N_WORKERS)[1]
        near = np.flatnonzero(base < len(bases))
        near = near[np.abs(part[near, 2] - bases[base[near], 2]) < 2 * _BIN_M]
        parts.append(part[near])
        nearest.append(base[near])
    progress(1.0, "Looking for the feet of the stems")
    return np.concatenate(parts), np.concatenate(nearest)


def _notes(share: float) -> tuple[str, ...]:
    if share > 0.4:
        return ()
    return (
        f"Ground is visible under only {100 * share:.0f} % of the plot; the rest was filled in from around it. "
        "Check heights where stems stand in dense undergrowth.",
    )
