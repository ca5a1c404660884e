"""The paper's chain on the candidates: normals, DBSCAN, cluster sizes, expansion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float32, Float64, Int32, Int64, UInt8
from dbh_studio.core.chain_steps import NO_NORMAL, Cluster, Step, keep_clusters
from dbh_studio.core.clusters import NOISE, dbscan
from dbh_studio.core.neighbours import N_WORKERS, surface_normals
from dbh_studio.core.progress import Progress, subprogress
from dbh_studio.core.voxels import Thinned, thin
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.stem_detection import Stem
from dbh_studio.stages.stem_tracking import StemModels, follow_stems

# So many thinned points go through normals and DBSCAN at most; more are thinned further.
_MAX_POINTS = 500_000
_MAX_TRACKED = 1_000_000
_WIDTH_LAYER_M = 0.5


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the chain made of the candidates.

    Attributes:
        labels: (N,) trunk of every point given to the chain, -1 where none.
        stems: Per trunk what the detector saw of it, or None.
        clusters: Largest first; their points are rows of what was given to the chain.
        size_threshold: Points a cluster had to have.
        steps: (N,) uint8 `Step` of every point given to the chain.
        details: (N,) the cluster of what was dropped with it, the tilt in degrees of what does not face sideways.
        joined_from: (8,) how many of the points that joined a trunk each `Step` had dropped before.
    """

    labels: Int32
    stems: tuple[Stem | None, ...]
    clusters: tuple[Cluster, ...]
    size_threshold: float
    steps: UInt8
    details: Int32
    joined_from: Int64


class Chain:
    """One run of the chain over levelled points (x, y, height above ground)."""

    def __init__(
        self,
        levelled: Float32,
        stems: tuple[Stem, ...],
        spacing_m: float,
        settings: TrunkSettings,
        progress: Progress,
        seed: int,
    ) -> None:
        self.stems, self.settings, self.progress = stems, settings, progress
        self.fine: Thinned = thin(levelled, settings.thinning_m)
        self.models: StemModels | None = None
        if stems and len(self.fine):
            # A circle needs no more than some points per layer, so on large plots only a part is looked at.
            every = max(1, round(len(self.fine) / _MAX_TRACKED))
            self.models = follow_stems(
                self.fine.points[::every],
                stems,
                spacing_m=spacing_m,
                settings=settings,
                progress=subprogress(progress, 0.0, 0.4),
                seed=seed,
            )
        # On sparse clouds the neighbourhoods grow with the spacing, or no point would have neighbours.
        self.reach = max(settings.cluster_distance_m, 2.5 * spacing_m)
        self.normal_radius = max(settings.normal_radius_m, 3.0 * spacing_m)
        self.expand = max(settings.expand_distance_m, 1.5 * spacing_m) if settings.expand_distance_m > 0 else 0.0
        self._kept = np.empty((0, 3), np.float32)
        self._kept_labels = np.empty(0, np.int32)

    def kept_points(self) -> tuple[Float32, Int32]:
        """Thinned points of all trunks and the trunk of each, once the chain has run."""
        return self._kept, self._kept_labels

    def of_stems(self) -> Outcome:
        """Candidates are the points on the surface of a detected stem."""
        if self.models is None:
            return self._nothing()
        owner, distance = self.models.owner(self.fine.points)
        return self._run(owner, distance <= 1.0, owner >= 0)

    def of_masks(self) -> Outcome:
        """Candidates are all points given; detected stems only tell stems that touch apart."""
        if not len(self.fine):
            return self._nothing()
        owner = np.full(len(self.fine), -1, np.int32)
        if self.models is not None:
            owner = self.models.owner(self.fine.points)[0]
        everything = np.ones(len(self.fine), bool)
        return self._run(owner, everything, everything)

    def _nothing(self) -> Outcome:
        n = len(self.fine.order)
        no_label, no_step = np.full(n, -1, np.int32), np.full(n, Step.NO_CANDIDATE, np.uint8)
        return Outcome(no_label, (), (), float("nan"), no_step, np.zeros(n, np.int32), np.zeros(len(Step), np.int64))

    def _run(self, owner: Int32, is_candidate: Bool, may_join: Bool) -> Outcome:
        rows = np.flatnonzero(is_candidate)
        weight = self.fine.counts[rows].astype(np.float64)
        coarse, coarse_weight = self._coarse(rows, weight)
        cluster, tilt_deg = self._clustered(coarse, coarse_weight)
        unit, unit_stem = _split_by_stem(cluster, _majority(owner[rows], coarse), len(self.stems))
        size = np.bincount(unit[unit >= 0], coarse_weight[unit >= 0], len(unit_stem)).astype(np.float64)
        has_rings = self._rings_in(unit, unit_stem, coarse)
        kept, threshold = keep_clusters(size, has_rings, self.settings)
        trunk_of_unit, stems = _trunks(unit_stem, kept, size, self.stems)
        label = np.full(len(coarse), -1, np.int32)
        label[unit >= 0] = trunk_of_unit[unit[unit >= 0]]
        fine_label = np.full(len(self.fine), -1, np.int32)
        fine_label[rows] = coarse.labels_of_points(label)
        order = np.argsort(-size, kind="stable")
        steps, details = self._steps(rows, coarse, tilt_deg, unit, kept, order)
        self.progress(0.9, "Collecting the trunks' points")
        fine_label = self._expanded(fine_label, owner, may_join, trunk_of_unit, unit_stem)
        joined = np.flatnonzero((fine_label >= 0) & (steps != Step.KEPT))
        joined_from = np.bincount(steps[joined], self.fine.counts[joined], len(Step)).astype(np.int64)
        steps[joined] = Step.JOINED
        places = self._places(rows, coarse, unit, len(unit_stem))
        clusters = [
            Cluster(int(size[k]), int(trunk_of_unit[k]), bool(has_rings[k]), bool(kept[k]), *places[k]) for k in order
        ]
        back = self.fine.labels_of_points
        return Outcome(back(fine_label), stems, tuple(clusters), threshold, back(steps), back(details), joined_from)

    def _steps(
        self, rows: Int64, coarse: Thinned, tilt_deg: UInt8, unit: Int32, kept: Bool, order: Int64
    ) -> tuple[UInt8, Int32]:
        """(F,) step of every thinned point before the expansion, and (F,) its `Outcome.details`."""
        step, detail = np.full(len(coarse), Step.LOOSE, np.uint8), np.zeros(len(coarse), np.int32)
        tilted = tilt_deg > 0
        step[tilted], detail[tilted] = Step.NOT_SIDEWAYS, tilt_deg[tilted]
        inside = np.flatnonzero(unit >= 0)
        step[inside] = np.where(kept[unit[inside]], Step.KEPT, Step.DROPPED)
        rank = np.empty(len(order), np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        detail[inside] = rank[unit[inside]]
        steps, details = np.full(len(self.fine), Step.NO_CANDIDATE, np.uint8), np.zeros(len(self.fine), np.int32)
        if len(rows):
            steps[rows], details[rows] = coarse.labels_of_points(step), coarse.labels_of_points(detail)
        return steps, details

    def _places(self, rows: Int64, coarse: Thinned, unit: Int32, n_units: int) -> list[tuple[int, float, float, float]]:
        """Per part of a cluster a row given to the chain in its middle, its width, and its lowest and highest point."""
        if not n_units:
            return []
        inside = np.flatnonzero(unit >= 0)
        inside = inside[np.argsort(unit[inside], kind="stable")]
        starts = np.searchsorted(unit[inside], np.arange(n_units))
        points = coarse.points[inside].astype(np.float64)
        lower, upper = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
        middle = np.add.reduceat(points, starts) / np.diff(starts, append=len(inside))[:, None]
        off = np.sqrt(((points - middle[unit[inside]]) ** 2).sum(axis=1))
        nearest = inside[np.lexsort((off, unit[inside]))[starts]]
        row = self.fine.order[self.fine.starts[rows[coarse.order[coarse.starts[nearest]]]]]
        width = _widths(unit[inside], points)
        return [(int(row[k]), float(width[k]), float(lower[k, 2]), float(upper[k, 2])) for k in range(n_units)]

    def _clustered(self, coarse: Thinned, weight: Float64) -> tuple[Int32, UInt8]:
        """(M,) DBSCAN cluster of every point that faces sideways, and (M,) tilt in degrees of what does not, else 0."""
        self.progress(0.45, "Looking which way surfaces face")
        normals = surface_normals(
            coarse.points,
            radius=max(self.normal_radius, 2.5 * coarse.edge_m),
            max_neighbours=20,
            progress=subprogress(self.progress, 0.45, 0.7),
        )[0]
        up = np.abs(normals[:, 2])
        sideways = up <= np.sin(np.radians(self.settings.normal_max_deg))
        self.progress(0.7, "Clustering")
        cluster = np.full(len(coarse), NOISE, np.int32)
        cluster[sideways] = dbscan(
            coarse.points[sideways],
            distance=max(self.reach, 2.0 * coarse.edge_m),
            min_points=self.settings.cluster_min_points,
            weights=weight[sideways],
        )
        tilt_deg = np.where(np.isnan(up), NO_NORMAL, np.ceil(np.degrees(np.arcsin(np.minimum(up, 1.0)))))
        return cluster, np.where(sideways, 0, tilt_deg).astype(np.uint8)

    def _coarse(self, rows: np.ndarray, weight: Float64) -> tuple[Thinned, Float64]:
        """The candidates thinned to what the cluster distance needs, and how many cloud points each stands for."""
        edge = max(self.settings.thinning_m, self.settings.cluster_distance_m / 2.5)
        points = self.fine.points[rows]
        coarse = thin(points, edge)
        while len(coarse) > _MAX_POINTS:
            edge *= 1.3
            coarse = thin(points, edge)
        if not len(coarse):
            return coarse, np.empty(0)
        return coarse, np.add.reduceat(weight[coarse.order], coarse.starts)

    def _rings_in(self, unit: Int32, unit_stem: Int32, coarse: Thinned) -> Bool:
        """(U,) whether a cluster lies where its stem's rings were seen, in at least half of its layers."""
        has_rings = np.zeros(len(unit_stem), bool)
        if self.models is None:
            return has_rings
        inside = unit >= 0
        layer = self.models.layer_of(coarse.points[inside, 2])
        of_unit, layer = _unique_pairs(unit[inside], layer, self.models.seen.shape[1])
        stem = unit_stem[of_unit]
        seen = (stem >= 0) & self.models.seen[stem, layer]
        n_layers = np.bincount(of_unit, minlength=len(unit_stem))
        n_seen = np.bincount(of_unit, seen, len(unit_stem))
        return np.asarray((n_seen > 0) & (2 * n_seen >= n_layers))

    def _expanded(self, label: Int32, owner: Int32, may_join: Bool, trunk_of_unit: Int32, unit_stem: Int32) -> Int32:
        """Points that may join and are near a trunk's points do, but not across to another stem."""
        core = np.flatnonzero(label >= 0)
        self._kept, self._kept_labels = self.fine.points[core], label[core]
        rest = np.flatnonzero((label < 0) & may_join)
        if not len(core) or not len(rest) or self.expand == 0:
            return label
        # Neither balanced nor compact: built in half the time, and as quick to search.
        tree = cKDTree(self._kept, balanced_tree=False, compact_nodes=False)
        distance, nearest = tree.query(self.fine.points[rest], distance_upper_bound=self.expand, workers=N_WORKERS)
        near = np.isfinite(distance)
        joined, trunk = rest[near], self._kept_labels[nearest[near]]
        trunk_of_stem = np.full(len(self.stems) + 1, -1, np.int32)
        trunk_of_stem[unit_stem[trunk_of_unit >= 0]] = trunk_of_unit[trunk_of_unit >= 0]
        trunk_of_stem[-1] = -1
        own = trunk_of_stem[owner[joined]]
        expanded = label.copy()
        fits = (own == trunk) | (own < 0)
        expanded[joined[fits]] = trunk[fits]
        self._kept = self.fine.points[expanded >= 0]
        self._kept_labels = expanded[expanded >= 0]
        return expanded


def _widths(unit: Int32, points: Float64) -> Float64:
    """(U,) width of every unit: of its layers' larger extents in plan the median, so that leaning does not count."""
    layer = np.floor(points[:, 2] / _WIDTH_LAYER_M).astype(np.int64)
    order = np.lexsort((layer, unit))
    unit, layer, points = unit[order], layer[order], points[order]
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(unit) != 0) | (np.diff(layer) != 0)]))
    across = np.maximum.reduceat(points, starts) - np.minimum.reduceat(points, starts)
    extent, of_unit = across[:, :2].max(axis=1), unit[starts]
    ranked = np.lexsort((extent, of_unit))
    first = np.searchsorted(of_unit, np.arange(of_unit[-1] + 1))
    return np.asarray(extent[ranked[first + np.diff(first, append=len(of_unit)) // 2]], np.float64)


def _majority(owner: Int32, coarse: Thinned) -> Int32:
    """(M,) the owner of the middle one of each cube's points, sorted by owner: nearly always of most of them."""
    if not len(coarse):
        return np.empty(0, np.int32)
    ordered = owner[coarse.order].astype(np.int64)
    n_owners = int(ordered.max()) + 2
    # One number for cube and owner: sorting it sorts the owners within each cube.
    ranked = np.sort(np.repeat(np.arange(len(coarse)), coarse.counts) * n_owners + ordered + 1)
    return np.asarray(ranked[coarse.starts + coarse.counts // 2] % n_owners - 1, np.int32)


def _split_by_stem(cluster: Int32, owner: Int32, n_stems: int) -> tuple[Int32, Int32]:
    """Clusters cut into one part per stem.

    What is on no stem's surface goes with the stem if its cluster holds just one, and stays on its own otherwise.

    Returns:
        (M,) part of every point, `NOISE` where none; (U,) the stem of each part, -1 where none.
    """
    inside = cluster >= 0
    owned = inside & (owner >= 0)
    of_cluster, of_stem = _unique_pairs(cluster[owned], owner[owned], n_stems)
    n_clusters = int(cluster.max(initial=-1)) + 1
    alone = np.bincount(of_cluster, minlength=n_clusters)[of_cluster] == 1
    only = np.full(n_clusters, -1, np.int64)
    only[of_cluster[alone]] = of_stem[alone]
    stem = owner.astype(np.int64)
    loose = inside & (owner < 0)
    stem[loose] = only[cluster[loose]]
    key = cluster[inside].astype(np.int64) * (n_stems + 1) + stem[inside] + 1
    parts, inverse = np.unique(key, return_inverse=True)
    unit = np.full(len(cluster), NOISE, np.int32)
    unit[inside] = inverse
    return unit, (parts % (n_stems + 1) - 1).astype(np.int32)


def _unique_pairs(first: Int32, second: NDArray[Any], n_second: int) -> tuple[Int64, Int64]:
    """(P,), (P,) the different pairs of (N,) numbers of which the second are below `n_second`; as one number each."""
    pairs = np.unique(first.astype(np.int64) * max(n_second, 1) + second)
    return pairs // max(n_second, 1), pairs % max(n_second, 1)


def _trunks(
    unit_stem: Int32, kept: Bool, size: Float64, stems: tuple[Stem, ...]
) -> tuple[Int32, tuple[Stem | None, ...]]:
    """(U,) trunk of every part, -1 where dropped; parts of one stem make one trunk, parts of none one each."""
    trunk = np.full(len(unit_stem), -1, np.int32)
    present = np.unique(unit_stem[kept & (unit_stem >= 0)])
    for number, stem in enumerate(present):
        trunk[kept & (unit_stem == stem)] = number
    alone = np.flatnonzero(kept & (unit_stem < 0))
    trunk[alone] = len(present) + np.arange(len(alone), dtype=np.int32)
    return trunk, (*(stems[k] for k in present), *([None] * len(alone)))
