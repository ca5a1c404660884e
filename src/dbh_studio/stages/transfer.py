"""Trunks from one cloud to another of the same plot: from photogrammetry to LiDAR, as in the paper, or back.

    photo, lidar = survey(points_a, ground_a), survey(points_b, ground_b)
    alignment = align_by_stems(photo, lidar)            or align_by_trajectories, align_by_pairs, align_as_given
    if not alignment: ...                               a Refusal says why and what to do
    carried = carry_labels(points_a, labels, points_b, alignment.target_from_source)
    trunks = carried_trunks(points_b, ground_b, carried)

Both clouds are upright in frames of their own; the source may have a unit of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32, Int64, as_points, readonly
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.neighbours import N_WORKERS
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.registration import refine
from dbh_studio.core.similarity_fit import fit_similarity
from dbh_studio.core.stem_match import StemMatch, match_stems
from dbh_studio.core.trajectories import Trajectory, fit_trajectories
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.voxels import thin
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.segment import SegmentationResult, segment_trunks

_CHUNK = 1 << 20
_GROUND_M = 0.15
_FIRM_EDGE_M = 0.08
_MOST_FIRM = 60_000
_PAIRS_REMEDY = "Pick three or more pairs of points that are the same in both clouds, far apart and not in one line."


@dataclass(frozen=True, eq=False)
class Survey:
    """What alignment needs of a cloud.

    Attributes:
        xy_m: (S, 2) stems at breast height.
        radius_m: (S,)
        base_m: (S,) height of the ground under them.
        firm: (K, 3) points of stems and ground, which do not move in the wind, thinned.
    """

    xy_m: Float64
    radius_m: Float64
    base_m: Float64
    firm: Float64

    def scaled(self, scale: float) -> Survey:
        """The same in another unit."""
        return Survey(*(scale * part for part in (self.xy_m, self.radius_m, self.base_m, self.firm)))


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a cloud lies on another. Truthy, so that ``if alignment:`` tells it from a `Refusal`.

    Attributes:
        target_from_source: Brings source points to the target.
        method: ``given``, ``picked``, ``stems`` or ``trajectories``.
        n_pairs: Pairs of points, stems or poses it rests on; 0 where it was given.
        rms_m: Of these pairs; NaN where it was given.
        surface_rms_m: Of stems and ground after refinement; NaN where it was not refined.
        share_near: Share of the source's stems and ground that has the target's beside it; NaN likewise.
        stem_pairs: (P, 2) rows of the two surveys that are the same stem.
        notes: What the person should know.
    """

    target_from_source: Similarity
    method: Literal["given", "picked", "stems", "trajectories"]
    n_pairs: int = 0
    rms_m: float = float("nan")
    surface_rms_m: float = float("nan")
    share_near: float = float("nan")
    stem_pairs: Int64 | None = None
    notes: tuple[str, ...] = ()


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
    """Trunks of the target cloud.

    Attributes:
        result: Of the paper's chain on the points that carry a label.
        source_ids: Per trunk of `result` the label of the source it is; 0 where most of it has none.
    """

    result: SegmentationResult
    source_ids: tuple[int, ...]


def survey(
    points: Float,
    ground: GroundModel,
    *,
    settings: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
    result: SegmentationResult | None = None,
    progress: Progress = ignore_progress,
) -> Survey:
    """The stems and the firm surfaces of a cloud.

    Args:
        points: (N, 3) metres as far as they are known, +z up. The detector needs diameters that are about right.
        ground: Of these points.
        settings: Of the detector.
        result: Of `segment_trunks` on these points, where there is one; else it is run.
        progress: Called in between.
    """
    cloud = as_points(points, name="points")
    found = result or segment_trunks(cloud, ground, settings=settings, progress=subprogress(progress, 0.0, 0.8))
    stems = [(stem, rows) for stem, rows in zip(found.stems, found.point_sets, strict=True) if stem is not None]
    xy = np.array([stem.xy_at(1.3) for stem, _ in stems], np.float64).reshape(-1, 2)
    radius = np.array([stem.radius_m for stem, _ in stems], np.float64)
    progress(0.9, "Gathering stems and ground")
    firm = [_thinned(cloud[rows]) for _, rows in stems] + [_ground_points(cloud, ground)]
    gathered = np.concatenate(firm)
    kept = np.random.default_rng(0).permutation(len(gathered))[:_MOST_FIRM]
    return Survey(xy, radius, ground.z_at(xy) if len(xy) else np.empty(0), gathered[kept])


def align_by_stems(
    source: Survey,
    target: Survey,
    *,
    scale: float | None = 1.0,
    tolerance_m: float = 0.4,
    with_refinement: bool = True,
    progress: Progress = ignore_progress,
) -> Alignment | Refusal:
    """Lay the stems of one cloud on those of the other, then stems and ground on each other.

    Args:
        source: Of the cloud with the labels.
        target: Of the other, metres.
        scale: Metres per unit of the source; None where it is unknown, and is then found too.
        tolerance_m: Stems so near to each other may be the same.
        with_refinement: Whether surfaces are fitted afterwards.
        progress: Called in between.

    Returns:
        The alignment; a refusal where too few stems are common, or they fit in more ways than one.
    """
    match = match_stems(
        source.xy_m,
        target.xy_m,
        source_radius=source.radius_m,
        target_radius=target.radius_m,
        scale=scale,
        tolerance_m=tolerance_m,
    )
    if match is None:
        n = f"{len(source.xy_m)} and {len(target.xy_m)} stems were found in the two clouds"
        return Refusal("too_few_stems", f"The clouds cannot be aligned by their stems: {n}.", _PAIRS_REMEDY)
    if not match:
        return Refusal("ambiguous", f"The clouds cannot be aligned by their stems: {match.reason}.", _PAIRS_REMEDY)
    alignment = Alignment(
        _upright(match, source, target), "stems", len(match.pairs), match.rms_m, stem_pairs=match.pairs
    )
    if not with_refinement:
        return alignment
    return refined(alignment, source, target, with_scale=scale is None, progress=progress)


def align_by_pairs(source: ArrayLike, target: ArrayLike, *, with_scale: bool = True) -> Alignment | Refusal:
    """From (P, 3) points picked in both clouds, in the same order; a refusal where they do not determine it."""
    a, b = as_points(source, name="source"), as_points(target, name="target")
    if a.shape != b.shape or len(a) < 3:
        return Refusal(
            "too_few_pairs", f"{len(a)} and {len(b)} points were picked; three pairs are needed.", _PAIRS_REMEDY
        )
    spread = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
    if not spread[1] > 0.05 * spread[0]:
        return Refusal("in_line", "The picked points lie in one line, so a turn about it is open.", _PAIRS_REMEDY)
    similarity, rms = fit_similarity(a, b, with_scale=with_scale)
    notes = () if len(a) > 3 else ("With three pairs the residual says little: a fourth checks the other three.",)
    return Alignment(similarity, "picked", len(a), rms, notes=notes)


def align_by_trajectories(
    source: Trajectory, target: Trajectory, *, with_scale: bool = True, offset_s: float | None = None
) -> Alignment | Refusal:
    """The paper's way: from where the two sensors were at the same times.

    Args:
        source: Of the camera, in the frame of the cloud with the labels.
        target: Of the scanner, in the frame of the other cloud.
        with_scale: Whether the source's unit is unknown.
        offset_s: Target's clock minus the source's; None searches for it.
    """
    fit = fit_trajectories(source, target, with_scale=with_scale, offset_s=offset_s)
    if fit is None:
        return Refusal("too_few_poses", "Too few poses of the two walks were at common times.", _PAIRS_REMEDY)
    if not fit:
        return Refusal("ambiguous", f"The clouds cannot be aligned by the walks: {fit.reason}.", _PAIRS_REMEDY)
    notes = () if offset_s is not None else (f"The clocks differ by {fit.offset_s:.2f} s.",)
    return Alignment(fit.target_from_source, "trajectories", fit.n_used, fit.rms_m, notes=notes)


def align_as_given(target_from_source: Similarity) -> Alignment:
    """A transform that is known, such as from another program; `refined` shows whether it fits."""
    return Alignment(target_from_source, "given")


def refined(
    alignment: Alignment,
    source: Survey,
    target: Survey,
    *,
    with_scale: bool,
    progress: Progress = ignore_progress,
) -> Alignment | Refusal:
    """Stems and ground fitted on each other; a refusal where they do not come to lie on each other at all."""
    if min(len(source.firm), len(target.firm)) < 10:
        return Refusal("no_surface", "There is neither stem nor ground to fit the clouds on each other.", _PAIRS_REMEDY)
    better = refine(source.firm, target.firm, alignment.target_from_source, with_scale=with_scale, progress=progress)
    if better.share_near < 0.1 or not np.isfinite(better.rms_m):
        return Refusal(
            "no_overlap",
            f"Only {better.share_near:.0%} of the stems and the ground lie near those of the other cloud.",
            _PAIRS_REMEDY,
        )
    wanted = 7 if with_scale else 6
    notes = alignment.notes
    if better.n_free < wanted:
        notes += ("The surfaces do not hold the cloud in every direction; what they leave open is as it was.",)
    return replace(
        alignment,
        target_from_source=better.target_from_source,
        surface_rms_m=better.rms_m,
        share_near=better.share_near,
        notes=notes,
    )


def carry_labels(
    source_points: Float,
    source_labels: Int32,
    target_points: Float,
    target_from_source: Similarity,
    *,
    reach_m: float = 0.2,
    rivals: bool = True,
    margin_m: float = 0.03,
    progress: Progress = ignore_progress,
) -> CarriedLabels:
    """Each point of the target takes the label of the nearest labelled point of the source.

    Args:
        source_points: (N, 3)
        source_labels: (N,) 0 none, above 0 the trunk.
        target_points: (M, 3) metres.
        target_from_source: See `Alignment`.
        reach_m: Not from farther away; the paper's is 0.2.
        rivals: Whether points without a label compete: what lies nearer to a fern of the source than to its trunk is
            no trunk. False is the paper's way.
        margin_m: A rival must be nearer by this: clouds are not aligned to the millimetre.
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
    tree, others = cKDTree(trunks), _rivals(source, given, trunks, target_from_source, reach_m) if rivals else None
    lower, upper = trunks.min(axis=0) - reach_m, trunks.max(axis=0) + reach_m
    for start in range(0, len(target), _CHUNK):
        progress(start / len(target), "Carrying the labels")
        part = target[start : start + _CHUNK]
        rows = np.flatnonzero(((part >= lower) & (part <= upper)).all(axis=1))
        distance, nearest = tree.query(part[rows], distance_upper_bound=reach_m, workers=N_WORKERS)
        near = np.isfinite(distance)
        rows, distance, nearest = rows[near], distance[near], nearest[near]
        if others is not None and len(rows):
            rival = others.query(part[rows], distance_upper_bound=reach_m, workers=N_WORKERS)[0]
            won = distance <= rival + margin_m
            rows, nearest = rows[won], nearest[won]
        labels[start + rows] = given[trunk_rows[nearest]]
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
    """The paper's chain on the points that carry a label, and which trunk of the source each result is."""
    result = segment_trunks(
        target_points, ground, settings=settings, candidates=np.asarray(carried.labels > 0), progress=progress
    )
    ids = []
    for rows in result.point_sets:
        names, counts = np.unique(carried.labels[rows], return_counts=True)
        is_trunk = names > 0
        # Expansion adds points without a label; among those with one the commonest is it.
        ids.append(int(names[is_trunk][counts[is_trunk].argmax()]) if is_trunk.any() else 0)
    return CarriedTrunks(result, tuple(ids))


def _upright(match: StemMatch, source: Survey, target: Survey) -> Similarity:
    """The plan's similarity with the height that the ground under the paired stems gives."""
    plan = match.target_from_source
    cos, sin = np.cos(plan.angle_rad), np.sin(plan.angle_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rise = target.base_m[match.pairs[:, 1]] - plan.scale * source.base_m[match.pairs[:, 0]]
    return Similarity(turn, np.append(plan.shift, np.median(rise)), plan.scale)


def _ground_points(points: Float, ground: GroundModel) -> Float64:
    """(K, 3) points within a hand's breadth of the ground, thinned; none where the cloud has no ground."""
    if ground.kind == "stem_base":
        return np.empty((0, 3))
    near: list[Float32] = []
    for start in range(0, len(points), _CHUNK):
        part = points[start : start + _CHUNK]
        flat: Bool = np.abs(ground.height_above(part)) < _GROUND_M
        near.append(part[flat].astype(np.float32))
    thinned = _thinned(np.concatenate([np.empty((0, 3), np.float32), *near]), 2.0 * _FIRM_EDGE_M)
    return thinned[np.random.default_rng(0).permutation(len(thinned))[: _MOST_FIRM // 2]]


def _thinned(points: Float, edge_m: float = _FIRM_EDGE_M) -> Float64:
    return thin(points, edge_m).points.astype(np.float64)


def _placed(points: Float, target_from_source: Similarity) -> Float64:
    return np.asarray(target_from_source.apply(points.astype(np.float64)), np.float64)


def _rivals(
    source: Float, labels: Int32, trunks: Float64, target_from_source: Similarity, reach_m: float
) -> cKDTree | None:
    """A tree of the points without a label near trunks; None where there are none."""
    tree = cKDTree(trunks)
    lower, upper = trunks.min(axis=0) - 2.0 * reach_m, trunks.max(axis=0) + 2.0 * reach_m
    found = []
    for start in range(0, len(source), _CHUNK):
        rows = start + np.flatnonzero(labels[start : start + _CHUNK] == 0)
        part = _placed(source[rows], target_from_source)
        part = part[((part >= lower) & (part <= upper)).all(axis=1)]
        near = np.isfinite(tree.query(part, distance_upper_bound=2.0 * reach_m, workers=N_WORKERS)[0])
        found.append(part[near])
    points = np.concatenate(found) if found else np.empty((0, 3))
    return cKDTree(points) if len(points) else None
