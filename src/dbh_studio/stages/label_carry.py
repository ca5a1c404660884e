"""Labels from one cloud to another that is laid on it: by the nearest neighbour, as in the paper, then tidied up.

`carry_labels` gives labels to points, `carried_trunks` makes trunks of them under the same ids.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float64, Int32, as_points, readonly
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.neighbours import N_WORKERS
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.transforms import Similarity
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.segment import segment_trunks

_CHUNK = 1 << 20
# A trunk of which the chain keeps fewer than this share of the points carried was torn apart by it.
_LEAST_KEPT = 0.2


@dataclass(frozen=True, eq=False)
class CarriedLabels:
    """Labels of the target's points.

    Attributes:
        labels: (M,) int32, 0 where no trunk is near.
        trunk_ids: The labels that arrived, ascending.
        lost: Labels of the source that no point of the target lies near to.
    """

    labels: Int32
    trunk_ids: tuple[int, ...]
    lost: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class CarriedTrunks:
    """Trunks of the target cloud, under the source's ids.

    Attributes:
        point_sets: Per id the sorted rows of the target; disjoint.
        n_carried: Per id the points that came over, before the chain tidied them up.
        as_carried: Ids of which the chain made nothing, so that they are as they came over.
    """

    point_sets: Mapping[int, Int32]
    n_carried: Mapping[int, int] = field(default_factory=dict)
    as_carried: tuple[int, ...] = ()


def carry_labels(
    source_points: Float,
    source_labels: Int32,
    target_points: Float,
    target_from_source: Similarity,
    *,
    reach_m: float = 0.2,
    progress: Progress = ignore_progress,
) -> CarriedLabels:
    """Each point of the target takes the label of the nearest labelled point of the source.

    Args:
        source_points: (N, 3)
        source_labels: (N,) 0 none, above 0 the trunk.
        target_points: (M, 3) metres.
        target_from_source: See `Alignment`.
        reach_m: Not from farther away; the paper's is 0.2.
        progress: Called between chunks.

    Raises:
        ValueError: Wrong shapes.
    """
    source, target = as_points(source_points, name="source_points"), as_points(target_points, name="target_points")
    given = np.asarray(source_labels, np.int32)
    if given.shape != (len(source),):
        raise ValueError(f"source_labels have shape {given.shape} but ({len(source)},) is needed")
    labels = np.zeros(len(target), np.int32)
    trunk_rows = np.flatnonzero(given > 0)
    ids = tuple(int(name) for name in np.unique(given[trunk_rows]))
    if not len(trunk_rows) or not len(target):
        return CarriedLabels(readonly(labels), (), ids)
    trunks = _placed(source[trunk_rows], target_from_source)
    tree = cKDTree(trunks)
    lower, upper = trunks.min(axis=0) - reach_m, trunks.max(axis=0) + reach_m
    for start in range(0, len(target), _CHUNK):
        progress(start / len(target), "Carrying the labels")
        part = target[start : start + _CHUNK]
        rows = np.flatnonzero(((part >= lower) & (part <= upper)).all(axis=1))
        distance, nearest = tree.query(part[rows], distance_upper_bound=reach_m, workers=N_WORKERS)
        near = np.isfinite(distance)
        labels[start + rows[near]] = given[trunk_rows[nearest[near]]]
    arrived = tuple(int(name) for name in np.unique(labels) if name)
    return CarriedLabels(readonly(labels), arrived, tuple(name for name in ids if name not in arrived))


def carried_trunks(
    target_points: Float,
    ground: GroundModel,
    carried: CarriedLabels,
    *,
    settings: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
    progress: Progress = ignore_progress,
) -> CarriedTrunks:
    """Trunks of the points that carry a label: the paper's chain tidies them up, and each keeps its id.

    The chain takes away ground and leaves within reach of a trunk, and adds bark beyond it. Where it makes nothing of
    an id, or next to nothing, the points stay as they came over.
    """
    result = segment_trunks(
        target_points, ground, settings=settings, candidates=np.asarray(carried.labels > 0), progress=progress
    )
    tidied = np.zeros(len(carried.labels), np.int32)
    for rows in result.point_sets:
        came = carried.labels[rows]
        names, counts = np.unique(came[came > 0], return_counts=True)
        # Expansion adds points without a label, which are of the trunk that most of the others are of. A label that
        # came over stays: of two stems that touch, the chain may make one.
        if len(names):
            tidied[rows] = np.where(came > 0, came, names[counts.argmax()])
    n_carried = {name: len(rows) for name, rows in _rows_by_label(carried.labels).items()}
    as_carried = []
    for name in carried.trunk_ids:
        if (tidied == name).sum() < _LEAST_KEPT * n_carried[name]:
            free = np.flatnonzero((carried.labels == name) & (tidied == 0))
            free = free[_is_at_trunk_height(target_points[free], ground, settings)]
            tidied[free] = name
            as_carried.append(name)
    point_sets = _rows_by_label(tidied)
    return CarriedTrunks(point_sets, n_carried, tuple(name for name in as_carried if name in point_sets))


def share_covered(
    source_points: Float,
    target_points: Float,
    carried: CarriedLabels,
    target_from_source: Similarity,
    *,
    reach_m: float = 0.2,
    most: int = 20_000,
) -> float:
    """Share of the source's trunk points that have a point of the target within reach: near 0 where clouds lie apart.

    Args:
        source_points: (N, 3) of trunks.
        target_points: (M, 3)
        carried: From `carry_labels` with this reach: only points with a label can be in reach.
        target_from_source: As given there.
        reach_m: Likewise.
        most: So many of the source's points are asked.
    """
    near = target_points[carried.labels > 0]
    if not len(near) or not len(source_points):
        return 0.0
    sample = _placed(source_points[:: max(1, len(source_points) // most)], target_from_source)
    distance = cKDTree(near).query(sample, distance_upper_bound=reach_m, workers=N_WORKERS)[0]
    return float(np.isfinite(distance).mean())


def _rows_by_label(labels: Int32) -> dict[int, Int32]:
    """Rows of each label above 0, ascending."""
    rows = np.flatnonzero(labels)
    order = rows[np.argsort(labels[rows], kind="stable")]
    names, starts = np.unique(labels[order], return_index=True)
    parts = np.split(order.astype(np.int32), starts[1:])
    return {int(name): readonly(part) for name, part in zip(names, parts, strict=False)}


def _is_at_trunk_height(points: Float, ground: GroundModel, settings: TrunkSettings) -> Bool:
    height = ground.height_above(points) if len(points) else np.empty(0)
    return np.asarray((height >= settings.ground_clearance_m) & (height < settings.trunk_top_m))


def _placed(points: Float, target_from_source: Similarity) -> Float64:
    return np.asarray(target_from_source.apply(points.astype(np.float64)), np.float64)
