"""Following a stem down to the ground and up to where it is lost, layer by layer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32, Int64
from dbh_studio.core.neighbours import N_WORKERS
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.rings import refit_rings
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.stem_detection import LAYER_M, Stem

# A stem is lost after so many layers (0.8 m) without a ring.
_PATIENCE = 4
# Points farther from a stem's surface than this many of its bands are none of its own.
WIDEST = 1.5


@dataclass(frozen=True, eq=False)
class StemModels:
    """The surfaces of all stems: a circle per stem and layer.

    Attributes:
        low_m: Height of the lower side of layer 0.
        xy_m: (S, L, 2) centres at the layers' middles; extrapolated where no ring was seen.
        radius_m: (S, L)
        alive: (S, L) False above where the stem is lost.
        seen: (S, L) True where a ring was seen.
        band_m: (S,) how far from its circle a stem's surface reaches, from the scatter of its own points.
    """

    low_m: float
    xy_m: Float64
    radius_m: Float64
    alive: Bool
    seen: Bool
    band_m: Float64

    def layer_of(self, height: Float) -> Int64:
        """(N,) layer of each height, the lowest and highest for heights beyond them."""
        layer = np.floor((height - self.low_m) / LAYER_M).astype(np.int64)
        return np.clip(layer, 0, self.alive.shape[1] - 1)

    def owner(self, levelled: Float) -> tuple[Int32, Float32]:
        """Which stem's surface each point is nearest to, and how far away it is.

        Args:
            levelled: (N, 3) x, y, height above ground.

        Returns:
            (N,) index of the stem, -1 beyond `WIDEST` bands of all; (N,) distance in bands of that stem.
        """
        owner = np.full(len(levelled), -1, np.int32)
        distance = np.full(len(levelled), np.inf, np.float32)
        slope = np.gradient(self.xy_m, LAYER_M, axis=1)
        order, edges = _by_layer(levelled[:, 2], self.low_m, self.xy_m.shape[1])
        for k in range(self.xy_m.shape[1]):
            stems = np.flatnonzero(self.alive[:, k])
            rows = order[edges[k] : edges[k + 1]]
            if not len(stems) or not len(rows):
                continue
            rise = levelled[rows, 2] - (self.low_m + (k + 0.5) * LAYER_M)
            found, gap = _nearest_surface(
                levelled[rows, :2], rise, stems, self.xy_m[:, k], slope[:, k], self.radius_m[:, k], WIDEST * self.band_m
            )
            owner[rows], distance[rows] = found, gap / np.where(found >= 0, self.band_m[found], 1.0)
        return owner, distance


def _by_layer(height: Float, low: float, n_layers: int) -> tuple[Int64, Int64]:
    """Rows sorted by layer, and where each layer's rows begin and end."""
    layer = np.clip(np.floor((height - low) / LAYER_M), -1, n_layers).astype(np.int16)
    order = np.argsort(layer, kind="stable")
    return order, np.searchsorted(layer[order], np.arange(n_layers + 1))


def _nearest_surface(
    xy: Float, rise: Float, stems: np.ndarray, centre: Float64, slope: Float64, radius: Float64, band: Float64
) -> tuple[Int32, Float64]:
    """(N,) the stem whose circle is nearest and within its band, -1 where none, and (N,) the distance to the circle."""
    n_near = min(2, len(stems))
    # Nothing farther from an axis is within a band, and looking no farther is quicker.
    lean = float(np.abs(rise).max(initial=0.0)) * float(np.hypot(*slope[stems].T).max())
    reach = float((radius[stems] + band[stems]).max()) + lean + 1e-6
    near = cKDTree(centre[stems], leafsize=8).query(
        xy, k=np.arange(1, n_near + 1), distance_upper_bound=reach, workers=N_WORKERS
    )[1]
    best, owner = np.full(len(xy), np.inf), np.full(len(xy), -1, np.int32)
    for column in range(n_near):
        rows = np.flatnonzero(near[:, column] < len(stems))
        stem = stems[near[rows, column]]
        offset = xy[rows] - centre[stem] - rise[rows, None] * slope[stem]
        gap = np.abs(np.hypot(offset[:, 0], offset[:, 1]) - radius[stem])
        better = (gap <= band[stem]) & (gap < best[rows])
        best[rows[better]], owner[rows[better]] = gap[better], stem[better]
    return owner, best


def follow_stems(
    levelled: Float32,
    stems: tuple[Stem, ...],
    *,
    spacing_m: float,
    settings: TrunkSettings,
    progress: Progress = ignore_progress,
    seed: int = 0,
) -> StemModels:
    """The surface of every stem from the ground clearance up to the trunk top, or to where it is lost.

    Args:
        levelled: (N, 3) thinned points near the stems: x, y, height above ground.
        stems: What `stem_detection.detect_stems` found.
        spacing_m: Typical distance of the points on a surface.
        settings: Heights.
        progress: Called between layers.
        seed: Of the random samples.
    """
    low = settings.ground_clearance_m
    n_layers = max(2, int(np.ceil((settings.trunk_top_m - low) / LAYER_M)))
    tracker = _Tracker(levelled, stems, low, n_layers, max(0.02, 0.6 * spacing_m), seed)
    for step, k in enumerate(range(tracker.first, n_layers)):
        progress(0.8 * step / n_layers, "Following the stems")
        tracker.visit(k, k - 1)
    for k in range(n_layers - 2, -1, -1):
        if k < tracker.seen_from.max():
            tracker.visit(k, k + 1)
    progress(0.9, "Following the stems")
    return tracker.models()


class _Tracker:
    """The state of following: what is known of every stem in every layer."""

    def __init__(
        self, levelled: Float32, stems: tuple[Stem, ...], low: float, n_layers: int, tolerance: float, seed: int
    ) -> None:
        self.low, self.tolerance, self.seed = low, tolerance, seed
        self.points = levelled
        self.order, self.edges = _by_layer(levelled[:, 2], low, n_layers)
        n = len(stems)
        self.xy = np.full((n, n_layers, 2), np.nan)
        self.radius = np.full((n, n_layers), np.nan)
        self.seen = np.zeros((n, n_layers), bool)
        self.scatter: list[list[float]] = [[] for _ in stems]
        self.slope = np.array([stem.axis[1] for stem in stems])
        self.typical = np.array([stem.radius_m for stem in stems])
        self.seen_from = np.zeros(n, int)
        for i, stem in enumerate(stems):
            # Start at the ring next to 1.3 m: around breast height the detector is surest.
            start = int(np.abs(stem.heights_m - 1.3).argmin())
            k = int(np.clip((stem.heights_m[start] - low) / LAYER_M, 0, n_layers - 1))
            middle = low + (k + 0.5) * LAYER_M
            self.xy[i, k] = stem.xy_m[start] + (middle - stem.heights_m[start]) * stem.axis[1]
            self.radius[i, k] = 0.5 * (stem.radii_m[start] + stem.radius_m)
            self.seen_from[i] = k
        self.first = int(self.seen_from.min())

    def visit(self, k: int, before: int) -> None:
        """Fit layer `k` of every stem that is known in layer `before` (or starts here)."""
        n = len(self.xy)
        up = before < k
        known = np.isfinite(self.radius[:, before]) if before >= 0 else np.zeros(n, bool)
        starts = self.seen_from == k
        todo = np.flatnonzero((starts & up) | (known & ((self.seen_from < k) if up else (self.seen_from > k))))
        if not len(todo):
            return
        centre, radius = self.xy[:, k].copy(), self.radius[:, k].copy()
        moving = todo[~starts[todo]]
        step = LAYER_M if up else -LAYER_M
        centre[moving] = self.xy[moving, before] + step * self.slope[moving]
        radius[moving] = self.radius[moving, before]
        found, xy, size, scatter = self._fitted(k, todo, centre, radius)
        self.xy[todo, k], self.radius[todo, k] = centre[todo], radius[todo]
        self.xy[found, k] = xy
        # A little of the layer before: one layer's whorl of branches must not blow the stem up.
        keep = np.where(starts[found], 0.0, 0.4)
        self.radius[found, k] = keep * radius[found] + (1.0 - keep) * size
        self.seen[found, k] = True
        on_the_way = ~starts[found]
        turn = (self.xy[found, k] - self.xy[found, before]) / step if before >= 0 else np.zeros((len(found), 2))
        self.slope[found] = np.where(on_the_way[:, None], 0.85 * self.slope[found] + 0.15 * turn, self.slope[found])
        for stem, value in zip(found, scatter, strict=True):
            self.scatter[stem].append(float(value))

    def _fitted(
        self, k: int, todo: np.ndarray, centre: Float64, radius: Float64
    ) -> tuple[np.ndarray, Float64, Float64, Float64]:
        """The stems whose ring was found in layer `k`, their centres, radii and scatter."""
        rows = self.order[self.edges[k] : self.edges[k + 1]]
        nothing = np.empty(0)
        if not len(rows):
            return np.empty(0, int), np.empty((0, 2)), nothing, nothing
        xy = self.points[rows, :2]
        rise = self.points[rows, 2] - (self.low + (k + 0.5) * LAYER_M)
        reach = 2.0 * self.tolerance + 0.3 * radius
        group = _nearest_surface(xy, rise, todo, centre, self.slope, radius, reach)[0]
        near = group >= 0
        if not near.any():
            return np.empty(0, int), np.empty((0, 2)), nothing, nothing
        # Leaning stems are straightened within the layer before the circle is fitted.
        straight = xy[near] - (rise[near, None] * self.slope[group[near]])
        rings, scatter = refit_rings(straight, group[near], centre, radius, tolerance=self.tolerance, seed=self.seed)
        moved = np.hypot(*(rings.xy - centre[rings.group]).T)
        ratio = rings.radius / radius[rings.group]
        # Down to the root collar a stem widens, upwards it does not.
        widest = np.where(k < self.seen_from[rings.group], 1.5, 1.2)
        good = (
            (rings.coverage_deg >= 75.0)
            & (rings.n_on >= 6)
            & (rings.inside_share <= 0.5)
            & (moved <= 0.03 + 0.3 * radius[rings.group])
            & (ratio > 0.65)
            & (ratio < widest)
            & (rings.radius < 1.8 * self.typical[rings.group])
        )
        return rings.group[good], rings.xy[good], rings.radius[good], scatter[good]

    def models(self) -> StemModels:
        """What was found, with the layers after the last ring marked as lost."""
        # The first run of `_PATIENCE` layers without a ring ends the stem, even if rings turn up in the crown beyond.
        alive = np.zeros_like(self.seen)
        for i in range(len(alive)):
            rings = np.flatnonzero(self.seen[i])
            rings = rings[rings >= self.seen_from[i]]
            gaps = np.flatnonzero(np.diff(rings) > _PATIENCE)
            top = rings[gaps[0]] if len(gaps) else (rings[-1] if len(rings) else self.seen_from[i])
            alive[i, : top + 1] = True
        alive &= np.isfinite(self.radius)
        scatter = np.array([np.median(s) if s else self.tolerance for s in self.scatter])
        typical = self.typical
        # 1.4826 MAD is one standard deviation, 3.5 of them hold all of a normal ring; 8 % for what is not round.
        band = np.clip(3.5 * 1.4826 * scatter + 0.005 + 0.08 * typical, 0.025, 0.08 + 0.2 * typical)
        return StemModels(self.low, np.nan_to_num(self.xy), np.nan_to_num(self.radius), alive, self.seen & alive, band)
