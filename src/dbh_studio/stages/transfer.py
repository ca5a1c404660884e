"""One cloud laid on another of the same plot: photogrammetry on LiDAR, as in the paper, or the other way round.

    alignment = align_by_trajectories(camera, scanner)  or align_by_stems, align_by_pairs, align_as_given
    if not alignment: ...                               a Refusal says why and what to do
    photo, lidar = survey_of_stems(points_a, stems, ground_a), survey(points_b, ground_b)
    alignment = refined(alignment, photo, lidar, with_scale=True)

Then `label_carry` carries the labels.

Both clouds are upright in frames of their own; the source may have a unit of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32, Int64, as_points
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.registration import refine
from dbh_studio.core.similarity_fit import fit_similarity
from dbh_studio.core.stem_match import StemMatch, match_stems
from dbh_studio.core.trajectories import MIN_POSES, STRAIGHT, Trajectory, TrajectoryFit, common_poses, fit_trajectories
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.voxels import thin
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.measure import StemMeasurement
from dbh_studio.stages.segment import SegmentationResult, segment_trunks

_CHUNK = 1 << 20
_GROUND_M = 0.15
_FIRM_EDGE_M = 0.08
_MOST_FIRM = 60_000
_LAST_REACH_M = 0.08
_WALK_CODES = {
    "straight": "straight",
    "several_offsets": "several_offsets",
    "few_fit": "other_walk",
    "differ": "other_walk",
}
_WALK_REMEDIES = {
    "straight": "Walk a loop or a bend next time. Stems and ground tell it where both clouds show at least four stems.",
    "several_offsets": "Give the offset of the clocks, if it is known. Stems tell it where both clouds show at least "
    "four of them.",
    "other_walk": "Look whether both are of one walk, whether the times are seconds, and whether each trajectory is in "
    "the frame of its cloud.",
}
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
        walk: How the trajectories lie on each other; None where it does not rest on them.
        scale_error: Standard error of the scale, as a share of it; None where it is fixed or not known.
        rival_pairs: Stems that the best clearly different way brings together, where it rests on stems.
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
    walk: TrajectoryFit | None = None
    scale_error: float | None = None
    rival_pairs: int = 0


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
    base = ground.z_at(xy) if len(xy) else np.empty(0)
    return _surveyed(cloud, xy, radius, base, [rows for _, rows in stems], ground)


def survey_of_stems(points: Float, stems: Sequence[tuple[Int32, StemMeasurement]], ground: GroundModel) -> Survey:
    """As `survey`, for a cloud whose trunks are known and measured.

    Args:
        points: (N, 3) metres, +z up.
        stems: Rows of each trunk, and its measurement; the diameter may be refused.
        ground: Of these points.
    """
    placed = [(rows, stem) for rows, stem in stems if np.isfinite(stem.xy_m).all() and np.isfinite(stem.z_ground_m)]
    xy = np.array([stem.xy_m for _, stem in placed], np.float64).reshape(-1, 2)
    radius = [0.005 * stem.result.dbh_cm if isinstance(stem.result, DbhEstimate) else np.nan for _, stem in placed]
    base = np.array([stem.z_ground_m for _, stem in placed], np.float64)
    return _surveyed(points, xy, np.array(radius, np.float64), base, [rows for rows, _ in stems], ground)


def _surveyed(
    points: Float, xy: Float64, radius: Float64, base: Float64, trunks: Sequence[Int32], ground: GroundModel
) -> Survey:
    gathered = np.concatenate([*(_thinned(points[rows]) for rows in trunks), _ground_points(points, ground)])
    kept = np.random.default_rng(0).permutation(len(gathered))[:_MOST_FIRM]
    return Survey(xy, radius, base, gathered[kept])


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
        _upright(match, source, target),
        "stems",
        len(match.pairs),
        match.rms_m,
        stem_pairs=match.pairs,
        rival_pairs=match.rival_pairs,
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
    source: Trajectory,
    target: Trajectory,
    *,
    with_scale: bool = True,
    offset_s: float | None = None,
    upright: bool = False,
) -> Alignment | Refusal:
    """The paper's way: from where the two sensors were at the same times.

    Args:
        source: Of the camera, in the frame of the cloud with the labels.
        target: Of the scanner, in the frame of the other cloud.
        with_scale: Whether the source's unit is unknown.
        offset_s: Target's clock minus the source's; None searches for it.
        upright: Both frames have z up, so that even a straight walk leaves nothing open.

    Returns:
        The alignment; a refusal with the code ``too_few_poses``, ``no_common_time``, ``straight``,
        ``several_offsets`` or ``other_walk``.
    """
    named = (("the camera", source), ("the scanner", target))
    few = [f"{name} has {len(walk)} poses" for name, walk in named if len(walk) < MIN_POSES]
    if few:
        return Refusal(
            "too_few_poses",
            f"The walks cannot be compared: {' and '.join(few)}, and at least {MIN_POSES} are needed.",
            "Export every pose of the trajectory, not only key frames.",
        )
    fit = fit_trajectories(source, target, with_scale=with_scale, offset_s=offset_s, upright=upright)
    if fit is None and not (source.is_line or target.is_line):
        return _no_common_time(source, target, offset_s)
    if fit is None or not fit:
        code, reason = ("straight", STRAIGHT) if fit is None else (_WALK_CODES[fit.code], fit.reason)
        return Refusal(code, f"The walks do not tell how the clouds lie: {reason}.", _WALK_REMEDIES[code])
    notes: tuple[str, ...] = (
        () if offset_s is not None else (f"The scanner's clock is {fit.offset_s:+.2f} s from the camera's.",)
    )
    n_left = fit.n_poses - fit.n_used
    if n_left:
        notes += (f"{n_left} of {fit.n_poses} poses are off and were left out.",)
    return Alignment(
        fit.target_from_source,
        "trajectories",
        fit.n_used,
        fit.rms_m,
        notes=notes,
        walk=fit,
        scale_error=fit.scale_error,
    )


def _no_common_time(source: Trajectory, target: Trajectory, offset_s: float | None) -> Refusal:
    if offset_s is None:
        lasted = f"{source.duration_s:.0f} and {target.duration_s:.0f} s"
        return Refusal(
            "no_common_time",
            f"The walks cannot be compared: they lasted {lasted}, and at no offset of their clocks do "
            f"{MIN_POSES} poses fall together.",
            "Look whether the times are seconds, and whether both files are of one walk.",
        )
    n = common_poses(source, target, offset_s)
    first, last = source.time_s[0] + offset_s, source.time_s[-1] + offset_s
    return Refusal(
        "no_common_time",
        f"With this clock offset only {n} poses fall together: on the scanner's clock the camera's walk is "
        f"{first:.1f} to {last:.1f} s, the scanner's {target.time_s[0]:.1f} to {target.time_s[-1]:.1f} s.",
        "Leave the clock offset away, so that it is searched for, or give the right one.",
    )


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
        scale_error=None,
    )


def stems_together(source: Survey, target: Survey, target_from_source: Similarity, *, tolerance_m: float = 0.5) -> int:
    """How many stems of the source stand on a stem of the target, one to one."""
    if not len(source.xy_m) or not len(target.xy_m):
        return 0
    feet = np.asarray(target_from_source.apply(np.column_stack([source.xy_m, source.base_m])), np.float64)
    distance = np.linalg.norm(feet[:, None, :2] - target.xy_m[None], axis=2)
    apart = np.abs(feet[:, None, 2] - target.base_m[None])
    rows, columns = linear_sum_assignment(np.where(apart < 2.0 * tolerance_m, distance, 1e3))
    return int(((distance[rows, columns] <= tolerance_m) & (apart[rows, columns] < 2.0 * tolerance_m)).sum())


def scale_error_of_surfaces(source: Survey, target: Survey, alignment: Alignment, *, n_sectors: int = 5) -> float:
    """Standard error of a refined scale, as a share of it: by the jackknife over sectors of the plot."""
    middle = np.median(source.firm[:, :2], axis=0)
    away = source.firm[:, :2] - middle
    sector = ((np.arctan2(away[:, 1], away[:, 0]) / (2.0 * np.pi) + 0.5) * n_sectors).astype(int) % n_sectors
    reach = (_LAST_REACH_M, _LAST_REACH_M)
    logs = []
    for number in range(n_sectors):
        rest = source.firm[sector != number]
        if len(rest) >= 10:
            fit = refine(rest, target.firm, alignment.target_from_source, with_scale=True, reach_m=reach, steps=6)
            logs.append(np.log(fit.target_from_source.scale))
    if len(logs) < 3:
        return float("nan")
    spread = np.array(logs) - np.mean(logs)
    return float(np.sqrt((len(logs) - 1) / len(logs) * (spread**2).sum()))


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
