"""The paper's chain on the candidates: normals, DBSCAN, cluster sizes, expansion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float32, Float64, Int32, Int64
from dbh_studio.core.clusters import NOISE, dbscan
from dbh_studio.core.neighbours import N_WORKERS, surface_normals
from dbh_studio.core.otsu import otsu_threshold
from dbh_studio.core.progress import Progress, subprogress
from dbh_studio.core.voxels import Thinned, thin
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.stem_detection import Stem
from dbh_studio.stages.stem_tracking import StemModels, follow_stems

# So many thinned points go through normals and DBSCAN at most; more are thinned further.
_MAX_POINTS = 500_000
_MAX_TRACKED = 1_000_000


@dataclass(frozen=True)
class Cluster:
    """One DBSCAN cluster.

    Attributes:
        n_points: Of the full cloud.
        stem: Index of the trunk it belongs to, -1 where none.
        has_rings: Whether the detector saw stacked rings in it.
        kept: Whether it is part of a trunk.
    """

    n_points: int
    stem: int
    has_rings: bool
    kept: bool


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the chain made of the candidates.

    Attributes:
        labels: (N,) trunk of every point given to the chain, -1 where none.
        stems: Per trunk what the detector saw of it, or None.
        clusters: Largest first.
        size_threshold: Otsu's, points.
        n_candidates: Points on a stem's surface or in a mask.
        n_facing_sideways: Of these, with a normal near the horizontal.
    """

    labels: Int32
    stems: tuple[Stem | None, ...]
    clusters: tuple[Cluster, ...]
    size_threshold: float
    n_candidates: int
    n_facing_sideways: int


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
        return Outcome(np.full(len(self.fine.order), -1, np.int32), (), (), float("nan"), 0, 0)

    def _run(self, owner: Int32, is_candidate: Bool, may_join: Bool) -> Outcome:
        rows = np.flatnonzero(is_candidate)
        weight = self.fine.counts[rows].astype(np.float64)
        coarse, coarse_weight = self._coarse(rows, weight)
        cluster, n_sideways = self._clustered(coarse, coarse_weight)
        unit, unit_stem = _split_by_stem(cluster, _majority(owner[rows], coarse), len(self.stems))
        size = np.bincount(unit[unit >= 0], coarse_weight[unit >= 0], len(unit_stem)).astype(np.float64)
        has_rings = self._rings_in(unit, unit_stem, coarse)
        kept, threshold = keep_clusters(size, has_rings, self.settings.small_clusters)
        trunk_of_unit, stems = _trunks(unit_stem, kept, size, self.stems)
        label = np.full(len(coarse), -1, np.int32)
        label[unit >= 0] = trunk_of_unit[unit[unit >= 0]]
        fine_label = np.full(len(self.fine), -1, np.int32)
        fine_label[rows] = coarse.labels_of_points(label)
        self.progress(0.9, "Collecting the trunks' points")
        fine_label = self._expanded(fine_label, owner, may_join, trunk_of_unit, unit_stem)
        clusters = [
            Cluster(int(size[k]), int(trunk_of_unit[k]), bool(has_rings[k]), bool(kept[k])) for k in np.argsort(-size)
        ]
        return Outcome(
            self.fine.labels_of_points(fine_label), stems, tuple(clusters), threshold, int(weight.sum()), n_sideways
        )

    def _clustered(self, coarse: Thinned, weight: Float64) -> tuple[Int32, int]:
        """(M,) DBSCAN cluster of every point that faces sideways, and how many cloud points those are."""
        self.progress(0.45, "Looking which way surfaces face")
        normals = surface_normals(
            coarse.points,
            radius=max(self.normal_radius, 2.5 * coarse.edge_m),
            max_neighbours=20,
            progress=subprogress(self.progress, 0.45, 0.7),
        )[0]
        sideways = np.abs(normals[:, 2]) <= np.sin(np.radians(self.settings.normal_max_deg))
        self.progress(0.7, "Clustering")
        cluster = np.full(len(coarse), NOISE, np.int32)
        cluster[sideways] = dbscan(
            coarse.points[sideways],
            distance=max(self.reach, 2.0 * coarse.edge_m),
            min_points=self.settings.cluster_min_points,
            weights=weight[sideways],
        )
        return cluster, int(weight[sideways].sum())

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


def keep_clusters(size: Float64, has_rings: Bool, rule: str) -> tuple[Bool, float]:
    """Which clusters are trunks.

    Otsu's threshold always splits: among stems only it drops the smaller ones. So by default (``evidence``) what has
    rings stays whatever its size, and the threshold, on the logarithm of size because fragments and stems differ by
    orders of magnitude, only judges the rest.

    Args:
        size: (U,) points per cluster.
        has_rings: (U,) whether the detector saw stacked rings in it.
        rule: ``evidence``, ``otsu`` (the paper: size alone) or ``keep``.

    Returns:
        (U,) which to keep, and the threshold in points (NaN where none was needed).
    """
    if not len(size) or rule == "keep":
        return np.ones(len(size), bool), float("nan")
    if rule == "otsu":
        threshold = otsu_threshold(size)
    else:
        threshold = float(np.exp(otsu_threshold(np.log(np.maximum(size, 1.0)))))
        # exp(log(x)) may be a hair above x.
        threshold *= 1.0 - 1e-9
    large = size >= threshold
    return (large if rule == "otsu" else large | has_rings), threshold


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
