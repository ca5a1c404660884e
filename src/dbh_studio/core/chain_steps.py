"""What the search for trunks did with every point and every cluster: where a tree was lost.

    candidates   points in a mask, or on the surface of a stem that geometry detects
    heights      neither below the ground clearance nor above the trunk top
    normals      the surface faces sideways
    clusters     DBSCAN
    sizes        large enough, or a stem by its rings
    expansion    what is near a trunk joins it, wherever it was dropped

One byte per point says which step dropped it; what more there is to say is kept for the few it concerns.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int32, Int64, UInt8
from dbh_studio.core.otsu import otsu_threshold
from dbh_studio.settings import TrunkSettings

# In place of a tilt: so few neighbours that the surface faces nowhere.
NO_NORMAL = 255
_CHUNK = 1 << 20


class Step(IntEnum):
    """What became of a point: the step that dropped it, or how it came to a trunk."""

    NO_CANDIDATE = 0
    TOO_LOW = 1
    TOO_HIGH = 2
    NOT_SIDEWAYS = 3
    LOOSE = 4
    DROPPED = 5
    KEPT = 6
    JOINED = 7


@dataclass(frozen=True)
class Cluster:
    """One DBSCAN cluster, or the part of one that belongs to one stem.

    Attributes:
        n_points: Of the full cloud.
        stem: Index of the trunk it belongs to, -1 where none.
        has_rings: Whether the detector saw stacked rings in it.
        kept: Whether it is part of a trunk.
        point: Row in the cloud of one point in its middle; -1 where not known.
        width_m: Its larger extent in plan, half a metre of height at a time: the median.
        low_m: Its lowest point above ground.
        high_m: Its highest.
    """

    n_points: int
    stem: int
    has_rings: bool
    kept: bool
    point: int = -1
    width_m: float = float("nan")
    low_m: float = float("nan")
    high_m: float = float("nan")


@dataclass(frozen=True)
class NearMiss:
    """Where the detector saw rings stack up but did not believe in a stem.

    Attributes:
        x_m: World.
        y_m: World.
        low_m: Lowest ring, above ground.
        high_m: Highest ring.
        diameter_m: Of the rings, their median.
        span_m: Heights over which they stack up.
        coverage_deg: Mean arc seen.
        n_layers: Layers with a ring.
        reasons: Names of the settings whose values speak against it.
    """

    x_m: float
    y_m: float
    low_m: float
    high_m: float
    diameter_m: float
    span_m: float
    coverage_deg: float
    n_layers: int
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ChainSteps:
    """One search for trunks, step by step.

    Attributes:
        labels: (N,) uint8 `Step` of every point of the cloud.
        dropped_cluster: (D,) of the points that are `Step.DROPPED`, in the cloud's order, the index into `clusters`.
        tilt_deg: (S,) uint8 of those that are `Step.NOT_SIDEWAYS`, how far the surface's normal is from horizontal,
            rounded up; `NO_NORMAL` where it has none.
        joined_from: (8,) how many of the joined points each `Step` had dropped before.
        clusters: Largest first.
        size_threshold: Points a cluster had to have; NaN where none was asked.
        settings: Of the search.
        from_masks: Whether masks of photos named the candidates.
        n_stems_detected: By the rings.
        spacing_m: Typical distance between points on a surface.
        near_misses: What was nearly a stem, from west to east; none where masks named the candidates.
    """

    labels: UInt8
    dropped_cluster: Int32
    tilt_deg: UInt8
    joined_from: tuple[int, ...]
    clusters: tuple[Cluster, ...]
    size_threshold: float
    settings: TrunkSettings
    from_masks: bool
    n_stems_detected: int = 0
    spacing_m: float = float("nan")
    near_misses: tuple[NearMiss, ...] = field(default=())

    @property
    def n_points(self) -> int:
        """Of the cloud."""
        return len(self.labels)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """(8,) points of each `Step`; together all of the cloud."""
        total = np.zeros(len(Step), np.int64)
        # In pieces: counting widens every label to eight bytes.
        for start in range(0, len(self.labels), _CHUNK):
            total += np.bincount(self.labels[start : start + _CHUNK], minlength=len(Step))
        return tuple(int(n) for n in total)

    def n_before_expansion(self, step: Step) -> int:
        """Points that were of this step before points near a trunk joined it."""
        return self.counts[step] + self.joined_from[step]

    @property
    def n_candidates(self) -> int:
        """Points on a stem's surface, or in a mask."""
        outside = self.n_before_expansion(Step.TOO_LOW) + self.n_before_expansion(Step.TOO_HIGH)
        return self.n_above_ground + (outside if self.from_masks else 0)

    @property
    def n_above_ground(self) -> int:
        """Of these, between ground clearance and trunk top."""
        return self.n_before_expansion(Step.NOT_SIDEWAYS) + self.n_facing_sideways

    @property
    def n_facing_sideways(self) -> int:
        """Of these, with a normal within the largest tilt of horizontal."""
        return self.n_before_expansion(Step.LOOSE) + self.n_clustered

    @property
    def n_clustered(self) -> int:
        """Of these, in a cluster."""
        return self.n_before_expansion(Step.DROPPED) + self.n_in_clusters

    @property
    def n_in_clusters(self) -> int:
        """Of these, in a cluster that was kept."""
        return self.n_before_expansion(Step.KEPT)

    @property
    def n_expanded(self) -> int:
        """Points of all trunks in the end."""
        return self.counts[Step.KEPT] + self.counts[Step.JOINED]

    @property
    def dropped(self) -> tuple[int, ...]:
        """Indices of the clusters that were dropped, largest first."""
        return tuple(k for k, cluster in enumerate(self.clusters) if not cluster.kept)

    def cluster_of(self, point: int) -> int | None:
        """Index of the dropped cluster a point of the cloud is in; None where it is in none."""
        return _at(self.labels, Step.DROPPED, self.dropped_cluster, point)

    def tilt_of(self, point: int) -> int | None:
        """Degrees by which the surface at a point was too far from upright, `NO_NORMAL`, or None where it was not."""
        return _at(self.labels, Step.NOT_SIDEWAYS, self.tilt_deg, point)

    def points_of_cluster(self, cluster: int) -> Int64:
        """Rows in the cloud of a dropped cluster; without those that joined a trunk."""
        rows: Int64 = np.flatnonzero(self.labels == Step.DROPPED)[self.dropped_cluster == cluster]
        return rows


def _at(labels: UInt8, step: Step, values: Int32 | UInt8, point: int) -> int | None:
    """The value of one point from those kept for the points of one step only."""
    if not 0 <= point < len(labels) or labels[point] != step:
        return None
    return int(values[np.count_nonzero(labels[:point] == step)])


def keep_clusters(size: Float64, has_rings: Bool, settings: TrunkSettings) -> tuple[Bool, float]:
    """Which clusters are trunks.

    Otsu's threshold always splits: among stems only it drops the smaller ones. So by default (``evidence``) what has
    rings stays whatever its size, and the threshold, on the logarithm of size because fragments and stems differ by
    orders of magnitude, only judges the rest.

    Args:
        size: (U,) points per cluster.
        has_rings: (U,) whether the detector saw stacked rings in it.
        settings: `small_clusters` is ``evidence``, ``otsu`` (the paper: size alone) or ``keep``;
            `smallest_cluster_points` takes the threshold's place where it is not 0.

    Returns:
        (U,) which to keep, and the threshold in points (NaN where none was needed).
    """
    rule = settings.small_clusters
    if not len(size) or rule == "keep":
        return np.ones(len(size), bool), float("nan")
    if settings.smallest_cluster_points:
        threshold = float(settings.smallest_cluster_points)
    elif rule == "otsu":
        threshold = otsu_threshold(size)
    else:
        threshold = float(np.exp(otsu_threshold(np.log(np.maximum(size, 1.0)))))
        # exp(log(x)) may be a hair above x.
        threshold *= 1.0 - 1e-9
    large = size >= threshold
    return (large if rule == "otsu" else large | has_rings), threshold
