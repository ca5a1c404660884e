"""What is sent to the screen: a bounded, coarse-first sample of the cloud, and its colours.

The display cloud is not the measured cloud: diameters always come from every point.
"""

from __future__ import annotations

import colorsys

import numpy as np

from dbh_studio.core.arrays import Float, Float32, Int64, UInt8

TRUNK_RED = (214, 40, 40)
HIGHLIGHT_YELLOW = (255, 208, 0)

_FIRST_CHUNK = 60_000
# A click waits in the page until the chunk at hand is in the graphics memory.
_LARGEST_CHUNK = 200_000

_N_SHADES = 1024

# Dark soil to light crown; readable in print and by colour-blind eyes (lightness rises steadily).
_HEIGHT_STOPS = np.array(
    [[52, 40, 88], [49, 94, 140], [38, 148, 138], [110, 195, 88], [253, 231, 76]],
    np.float32,
)


def sample_for_display(n_points: int, budget: int, *, seed: int = 0) -> Int64:
    """Indices of at most `budget` points, evenly drawn over the file's order, shuffled.

    One point is drawn from each of `budget` equal stretches of the file, so that every scan and every tile is
    represented; the shuffle makes each leading part of the result a thinned picture of the whole plot.

    Returns:
        (min(n_points, budget),) unique indices.
    """
    if n_points < 0 or budget <= 0:
        raise ValueError(f"{n_points} points and a budget of {budget}; at least 0 and 1 are needed")
    rng = np.random.default_rng(seed)
    if n_points <= budget:
        chosen = np.arange(n_points)
    else:
        edges = np.linspace(0, n_points, budget + 1).astype(np.int64)
        chosen = edges[:-1] + (rng.random(budget) * np.diff(edges)).astype(np.int64)
    return rng.permutation(chosen)


def coarse_first_chunks(n_points: int) -> list[slice]:
    """Slices of growing size over a shuffled sample: the first is small, so that something is seen at once."""
    chunks, start, size = [], 0, _FIRST_CHUNK
    while start < n_points:
        chunks.append(slice(start, min(start + size, n_points)))
        start, size = start + size, min(size * 3, _LARGEST_CHUNK)
    return chunks


def height_colours(heights_m: Float, *, top_m: float | None = None) -> UInt8:
    """(N, 3) colours from dark at 0 m to bright at `top_m` (default: the 99th percentile)."""
    if len(heights_m) == 0:
        return np.zeros((0, 3), np.uint8)
    top = float(np.percentile(heights_m, 99)) if top_m is None else top_m
    steps = np.linspace(0.0, len(_HEIGHT_STOPS) - 1, _N_SHADES)
    table = np.stack([np.interp(steps, np.arange(len(_HEIGHT_STOPS)), stops) for stops in _HEIGHT_STOPS.T], axis=1)
    shade = np.clip(heights_m * ((_N_SHADES - 1) / max(top, 1e-6)), 0.0, _N_SHADES - 1.0).astype(np.int16)
    return table.astype(np.uint8).take(shade, axis=0)


def tree_colour(tree_id: int) -> tuple[int, int, int]:
    """A vivid colour for a tree; neighbours in number are far apart in hue (golden angle)."""
    hue = (tree_id * 0.61803398875) % 1.0
    red, green, blue = colorsys.hls_to_rgb(hue, 0.5 + 0.08 * (tree_id % 3 - 1), 0.75)
    return int(red * 255), int(green * 255), int(blue * 255)


def thin_to(points: Float32, limit: int, *, seed: int = 0) -> Float32:
    """At most `limit` of the (N, 3) points, evenly drawn."""
    if len(points) <= limit:
        return points
    return points[np.sort(sample_for_display(len(points), limit, seed=seed))]


def rough_heights(points: Float32, *, cell: float) -> Float32:
    """(N,) height of each point above the lowest point of its grid cell: enough for colours, too crude to measure with.

    Args:
        points: (N, 3), any unit.
        cell: Grid cell in the same unit.
    """
    if len(points) == 0:
        return np.zeros(0, np.float32)
    # One coordinate at a time: over three columns at once numpy takes thirty times as long.
    x, y, z = points.T
    # A flat file with one stray point a kilometre away must not allocate a huge grid.
    cell = max(cell, float(np.ptp(x)) / 2000.0, float(np.ptp(y)) / 2000.0, 1e-9)
    column, row = ((values - values.min()) / cell for values in (y, x))
    n_columns = int(column.max()) + 1
    keys = row.astype(np.int32) * n_columns + column.astype(np.int32)
    lowest = np.full(int(keys.max()) + 1, np.inf, np.float32)
    np.minimum.at(lowest, keys, z)
    heights: Float32 = z - lowest.take(keys)
    return heights
